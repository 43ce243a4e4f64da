"""Configurations that tell two causes apart, which explain what was measured nearly as well.

For a cause A of the size that was found and a look-alike B, what counts is how well the size of A
is determined while B has any size, and so have offsets, registrations and markers: the
non-centrality of the test between the two (T-optimality; Atkinson and Fedorov 1975,
doi:10.1093/biomet/62.1.57), which for models that are linear in their sizes is c-optimality of the
size of A in the joint model. With the amplitude s of A (1 as found), 1 / std(s) is by how many
standard deviations the two differ; configurations are added to those of the plan, each the
one that adds the most to it, over all pairs.

What drives a cause may be time, temperature or the way to a configuration: no choice of
configurations separates these, and the other measurements that do are named in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import LARGEST_M, Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import PlannedPose, PlanningScene
from remaster_ros.planning.design_information import (
    DesignInformation,
    FurtherColumns,
    nominal_context,
)
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.types import FloatArray, IntArray, Priors

MOST_FURTHER = 25
"""Configurations that may be added."""
ELBOW_STEPS = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0])
"""Held joints are tried so far from their values in the cell file, rad."""
DECIDED = 5.0
"""Standard deviations between two causes that decide: a wrong choice is rarer than one in a
thousand then, with a reserve for a size that is smaller than found."""


@dataclass(frozen=True)
class FoundCause:
    """A cause as discovery.json has it.

    Attributes
    ----------
    name, joints
        What it is; joints 1-based.
    sizes
        Parameter -> value, in its unit.
    look_alikes
        Name, joints and, in words, which measurements separate it from each.
    """

    name: str
    joints: tuple[int, ...]
    sizes: Mapping[str, float]
    look_alikes: tuple[tuple[str, tuple[int, ...], str], ...]


@dataclass(frozen=True)
class Separated:
    """How two causes are told apart.

    Attributes
    ----------
    cause, look_alike
        In words.
    before, after
        Standard deviations between the two, by the plan alone and with what is added.
    """

    cause: str
    look_alike: str
    before: float
    after: float


@dataclass(frozen=True)
class SeparatingDesign:
    """What to measure.

    Attributes
    ----------
    poses
        To add, each with the solutions that were chosen.
    pairs
        What they separate.
    otherwise
        Sentences on pairs that no choice of configurations separates.
    """

    poses: tuple[PlannedPose, ...]
    pairs: tuple[Separated, ...]
    otherwise: tuple[str, ...]


def further_scene(scene: PlanningScene) -> PlanningScene:
    """Return a scene whose poses are also reached with the held joints elsewhere.

    Other arms' postures at the same poses separate what the plan's own do not.
    """
    chain = scene.model.chain
    low, high = chain.lower + scene.limit_margin_rad, chain.upper - scene.limit_margin_rad
    held = {
        joint: sorted(
            {
                float(np.clip(value + step, low[joint], high[joint]))
                for value in values
                for step in ELBOW_STEPS
            }
        )
        for joint, values in scene.inverse_kinematics.held.items()
    }
    return replace(scene, inverse_kinematics=InverseKinematics(chain, held)) if held else scene


def separate(
    chain: SerialChain,
    planned: Sequence[PlannedPose],
    candidates: Sequence[PlannedPose],
    sensors: Sequence[ExpectedSensor],
    marker_std_m: float,
    causes: Sequence[FoundCause],
    priors: Priors,
) -> SeparatingDesign:
    """Choose configurations that separate causes from their look-alikes.

    Parameters
    ----------
    chain
        The arm.
    planned
        What is measured anyway, or was.
    candidates
        Poses that can be added, each with the solutions that can be measured.
    sensors, marker_std_m, priors
        As of `DesignInformation.of`.
    causes
        That were found.
    """
    poses = [*planned, *candidates]
    q = np.concatenate([pose.solutions for pose in poses])
    number = np.repeat(np.arange(len(poses)), [len(pose.solutions) for pose in poses])
    model, x = nominal_model(chain, q, sensors, priors)
    context = nominal_context(model, x, expected_measurements(model, q, number, sensors))
    pairs: list[tuple[str, str, DesignInformation]] = []
    otherwise: list[str] = []
    for cause in causes:
        found = _cell(context, cause.name, cause.joints, tuple(cause.sizes))
        for name, joints, words in cause.look_alikes:
            other = _cell(context, name, joints)
            first, second = _words(cause.name, cause.joints), _words(name, joints)
            if found is None or other is None:
                otherwise.append(f'{first} and {second}: {words}')
                continue
            size = np.array([cause.sizes[parameter] for parameter in found.parameters])
            information = DesignInformation.of(
                chain,
                poses,
                sensors,
                marker_std_m,
                priors,
                further=_columns(context, found, size, other),
            )
            pairs.append((first, second, information))
    measured = list(range(sum(len(pose.solutions) for pose in planned)))
    chosen = _chosen([information for _, _, information in pairs], measured, len(q))
    kept = [
        PlannedPose(poses[index].T_R_T, q[chosen[number[chosen] == index]])
        for index in np.unique(number[chosen])
    ]
    return SeparatingDesign(
        tuple(kept),
        tuple(
            Separated(first, second, _apart(one, measured), _apart(one, [*measured, *chosen]))
            for first, second, one in pairs
        ),
        tuple(otherwise),
    )


def _words(name: str, joints: Sequence[int]) -> str:
    at = f' of joint{"s" * (len(joints) > 1)} {", ".join(map(str, joints))}' if joints else ''
    return f'{name.replace("_", " ")}{at}'


def _cell(
    context: Context, name: str, joints: tuple[int, ...], parameters: tuple[str, ...] | None = None
) -> Cell | None:
    """Return the cell of an effect that configurations alone drive; None where there is none.

    Parameters
    ----------
    parameters
        Its parameters; None for the variant with the most of them.
    """
    effect = EFFECTS.get(name)
    # What has no name is of any kind: its joints alone do not tell which.
    unknown = name == 'unnamed' and parameters is None
    if effect is None or unknown or effect.needs(context):
        return None
    cells = [cell for cell in effect.cells(context) if cell.joints == joints]
    if parameters is not None:
        cells = [cell for cell in cells if cell.parameters == parameters]
    return max(cells, key=lambda cell: cell.size, default=None)


def _columns(context: Context, found: Cell, size: FloatArray, other: Cell) -> FurtherColumns:
    """Return the columns of a cause of the size that was found, and of the other at any size."""
    shift = other.columns(context).displacement(context)
    largest = other.largest
    std = np.full(other.size, largest) if largest else LARGEST_M / _rms(shift)
    # That the amplitude is about 1 is nothing known beforehand.
    return FurtherColumns(
        ('amplitude', *other.parameters),
        partial(_displacement, found=found, size=size, other=other),
        np.concatenate(([1e3], std)),
    )


def _displacement(context: Context, found: Cell, size: FloatArray, other: Cell) -> FloatArray:
    one = found.columns(context).displacement(context) @ size
    return np.concatenate((one[:, :, None], other.columns(context).displacement(context)), axis=2)


def _rms(shift: FloatArray) -> FloatArray:
    """Return the root mean square of each column's displacement, (m,)."""
    rms: FloatArray = np.sqrt(np.mean(np.sum(shift**2, axis=1), axis=0))
    return np.where(rms > 0.0, rms, 1.0)


def _apart(information: DesignInformation, chosen: Sequence[int]) -> float:
    """Return by how many standard deviations two causes differ with chosen configurations."""
    return 1.0 / float(np.sqrt(_variances(information, information.total(chosen)[None])[0]))


def _variances(information: DesignInformation, matrices: FloatArray) -> FloatArray:
    """Return the variance of the amplitude with information (n, f, f), (n,)."""
    place = information.names.index('amplitude')
    finite = information.finite(matrices)
    unit = np.zeros((len(finite), finite.shape[1], 1))
    unit[:, place] = 1.0
    solved: FloatArray = np.linalg.solve(finite, unit)[:, place, 0] * information.scale[place] ** 2
    return solved


def _chosen(pairs: Sequence[DesignInformation], measured: list[int], count: int) -> IntArray:
    """Return the configurations that add the most, one after the other, until all is decided."""
    chosen: list[int] = []
    left = np.arange(len(measured), count)
    while len(chosen) < MOST_FURTHER and len(left):
        now = [*measured, *chosen]
        undecided = [one for one in pairs if _apart(one, now) < DECIDED]
        if not undecided:
            break
        gain = np.zeros(len(left))
        for one in undecided:
            before = _variances(one, one.total(now)[None])[0]
            gain += np.log(before / _variances(one, one.with_each(now, left)))
        best = int(np.argmax(gain))
        chosen.append(int(left[best]))
        left = np.delete(left, best)
    return np.array(chosen, dtype=np.int64)
