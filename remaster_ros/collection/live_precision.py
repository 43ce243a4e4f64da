"""Standard deviations that a fit of what is recorded so far can be expected to state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.planned_design import DesignSettings
from remaster_ros.types import FloatArray

ANYWHERE = 30


class Precision(NamedTuple):
    """What is expected of a fit.

    Attributes
    ----------
    configurations
        How many it is of.
    joint_std
        Joint -> standard deviation of its zero-offset, rad; None if not identifiable.
    """

    configurations: int
    joint_std: Mapping[str, float | None]


def expected_precision(
    chain: SerialChain,
    settings: DesignSettings,
    measured: Mapping[int, Sequence[FloatArray]],
    rng: np.random.Generator,
) -> Precision:
    """Return what a fit is expected to state at the noise that the cell file expects.

    Which joints are identifiable is decided by configurations all over the joints' ranges, of
    which nothing is measured: by few measured ones it would change with each of them.

    Parameters
    ----------
    chain
        The nominal arm.
    settings
        Sensors, noise and priors of the cell.
    measured
        Pose -> its configurations that are recorded and will be fitted, rad, (k,) each.
    rng
        Draws those.
    """
    count = sum(map(len, measured.values()))
    anywhere = rng.uniform(chain.lower, chain.upper, (ANYWHERE, len(chain)))
    poses = [
        PlannedPose(chain.forward(solutions[0]), np.array(solutions))
        for solutions in (*measured.values(), *anywhere[:, None])
    ]
    information = DesignInformation.of(
        chain, poses, settings.sensors, settings.marker_std_m, settings.priors
    )
    return Precision(count, information.joint_std(range(count)))
