"""Remaster a robot arm in place: joint zero-offsets with honest uncertainty.

The functions here are all that a program needs; the rest may change between versions.
Randomness comes from a seed: the same one gives the same result.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from remaster_ros.version import __version__

# Each function imports what it needs: a node or a verb shall not wait for all of it.
if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.compensation.file import Compensation
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.planning.tour_order import Tour
    from remaster_ros.simulation.simulated_workcell import SimulatedRun
    from remaster_ros.types import Priors, Session

__all__ = [
    '__version__',
    'discover',
    'fit',
    'plan',
    'read_compensation',
    'read_session',
    'simulate',
]


def read_session(folder: str | os.PathLike[str]) -> Session:
    """Read a session folder.

    Parameters
    ----------
    folder
        With ``session.yaml``, ``observations.csv`` and the robot's URDF.

    Raises
    ------
    InputError
        What is wrong, with file, row and column.

    Examples
    --------
    >>> import remaster_ros
    >>> remaster_ros.read_session('no_such_folder')
    Traceback (most recent call last):
    ...
    remaster_ros.errors.InputError: no_such_folder: no such session folder; give ...
    """
    from remaster_ros.session import reader

    return reader.read_session(folder)


def fit(session: Session, *, seed: int = 0, priors: Priors | None = None) -> FitResult:
    """Estimate the joint zero-offsets of a session, with their uncertainty.

    Parameters
    ----------
    session
        Of which the rows of the split ``optimization`` are fitted.
    seed
        Of the sampler.
    priors
        What is known beforehand, in place of what the session states.

    Raises
    ------
    InputError
        A session that does not fit its robot.
    InsufficientDataError
        Data that do not allow an answer.

    Examples
    --------
    >>> import remaster_ros
    >>> made = remaster_ros.simulate(poses=10, validation_poses=5, seed=1)
    >>> result = remaster_ros.fit(made.session)
    >>> [name for name, seen in zip(result.joint_names, result.identifiable) if not seen]
    ['joint_1', 'joint_7']
    >>> errors = result.joint_offsets - made.truth.joint_offsets
    >>> bool((abs(errors) < 5 * result.joint_offsets_std)[1:6].all())
    True
    """
    import numpy as np

    from remaster_ros.calibration.fit import fit_session

    return fit_session(session, rng=np.random.default_rng(seed), priors=priors)


def discover(session: Session, *, seed: int = 0) -> Discovery:
    """Find what the zero-offsets leave unexplained, and its physical cause.

    Parameters
    ----------
    session
        With rows of the split ``validation``, on which the gain is measured.
    seed
        Of the sampler.

    Raises
    ------
    InputError
        A session that does not fit its robot.
    InsufficientDataError
        Data that do not allow an answer.

    Examples
    --------
    >>> import remaster_ros
    >>> made = remaster_ros.simulate(
    ...     poses=20, validation_poses=10, effects=['joint_compliance@2:1.0'], seed=1
    ... )
    >>> found = remaster_ros.discover(made.session)
    >>> [(effect.name, effect.joints) for effect in found.effects]
    [('joint_compliance', (2,))]
    """
    import numpy as np

    from remaster_ros.discovery.discover import discover_session

    return discover_session(session, rng=np.random.default_rng(seed))


def simulate(
    cell: str | os.PathLike[str] = 'demo',
    *,
    robot: str | None = None,
    poses: int = 60,
    validation_poses: int = 60,
    effects: Sequence[str] = (),
    seed: int = 0,
) -> SimulatedRun:
    """Measure an arm whose truth is drawn.

    Parameters
    ----------
    cell
        A workcell file, or the name of a shipped one.
    robot
        A URDF file, or the name of a shipped robot; None for that of the workcell.
    poses, validation_poses
        Candidate poses to fit and to hold out; those that cannot be reached are dropped.
    effects
        What else is wrong, each as ``NAME[@JOINT][:MM]``, with the size in mm that it has after
        offsets, registration and marker are fitted.
    seed
        Of everything that is drawn.

    Raises
    ------
    InputError
        No such workcell, robot or effect, or no pose that the arm can take.

    Examples
    --------
    >>> import remaster_ros
    >>> made = remaster_ros.simulate(poses=10, validation_poses=5, seed=1)
    >>> made.session.sensor_names
    ('mocap', 'tracker')
    >>> len(made.truth.joint_offsets)
    7
    """
    import numpy as np

    from remaster_ros.session.workcell import read_cell
    from remaster_ros.simulation.effect_sampling import EffectSpec
    from remaster_ros.simulation.simulated_workcell import choose_robot, simulate_workcell

    workcell = read_cell(os.fspath(cell))
    return simulate_workcell(
        workcell,
        choose_robot(workcell, robot),
        np.random.default_rng(seed),
        poses=poses,
        validation_poses=validation_poses,
        effects=[EffectSpec.parse(effect) for effect in effects],
    )


def plan(
    cell: str | os.PathLike[str], *, poses: int = 60, validation_poses: int = 60, seed: int = 0
) -> Tour:
    """Plan the poses of a workcell, each in all its joint solutions, free of collisions.

    Parameters
    ----------
    cell
        A workcell file, or the name of a shipped one.
    poses, validation_poses
        Candidate poses to fit and to hold out; those that cannot be reached are dropped.
    seed
        Of the candidates.

    Raises
    ------
    InputError
        No such workcell, no closed form for its robot, or no pose that it can take.

    Examples
    --------
    >>> import remaster_ros
    >>> tour = remaster_ros.plan('demo', poses=10, validation_poses=5, seed=1)
    >>> tour.poses['optimization'] > 0
    True
    """
    import numpy as np

    from remaster_ros.session.workcell import read_cell
    from remaster_ros.simulation.offline_tour import plan_tour

    workcell = read_cell(os.fspath(cell))
    counts = {'optimization': poses, 'validation': validation_poses}
    rng = np.random.default_rng(seed)
    return plan_tour(workcell.chain(), workcell, None, counts, rng, without_meshes=False)


def read_compensation(path: str | os.PathLike[str]) -> Compensation:
    """Read ``apply/compensation.json``: the whole correction of an arm, ready to use.

    Parameters
    ----------
    path
        The file that fit, discover or report has written.

    Raises
    ------
    InputError
        One line naming the file, the place in it and the remedy.

    Examples
    --------
    >>> import remaster_ros
    >>> remaster_ros.read_compensation('no_such_file.json')
    Traceback (most recent call last):
    ...
    remaster_ros.errors.InputError: no_such_file.json: no such file; give ...
    """
    from remaster_ros.compensation import file

    return file.read_compensation(path)
