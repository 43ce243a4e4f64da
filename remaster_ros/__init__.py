# SPDX-License-Identifier: Apache-2.0
"""Remaster a robot arm in place: joint zero-offsets with honest uncertainty.

The functions here are all that a program needs; the rest may change between versions.
Randomness comes from a seed: the same one gives the same result.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from remaster_ros.version import __version__

# Each function imports what it needs: a node or a verb shall not wait for all of it.
if TYPE_CHECKING:
    from remaster_ros.compensation.file import Compensation
    from remaster_ros.notebook import Fit, Found
    from remaster_ros.planning.tour_order import Tour
    from remaster_ros.simulation.simulated_workcell import SimulatedRun
    from remaster_ros.types import Priors, Session

__all__ = [
    '__version__',
    'discover',
    'fit',
    'import_table',
    'plan',
    'read_compensation',
    'read_session',
    'session_from',
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
        What is wrong, with file, row and column; also if there is no such folder.

    Examples
    --------
    >>> import remaster_ros
    >>> remaster_ros.read_session('no_such_folder')
    Traceback (most recent call last):
    ...
    remaster_ros.errors.InputError: no_such_folder: no such session folder; give ...
    """
    from remaster_ros.session.records import reader

    return reader.read_session(folder)


def session_from(
    joints: Any,
    points: Any,
    urdf: str | os.PathLike[str],
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    angles: Literal['', 'rad', 'deg', 'gon'] = '',
    length: Literal['', 'm', 'cm', 'mm', 'um', 'in'] = '',
    couple: Mapping[str, str] | None = None,
    reverse: Sequence[str] = (),
    offset_deg: Mapping[str, float] | None = None,
    never_mastered: bool = False,
    sensor_kind: Literal['', 'camera', 'tracker', 'controller'] = '',
    seed: int = 0,
) -> Session:
    """Make a session of joint angles and marker positions in arrays, or in two data frames.

    A row with NaN is left out, with a warning. Nothing is written to the disk.

    Parameters
    ----------
    joints
        Reported joint angles, (n, k), base to tip; or a dict of arrays with one for each joint of
        the URDF; or a data frame, whose columns are recognised as those of a table file.
    points
        Measured marker positions in the sensor's own frame, (n, 3); or a dict of x, y and z; or a
        data frame. Rows of two frames are joined by their index; if both indices merely count the
        rows, by columns with names or times, or by order.
    urdf
        File of the nominal arm.
    base_link, tip_link
        Ends of the arm; None for the likely ones.
    angles, length
        Units; '' for rad and m of arrays, and for those found in data frames.
    couple, reverse, offset_deg
        Corrections of the joints: joint -> another one that is added (``'-J2'``: subtracted),
        those that count the other way round, and joint -> angle that is added, degrees.
    never_mastered
        Zero-offsets may be of any size (hobby servos, a motor that was replaced).
    sensor_kind
        What measured the points; '' if it is unknown, or shows from names and files.
    seed
        Of the random choice of poses that are held out.

    Raises
    ------
    InputError
        What is wrong, with the row or column.
    InsufficientDataError
        The data do not fit the robot; the message says which change would make them fit.

    Examples
    --------
    >>> import remaster_ros
    >>> remaster_ros.session_from([[0.0]], [[0.0, 0.0, 0.0]], 'no_such.urdf')
    Traceback (most recent call last):
    ...
    remaster_ros.errors.InputError: no_such.urdf: ...
    """
    from remaster_ros.errors import InputError
    from remaster_ros.importing import in_python
    from remaster_ros.importing.assemble import SessionOptions
    from remaster_ros.importing.rows import TableOptions
    from remaster_ros.importing.units import ANGLES, LENGTHS
    from remaster_ros.session.cells.robot_description import read_arm

    if angles not in ('', *ANGLES) or length not in ('', *LENGTHS):
        raise InputError(
            f'angles={angles!r}, length={length!r}: one of {", ".join(ANGLES)}, and of '
            f'{", ".join(LENGTHS)}'
        )
    choices = in_python.Choices(
        TableOptions(angles=angles, length=length),
        SessionOptions.of(couple, reverse, offset_deg, sensor_kind),
        (
            *('joints', 'points', 'base_link', 'tip_link', 'angles', 'length', 'couple'),
            *('reverse', 'offset_deg', 'never_mastered', 'sensor_kind'),
        ),
        never_mastered,
        seed,
    )
    robot = read_arm(Path(urdf), base_link, tip_link)
    return in_python.of_arrays(joints, points, robot, choices)


def import_table(
    *files: Any,
    urdf: str | os.PathLike[str],
    base_link: str | None = None,
    tip_link: str | None = None,
    joints: Sequence[str] = (),
    points: Sequence[str] = (),
    join: Literal['', 'name', 'time', 'order'] = '',
    angles: Literal['', 'rad', 'deg', 'gon'] = '',
    length: Literal['', 'm', 'cm', 'mm', 'um', 'in'] = '',
    time: str = '',
    names: str = '',
    sheets: Sequence[str] = (),
    pulses_per_degree: Sequence[float] = (),
    clock_offset_s: float | None = None,
    couple: Mapping[str, str] | None = None,
    reverse: Sequence[str] = (),
    offset_deg: Mapping[str, float] | None = None,
    never_mastered: bool = False,
    sensor_kind: Literal['', 'camera', 'tracker', 'controller'] = '',
    seed: int = 0,
) -> Session:
    """Make a session of one table with joints and points, or of two, as ``remaster import`` does.

    Nothing is written to the disk.

    Parameters
    ----------
    files
        Tables, or makers' own texts; or data frames, which are read as the same tables.
    urdf, base_link, tip_link, never_mastered, sensor_kind, seed
        As of `session_from`.
    joints, points, time, names, join
        Names of columns, and how two tables are joined; () or '' to recognise them in the tables.
    angles, length
        Units, if they are neither in the header nor guessed right.
    sheets
        Of a workbook: the one with joints and points, or two.
    pulses_per_degree
        Of joints in pulses of the motors, base to tip.
    clock_offset_s
        Of two streams: the joints' clock less the points'; None to find it.
    couple, reverse, offset_deg
        Corrections of the joints: joint -> another one that is added (``'-J2'``: subtracted),
        those that count the other way round, and joint -> angle that is added, degrees.

    Raises
    ------
    InputError
        What is wrong, with file, line and column.
    InsufficientDataError
        The data do not fit the robot; the message says which change would make them fit.

    Examples
    --------
    >>> import remaster_ros
    >>> remaster_ros.import_table('no_such.csv', urdf='no_such.urdf')
    Traceback (most recent call last):
    ...
    remaster_ros.errors.InputError: no_such.urdf: ...
    """
    from remaster_ros.importing import in_python
    from remaster_ros.importing.assemble import SessionOptions
    from remaster_ros.importing.columns import ColumnChoice
    from remaster_ros.importing.rows import TableOptions
    from remaster_ros.session.cells.robot_description import read_arm

    choices = in_python.Choices(
        TableOptions(
            angles=angles,
            length=length,
            chosen=ColumnChoice(tuple(joints), tuple(points), time, names),
            join=join,
            clock_offset_s=clock_offset_s,
            pulses_per_degree=tuple(pulses_per_degree),
            sheets=tuple(sheets),
        ),
        SessionOptions.of(couple, reverse, offset_deg, sensor_kind),
        (
            *('joints', 'points', 'join', 'angles', 'length', 'time', 'names', 'sheets'),
            *('pulses_per_degree', 'clock_offset_s', 'base_link', 'tip_link', 'couple'),
            *('reverse', 'offset_deg', 'never_mastered', 'sensor_kind'),
        ),
        never_mastered,
        seed,
    )
    paths = [Path(file) for file in files if isinstance(file, (str, os.PathLike))]
    robot = read_arm(Path(urdf), base_link, tip_link, tables=paths)
    return in_python.of_files(files, robot, choices)


def fit(session: Session, *, seed: int = 0, priors: Priors | None = None) -> Fit:
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
    from remaster_ros.notebook import Fit

    return Fit.of(fit_session(session, rng=np.random.default_rng(seed), priors=priors))


def discover(session: Session, *, seed: int = 0) -> Found:
    """Search for the physical causes of the errors that zero-offsets leave.

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
    ...     poses=14, validation_poses=8, effects=['joint_compliance@2:1.0'], seed=1
    ... )
    >>> found = remaster_ros.discover(made.session)
    >>> [(effect.name, effect.joints) for effect in found.effects]
    [('joint_compliance', (2,))]
    """
    import numpy as np

    from remaster_ros.discovery.discover import discover_session
    from remaster_ros.notebook import Found

    return Found.of(discover_session(session, rng=np.random.default_rng(seed)))


def simulate(
    cell: str | os.PathLike[str] = 'demo',
    *,
    robot: str | None = None,
    poses: int = 60,
    validation_poses: int = 60,
    effects: Sequence[str] = (),
    seed: int = 0,
    sensors: Sequence[str] | None = None,
    noise_m: float = 1e-4,
    pose_noise_m: float = 2e-4,
    depth_noise_m: float = 0.0,
    orientation_noise_rad: float | None = None,
    pose_orientation_noise_rad: float = 0.0,
    on_tool: bool = False,
    outlier_share: float = 0.0,
    offset_std_rad: float | None = None,
) -> SimulatedRun:
    """Simulate the measurement of an arm with random true errors; nothing is written to the disk.

    Parameters
    ----------
    cell
        A workcell file, or the name of a shipped one.
    robot
        A URDF file, or the name of a shipped robot; None for that of the workcell.
    poses, validation_poses
        Number of candidate poses to fit and to hold out; those that cannot be reached are
        dropped.
    effects
        What else is wrong, each as ``NAME[@JOINT][:MM]``, with the size in mm that it has after
        offsets, registration and marker are fitted.
    seed
        Of everything that is drawn.
    sensors
        Names of those of the workcell that measure; None for all.
    noise_m, pose_noise_m
        Noise of every point, and error common to all solutions of a pose, m per axis.
    depth_noise_m
        Further noise along the line of sight, m at 1 m; it grows with the square of the distance.
    orientation_noise_rad, pose_orientation_noise_rad
        The same two of orientations, rad per axis; without the first one none are measured.
    on_tool
        Whether the sensors are on the tool, at their markers, and measure boards in their places.
    outlier_share
        Share of the observations that are 20 mm off.
    offset_std_rad
        Standard deviation of the true zero-offsets, rad; None for 0.3 degrees. A joint that slides
        has 0.25 m for each rad.

    Raises
    ------
    InputError
        No such workcell, robot, effect or sensor, no pose that the arm can take, or sensors that
        cannot measure so.

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

    from remaster_ros.errors import InputError
    from remaster_ros.session.cells.workcell import read_cell
    from remaster_ros.simulation.effect_sampling import EffectSpec
    from remaster_ros.simulation.simulated_session import DEFAULT_OFFSET_STD
    from remaster_ros.simulation.simulated_workcell import (
        choose_robot,
        choose_sensors,
        simulate_workcell,
    )

    sizes = {
        'noise_m': noise_m,
        'pose_noise_m': pose_noise_m,
        'depth_noise_m': depth_noise_m,
        'orientation_noise_rad': orientation_noise_rad,
        'pose_orientation_noise_rad': pose_orientation_noise_rad,
        'outlier_share': outlier_share,
        'offset_std_rad': offset_std_rad,
    }
    for name, size in sizes.items():
        most = 1.0 if name == 'outlier_share' else np.inf
        if size is not None and not (0.0 <= size <= most and np.isfinite(size)):
            raise InputError(f'{name}: {size:g} is no number from 0 to {most:g}')
    workcell = read_cell(os.fspath(cell))
    chain = choose_robot(workcell, robot)
    choose_sensors(workcell, None if sensors is None else tuple(sensors))
    return simulate_workcell(
        workcell,
        chain,
        np.random.default_rng(seed),
        poses=poses,
        validation_poses=validation_poses,
        sigma_m=noise_m,
        pose_sigma_m=pose_noise_m,
        depth_sigma_m=depth_noise_m,
        turn_sigma_rad=orientation_noise_rad,
        pose_turn_sigma_rad=pose_orientation_noise_rad,
        on_tool=on_tool,
        outlier_share=outlier_share,
        joint_offset_std=DEFAULT_OFFSET_STD if offset_std_rad is None else offset_std_rad,
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
        Number of candidate poses to fit and to hold out; those that cannot be reached are
        dropped.
    seed
        Of the random candidates.

    Raises
    ------
    InputError
        No such workcell, no way to solve for the joints of its robot, or no pose that it can take.

    Examples
    --------
    >>> import remaster_ros
    >>> tour = remaster_ros.plan('demo', poses=10, validation_poses=5, seed=1)
    >>> tour.poses['optimization'] > 0
    True
    """
    import numpy as np

    from remaster_ros.session.cells.workcell import read_cell
    from remaster_ros.simulation.simulated_tour import plan_tour

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
