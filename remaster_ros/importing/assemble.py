# SPDX-License-Identifier: Apache-2.0
"""Session from rows: poses by equal tool poses, held-out poses, configurations in one order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from remaster_ros.calibration.arrangement import FEWEST_ROWS, linear_fit
from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.mistakes import UNKNOWN_MARKER_STD_M
from remaster_ros.errors import InputError
from remaster_ros.importing.raw_rows import RawRows
from remaster_ros.importing.units import split_unit
from remaster_ros.kinematics.pad_angles import PadAngles, coupled_in_circle
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import (
    AngleUnit,
    BoolArray,
    Controller,
    FloatArray,
    IntArray,
    Measurements,
    PadJoint,
    SensorKind,
    Session,
)

# Tool poses closer than this are one pose: it covers the rounding of the robot's report and the
# difference between its controller's kinematics and the nominal ones.
SAME_POSE_M = 2e-3
SAME_POSE_RAD = 5e-3
# One of this number of poses, in the order measured, is held out.
HOLD_OUT_ONE_OF = 4
# Fewer poses are all needed for the fit.
FEWEST_POSES = 12
# 3 January 2000: times of day without a date do not reach it, nor do seconds since some start.
FIRST_DATE_S = 946_684_800.0 + 2 * 86_400.0
_SPLITS = {
    **dict.fromkeys(('optimization', 'fit', 'train', 'training', 'calibration', 'opt'), 0),
    **dict.fromkeys(('validation', 'test', 'held_out', 'holdout', 'val', 'check'), 1),
}


_WORDS_OF_KINDS: dict[SensorKind, re.Pattern[str]] = {
    'tracker': re.compile(r'(?i)tracker|leica|faro|smr|at9\d\d|at40\d'),
    'camera': re.compile(
        r'(?i)camera|mocap|optitrack|motive|vicon|qualisys|april.?tag|aruco|charuco|realsense|kinect'
    ),
}


@dataclass(frozen=True)
class SessionOptions:
    """Options of ``remaster import`` on the session: joint corrections, marker, held-out share."""

    # Corrections by joint column, applied in this order: coupled joint with its sign; columns
    # whose sign is reversed; angles added, degrees
    couple: tuple[tuple[str, tuple[str, Literal[1, -1]]], ...] = ()
    reverse: tuple[str, ...] = ()
    add_deg: tuple[tuple[str, float], ...] = ()
    sensor: str = 'sensor'
    marker: str = 'marker'
    # Position of the marker in the tool frame, m; None if unknown
    marker_m: tuple[float, float, float] | None = None
    marker_std_m: float | None = None
    # Share of the poses that is held out if the table states no split
    hold_out: float = 1.0 / HOLD_OUT_ONE_OF
    visited_in_order: bool = False  # Each configuration was reached from the previous row's
    on_tool: bool = False  # The sensor is on the tool and measures the pose of a fixed target
    sensor_kind: Literal['', SensorKind] = ''

    @classmethod
    def of(
        cls,
        couple: Mapping[str, str] | None,
        reverse: Sequence[str],
        offset_deg: Mapping[str, float] | None,
        sensor_kind: Literal['', SensorKind] = '',
    ) -> SessionOptions:
        """Options with the joint corrections in the form of the Python functions' arguments.

        `couple`: joint -> joint whose angle is added to its own, with a minus sign in front to
        subtract it; `reverse`: joints whose sign is reversed; `offset_deg`: joint -> angle to
        be added, degrees. None or () for no such corrections. `sensor_kind`: kind of all
        sensors, 'camera' or 'tracker', '' to derive it. Other options have their defaults.
        """
        added: dict[str, tuple[str, Literal[1, -1]]] = {
            name: (other.lstrip('+-'), -1 if other[:1] == '-' else 1)
            for name, other in (couple or {}).items()
        }
        return cls(
            couple=tuple(added.items()),
            reverse=tuple(reverse),
            add_deg=tuple((offset_deg or {}).items()),
            sensor_kind=sensor_kind,
        )


def controller_of(rows: RawRows, chain: SerialChain, options: SessionOptions) -> Controller | None:
    """Unit, sign, zero and coupling by which the robot's controller counts each joint.

    By the table's columns and the user's corrections. None if the controller counts as the
    URDF does (a bag, or an arm with a prismatic joint, without corrections). Raises InputError
    for corrections of an arm with a prismatic joint, of an unknown joint, or of joints that
    are coupled in a circle.
    """
    corrections = options.couple or options.reverse or options.add_deg
    if chain.slides.any():
        if corrections:
            raise InputError(
                '--couple, --reverse and --offset are for arms whose joints all turn; '
                f"'{chain.joint_names[int(np.argmax(chain.slides))]}' slides: correct the table"
            )
        return None
    if rows.angle_unit is None and not corrections:
        return None
    unit: AngleUnit = rows.angle_unit or 'rad'
    names = [split_unit(name)[0] or name for name in rows.joint_columns]
    if len(set(names)) < len(names):
        names = list(chain.joint_names)
    # Columns without names of their own are those of the URDF.
    names = [
        urdf_name if name.isdigit() else name for name, urdf_name in zip(names, chain.joint_names)
    ]
    pads = [PadJoint(name, unit) for name in names]
    for name, (other, sign) in options.couple:
        added = chain.joint_names[_joint_index(other, rows, chain, '--couple')]
        i = _joint_index(name, rows, chain, '--couple')
        pads[i] = replace(pads[i], coupling={**pads[i].coupling, added: sign})
    for name in options.reverse:
        i = _joint_index(name, rows, chain, '--reverse')
        pads[i] = replace(pads[i], sign=1 if pads[i].sign < 0 else -1)
    for name, angle in options.add_deg:
        i = _joint_index(name, rows, chain, '--offset')
        pads[i] = replace(pads[i], zero_deg=pads[i].zero_deg + angle)
    joints = dict(zip(chain.joint_names, pads, strict=True))
    if joint := coupled_in_circle({name: pad.coupling for name, pad in joints.items()}):
        raise InputError(
            f'--couple: {joints[joint].name} is coupled to itself, directly or by way of others'
        )
    return Controller(joints, rows.maker)


def _joint_index(name: str, rows: RawRows, chain: SerialChain, option: str) -> int:
    """Index, from 0, of a joint by the name of its column in the table, else by that in the URDF.

    With or without its unit; case is ignored. Raises InputError, which begins with `option`,
    if there is no such joint.
    """
    for names in (rows.joint_columns, chain.joint_names):
        folded = [known.casefold() for known in names]
        matching = [i for i, known in enumerate(folded) if known == name.casefold()]
        matching += [
            i for i, known in enumerate(folded) if split_unit(known)[0] == name.casefold()
        ]
        if matching:
            return matching[0]
    known = ', '.join(dict.fromkeys((*rows.joint_columns, *chain.joint_names)))
    raise InputError(f'{option}: there is no joint {name!r}; the table and the robot have {known}')


def assemble(
    rows: RawRows,
    urdf: str,
    chain: SerialChain,
    options: SessionOptions,
    rng: np.random.Generator,
    notes: str,
) -> tuple[Session, list[str]]:
    """Session from rows, and two sentences: how poses were found, and how rows were held out.

    Joint positions and torques are converted to those of the URDF. The limits, and whether the
    table fits the robot, are not checked. Markers whose position is unknown are at the tip,
    with a standard deviation of 0.3 m; others have 0.5 mm if none is stated. `urdf`: text of
    the URDF of `chain`; `rng`: draws held-out poses; `notes`: text for the session's field of
    this name.

    Raises
    ------
    InputError
        Labels that contradict each other, naming the row, or corrections of joints that the arm
        does not have.
    """
    controller = controller_of(rows, chain, options)
    pad = PadAngles.of(controller, chain.joint_names)
    q = pad.to_urdf(rows.q)
    n = len(q)
    pose, how_pose = _poses(rows, chain, q)
    configuration = _configurations(rows, pose, q)
    validation, how_split = _splits(rows, pose, options.hold_out, rng)
    sensor, sensors = _indices_of_names(rows.labels.get('sensor', [options.sensor] * n))
    marker, markers = _indices_of_names(rows.labels.get('marker', [options.marker] * n))
    from_q = pad.to_urdf(rows.from_q)
    effort = rows.effort
    if effort is not None:
        # Power is the same however joints are counted: q = A q_pad + b, and so A^T tau = tau_pad.
        shown = np.vstack((np.zeros(len(chain)), np.eye(len(chain))))
        turned = pad.to_urdf(shown)
        effort = np.linalg.solve(turned[1:] - turned[0], effort.T).T
    if options.visited_in_order:
        from_q = _previous_configuration(configuration, q)
    measurements = Measurements(
        observation=np.arange(n),
        pose=pose,
        configuration=configuration,
        is_validation=validation,
        stamp_s=np.arange(n, dtype=float) if rows.stamp_s is None else rows.stamp_s,
        sensor=sensor,
        marker=marker,
        q=q,
        from_q=from_q,
        position=rows.position,
        std=rows.std,
        samples=rows.samples.astype(np.int64),
        temperature_c=rows.temperature_c,
        frame=_frames(
            rows.stamp_s if rows.reading is None else rows.reading, sensor, marker, configuration
        ),
        orientation=rows.orientation,
        effort=effort,
    )
    place = np.zeros(3) if options.marker_m is None else np.array(options.marker_m)
    std = UNKNOWN_MARKER_STD_M if options.marker_m is None else 0.5e-3
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers={name: place for name in markers},
        sensors={
            name: markers[int(marker[np.flatnonzero(sensor == i)[0]])]
            for i, name in enumerate(sensors)
        },
        measurements=measurements,
        marker_std_m=std if options.marker_std_m is None else options.marker_std_m,
        settle_s=None,
        timed=rows.stamp_s is not None,
        exit_status='complete',
        created=_measurement_date(rows),
        notes=notes,
        controller=controller,
        sensor_kinds=_kinds(sensors, rows, options),
    )
    if options.on_tool:
        every = frozenset(session.sensors)
        session = replace(session, oriented=every, on_tool=every)
    return session, [how_pose, how_split]


def _kinds(
    sensors: Sequence[str], rows: RawRows, options: SessionOptions
) -> dict[str, SensorKind]:
    """Kind of instrument ('camera' or 'tracker') by sensor name; unknown ones are left out.

    The kind that the user stated (`options.sensor_kind`); else the one that words in the
    sensor's name tell, if they tell one only; else that of the file's format
    (`rows.instrument`); else 'camera' if the sensor is on the tool.
    """
    kinds: dict[str, SensorKind] = {}
    for name in sensors:
        by_name = [kind for kind, words in _WORDS_OF_KINDS.items() if words.search(name)]
        kind = options.sensor_kind or (by_name[0] if len(by_name) == 1 else rows.instrument)
        kind = kind or ('camera' if options.on_tool else '')
        if kind:
            kinds[name] = kind
    return kinds


def with_controller_coupling(
    rows: RawRows, chain: SerialChain, options: SessionOptions
) -> tuple[SessionOptions, list[str]]:
    """Options with the joint coupling of the controller that wrote the file, and a sentence on it.

    The same options and [] if the file's format has no coupling, the user stated one, or the
    arm has a prismatic joint; also if there are 12 rows or more and the nominal arm fits the
    points better without the coupling: the joints of the URDF are then coupled already.
    """
    coupling = tuple(rows.coupling.items())
    if options.couple or not coupling or chain.slides.any():
        return options, []
    coupled = replace(options, couple=coupling)
    q = [
        PadAngles.of(controller_of(rows, chain, candidate), chain.joint_names).to_urdf(rows.q)
        for candidate in (options, coupled)
    ]
    errors = linear_fit(chain, np.array(q), rows.position)[0]
    if len(rows.q) >= FEWEST_ROWS and errors[0] < errors[1]:
        return options, []
    listed = ', '.join(f'--couple {joint}={other}' for joint, (other, _) in coupling)
    return coupled, [f'joints coupled as a {rows.maker} controller counts them: {listed}']


def without_whole_turns(session: Session, chain: SerialChain) -> tuple[Session, str]:
    """Session with joint angles (q and from_q) shifted by whole turns into the limits.

    Last result: a sentence on the shifts. If no angle of q needs a shift, the session is
    returned as it is (from_q, too), with ''. A shifted session has no `observations_sha256`
    (''), as its rows differ from its file.
    """
    m = session.measurements
    q = chain.within_turns(m.q)
    if np.array_equal(q, m.q):
        return session, ''
    turned = (q != m.q).sum(axis=0)
    listed = ', '.join(
        f'{name} ({count} rows)' for name, count in zip(chain.joint_names, turned) if count
    )
    m = replace(m, q=q, from_q=chain.within_turns(m.from_q))
    return (
        replace(session, measurements=m, observations_sha256=''),
        f'whole turns were taken off, as the limits ask for it: {listed}',
    )


def _measurement_date(rows: RawRows) -> str:
    """Local date and time of the first row, ISO 8601, to the second.

    '' without times, or if they are before 3 January 2000: they do not count from 1970 then.
    """
    if rows.stamp_s is None or rows.stamp_s[0] < FIRST_DATE_S:
        return ''
    return datetime.fromtimestamp(float(rows.stamp_s[0])).isoformat(timespec='seconds')


def refuse_outside_limits(rows: RawRows, chain: SerialChain, q: FloatArray) -> None:
    """Raise InputError for the first row with a joint position outside the URDF's limits.

    `q`: positions as the URDF counts them, rad or m, (n, k). `SerialChain.limit_tolerance` is
    allowed.
    """
    allowed = chain.limit_tolerance
    outside = (q < chain.lower - allowed) | (q > chain.upper + allowed)
    for row, joint in np.argwhere(outside)[:1]:
        count = int(outside[:, joint].sum())
        if chain.slides[joint]:
            raise InputError(
                f'{rows.source[row]}, column {rows.joint_columns[joint]}: '
                f'{1e3 * q[row, joint]:.2f} mm is outside the limits of '
                f'{chain.joint_names[joint]} ({1e3 * chain.lower[joint]:.1f} to '
                f'{1e3 * chain.upper[joint]:.1f} mm), as {count} of {len(q)} rows are; are its '
                'unit (in the header, such as [mm]) and the URDF right?'
            )
        raise InputError(
            f'{rows.source[row]}, column {rows.joint_columns[joint]}: '
            f'{np.degrees(q[row, joint]):.3f} degrees is outside the limits of '
            f'{chain.joint_names[joint]} ({np.degrees(chain.lower[joint]):.1f} to '
            f'{np.degrees(chain.upper[joint]):.1f} degrees), as {count} of {len(q)} rows are; are '
            'unit (--angles), sign (--reverse), zero position (--offset) and URDF right?'
        )


def _poses(rows: RawRows, chain: SerialChain, q: FloatArray) -> tuple[IntArray, str]:
    """Index of the pose of each row, (n,), in order of first occurrence, and a sentence on it.

    By the label ``pose``; else a row has the pose of an earlier row if the nominal tool poses
    of both differ by less than 2 mm (`SAME_POSE_M`), 5 mrad counting as 2 mm, as the root of
    the sum of squares. `q`: positions as the URDF counts them, rad or m, (n, k).
    """
    if 'pose' in rows.labels:
        pose, names = _indices_of_names(rows.labels['pose'])
        return pose, f'{counted(len(names), "pose")}, as the table numbers them'
    T = chain.forward(q)
    # A rotation by a small angle a moves the columns of its matrix by a * sqrt(2) in all.
    scale = SAME_POSE_M / (SAME_POSE_RAD * np.sqrt(2.0))
    places = np.concatenate((T[:, :3, 3], scale * T[:, :3, :3].reshape(len(q), 9)), axis=1)
    neighbours = cKDTree(places).query_ball_point(places, SAME_POSE_M)
    pose = np.full(len(q), -1)
    count = 0
    for row in range(len(q)):
        if pose[row] < 0:
            # From the first row of a pose, so that a dense path does not become one pose.
            alike = [other for other in neighbours[row] if pose[other] < 0]
            pose[alike] = count
            count += 1
    return pose, (
        f'{counted(count, "pose")}: rows whose tool poses agree within {1e3 * SAME_POSE_M:g} mm '
        f'and {np.degrees(SAME_POSE_RAD):.1f} degrees are one'
    )


def _frames(
    moment: FloatArray | IntArray | None,
    sensor: IntArray,
    marker: IntArray,
    configuration: IntArray,
) -> IntArray | None:
    """Index of the camera frame of each row, (n,); -1 for a row that is alone in its frame.

    Rows with the same sensor, configuration and `moment` are one frame. None if every row is
    alone, if `moment` is None, or if a marker is in a frame twice. `moment`: time of each row,
    s, or number of the reading that it is from, (n,); the other arguments are indices, (n,).
    """
    if moment is None:
        return None
    moments = np.column_stack((sensor, configuration, moment))
    frame = np.unique(moments, axis=0, return_inverse=True)[1].reshape(-1)
    size = np.bincount(frame)[frame]
    once = len(np.unique(np.column_stack((frame, marker)), axis=0)) == len(frame)
    return np.where(size > 1, frame, -1) if once and np.any(size > 1) else None


def _configurations(rows: RawRows, pose: IntArray, q: FloatArray) -> IntArray:
    """Index of the configuration of each row, (n,), from 0.

    Rows with the same pose and the same label ``configuration`` are of one configuration, if
    the table has such labels. Else a new one begins where a joint position or the pose
    changes, or where sensor and marker are the same as in the row before; without labels of
    sensors and markers each row is a new one.
    """
    if 'configuration' in rows.labels:
        labels = list(zip(pose.tolist(), rows.labels['configuration'], strict=True))
        index: dict[tuple[int, str], int] = {}
        return np.array([index.setdefault(label, len(index)) for label in labels])
    moved = np.any(np.diff(q, axis=0) != 0.0, axis=1)
    moved |= np.diff(pose) != 0
    seen = [rows.labels.get('sensor'), rows.labels.get('marker')]
    again = np.ones(len(q) - 1, bool)
    for names in seen:
        if names is not None:
            again &= np.array(names[1:]) == np.array(names[:-1])
    # A second row of one marker and sensor is another visit, or another shot.
    return np.concatenate(([0], np.cumsum(moved | again)))


def _splits(
    rows: RawRows, pose: IntArray, share: float, rng: np.random.Generator
) -> tuple[BoolArray, str]:
    """Mask of the held-out rows, (n,), and a sentence on how they were chosen.

    By the label ``split`` if the table has it. Else `share` of the poses is held out: the
    poses in the order measured are cut into so many runs, and `rng` draws one pose of each.
    None is held out for a share of 0 or fewer than 12 poses. Raises InputError for an unknown
    split, or two in a pose.
    """
    if 'split' in rows.labels:
        given = [_SPLITS.get(text.strip().lower(), -1) for text in rows.labels['split']]
        for row, split in enumerate(given):
            if split < 0:
                raise InputError(
                    f'{rows.source[row]}, column split: {rows.labels["split"][row]!r} is neither '
                    'optimization nor validation; correct it'
                )
        splits = np.array(given)
        for pose_index in np.unique(pose):
            pose_rows = np.flatnonzero(pose == pose_index)
            if len(np.unique(splits[pose_rows])) > 1:
                other = pose_rows[splits[pose_rows] != splits[pose_rows[0]]][0]
                raise InputError(
                    f'{rows.source[other]}: another split than {rows.source[pose_rows[0]]}, which '
                    'has the same pose; give a pose one split'
                )
        return splits == 1, f'{counted(int(splits.sum()), "row")} held out, as the table has them'
    poses, first = np.unique(pose, return_index=True)
    order = poses[np.argsort(first)]
    if share == 0.0:
        return np.zeros(len(pose), bool), 'no pose held out, as told'
    if len(order) < FEWEST_POSES:
        return np.zeros(len(pose), bool), (
            f'no pose held out: with fewer than {FEWEST_POSES} poses the fit needs all'
        )
    # One of each run of poses: the held-out ones meet all of the session, and so does any drift.
    runs = np.array_split(order, max(1, round(share * len(order))))
    held_out = [rng.choice(run) for run in runs]
    sizes = sorted({len(run) for run in runs})
    return np.isin(pose, held_out), (
        f'{len(held_out)} of {len(order)} poses held out: one, drawn at random, of every '
        f'{" or ".join(map(str, sizes))} in the order measured'
    )


def _previous_configuration(configuration: IntArray, q: FloatArray) -> FloatArray:
    """Joints of the last row of the configuration before each row's, (n, k).

    NaN for rows of the first configuration. `configuration`: index of each row, (n,).
    """
    from_q = np.full_like(q, np.nan)
    first = np.flatnonzero(np.diff(configuration, prepend=configuration[0]) != 0)
    for start, end in zip(first, [*first[1:], len(q)]):
        from_q[start:end] = q[start - 1]
    return from_q


def _indices_of_names(names: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Index of each name, (n,), and the different names in order of first occurrence."""
    index: dict[str, int] = {}
    return np.array([index.setdefault(name, len(index)) for name in names]), list(index)
