# SPDX-License-Identifier: Apache-2.0
"""Rows from a ROS bag: joint states, and points measured while the arm stood still."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.calibration_data import CALIBRATION_DATA, rows_of
from remaster_ros.importing.moving import MarkerStream
from remaster_ros.importing.raw_rows import STATIC, RawRows
from remaster_ros.importing.standstill_matching import match
from remaster_ros.importing.standstills import (
    SWING_S,
    Stream,
    between,
    joint_standstills,
    point_visits,
    reading_of,
    refuse_sliding,
)
from remaster_ros.importing.units import LENGTHS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import mean_quaternion_xyzw
from remaster_ros.session.bags.bag import BagReader, jazzy_types
from remaster_ros.session.records.observations import LENGTH_TOLERANCE
from remaster_ros.types import FARTHEST_M, FloatArray

JOINT_STATE = 'sensor_msgs/msg/JointState'
# Message types with one point or pose, the likeliest first, and the field that has it.
PLACES = {
    'geometry_msgs/msg/PointStamped': 'point',
    'geometry_msgs/msg/PoseStamped': 'pose',
    'geometry_msgs/msg/TransformStamped': 'transform',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'pose.pose',
    'nav_msgs/msg/Odometry': 'pose.pose',
}
# Message types with several places, the likeliest first, and the field that lists them.
SEVERAL = {
    'mocap4r2_msgs/msg/RigidBodies': 'rigidbodies',
    'mocap4r2_msgs/msg/Markers': 'markers',
    'tf2_msgs/msg/TFMessage': 'transforms',
}
_KINDS = (*PLACES, *SEVERAL)
# Largest plausible joint angle, rad: hundreds of turns, of which an arm has a few at most.
LARGEST_RAD = 1e4
SUFFIXES = ('.mcap', '.db3', '.bag')


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file, by its ending alone, or a folder that holds one.

    Files end in .mcap, .db3 or .bag; a folder may have a metadata.yaml instead.
    """
    if path.is_dir():
        return (path / 'metadata.yaml').exists() or any(
            any(path.glob(f'*{suffix}')) for suffix in SUFFIXES
        )
    return path.suffix in SUFFIXES


@dataclass(eq=False)
class _Topic:
    """Stamps, s, and values of the messages of one topic, in the order read."""

    stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def stream(self, scale: float = 1.0) -> Stream:
        """Values in the order of their stamps, the first three columns times `scale`.

        Messages with a value that is not finite are left out.
        """
        values = np.array(self.values, dtype=float)
        values[:, :3] *= scale
        return Stream.of(np.array(self.stamps), values)


def _place(message: Any, where: str) -> tuple[float, ...]:
    """Position x, y, z and, for a pose or transform, quaternion x, y, z, w: 3 or 7 numbers.

    The quaternion is NaN if its length differs from 1 by over 1e-3. `where`: dotted path to
    the field of the message, such as ``pose.pose``.
    """
    for name in where.split('.'):
        message = getattr(message, name)
    place = getattr(message, 'position', getattr(message, 'translation', message))
    turn = getattr(message, 'orientation', getattr(message, 'rotation', None))
    if turn is None:
        return place.x, place.y, place.z
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    length = np.linalg.norm(quaternion)
    if abs(length - 1.0) > LENGTH_TOLERANCE:
        quaternion[:] = np.nan
    return place.x, place.y, place.z, *quaternion


def _places(topic: str, kind: str, message: Any) -> Iterator[tuple[str, Any, tuple[float, ...]]]:
    """Yield name, header and numbers (as `_place`) of each point, pose or transform in a message.

    The name is the topic, the child frame of a transform, or ``topic/name`` of a body or
    marker. `kind`: type of the message, a key of `PLACES` (one point or pose) or `SEVERAL` (a
    list).
    """
    if kind in PLACES:
        yield topic, message.header, _place(message, PLACES[kind])
        return
    for item in getattr(message, SEVERAL[kind]):
        if hasattr(item, 'child_frame_id'):
            yield item.child_frame_id, item.header, _place(item, 'transform')
        elif hasattr(item, 'rigid_body_name'):
            yield f'{topic}/{item.rigid_body_name}', message.header, _place(item, 'pose')
        else:
            name = item.marker_name or item.marker_index
            yield f'{topic}/{name}', message.header, _place(item, 'translation')


def read_bag(
    path: Path,
    chain: SerialChain,
    joint_topics: Sequence[str] = (),
    point_topics: Sequence[str] = (),
    length: str = '',
    clock_offset_s: float | None = None,
    links: Container[str] = (),
) -> RawRows:
    """Rows of a bag: the mean point of each sensor at each standstill of the joints, in order.

    Each topic of points is a sensor, or each name in messages that list several; names whose
    points hardly move are then left out, unless the user named topics. A bag of
    robot_calibration has a row for each measurement instead.

    Parameters
    ----------
    joint_topics, point_topics
        Topics that the user named; () for all that fit.
    length
        Unit of the points if it is not the metre of ROS; '' for the metre.
    clock_offset_s
        Offset, s, added to the stamps of the points to have those of the joints; None to find
        it.
    links
        Links of the robot, whose transforms the robot computes and no sensor measures.

    Raises
    ------
    InputError
        No such topics, several with joint states or poses, no standstill (0.5 s) with a point
        in it, numbers beyond any arm or sensor, an arm with a prismatic joint, or a damaged
        bag.
    """
    refuse_sliding(chain, path)
    bag = _Bag.of(path, chain, joint_topics, point_topics, length, links)
    if isinstance(bag, RawRows):
        return bag
    rows = _Rows(path, chain, bag.joints.stream(), bag.joint_topic, clock_offset_s)
    for topic, points in sorted(bag.points.items()):
        rows.add(topic, points.stream(bag.scale))
    return rows.raw(sorted(bag.points), length or 'm', bag.unused)


def read_streams(
    path: Path,
    chain: SerialChain,
    joint_topics: Sequence[str] = (),
    point_topics: Sequence[str] = (),
    length: str = '',
    links: Container[str] = (),
    names: Mapping[str, tuple[str, str]] = MappingProxyType({}),
) -> tuple[Stream, list[MarkerStream], dict[str, str]]:
    """Read the joint states and marker positions of a bag, as they were recorded.

    Topics with the same first part, and the names in messages that list several, are markers
    of one sensor.

    Parameters
    ----------
    joint_topics, point_topics, length, links
        As of `read_bag`.
    names
        Topic -> sensor and marker, if they are known; others are named by the topic.

    Returns
    -------
    Stream, list of MarkerStream, dict
        Joint positions, rad, (n, k); positions of each marker, m; and what each topic is used
        as, a phrase such as 'marker sir of sensor mocap, m' or 'not used', by its name.

    Raises
    ------
    InputError
        No such topics, several with joint states or poses, numbers beyond any arm or sensor, a
        bag of robot_calibration (single measurements), or a damaged bag.
    """
    bag = _Bag.of(path, chain, joint_topics, point_topics, length, links)
    if isinstance(bag, RawRows):
        raise InputError(
            f'{path}: holds measurements of standstills ({CALIBRATION_DATA}), none of a moving '
            'arm; import it without --moving'
        )
    found, taken = [], set()
    columns = {bag.joint_topic: f'joint angles ({", ".join(chain.joint_names)}), rad'}
    for name, points in sorted(bag.points.items()):
        topic = bag.topic_of[name]
        parts = [part for part in topic.strip('/').split('/') if part]
        own_name = name.rpartition('/')[2] if name != topic else '_'.join(parts[1:])
        sensor, marker = names.get(name, (parts[0], own_name or 'marker'))
        if marker in taken:
            marker = f'{sensor}_{marker}'
        taken.add(marker)
        columns[name] = f'marker {marker} of sensor {sensor}, {length or "m"}'
        stamps, values = np.array(points.stamps), np.array(points.values, dtype=float)[:, :3]
        found.append(MarkerStream(sensor, marker, Stream.of(stamps, bag.scale * values)))
    columns |= {topic: 'not used' for topic in bag.unused if topic not in columns}
    return bag.joints.stream(), found, columns


@dataclass(frozen=True, eq=False)
class _Bag:
    """Joint states and measured points of a bag, as recorded, by topic."""

    joint_topic: str
    joints: _Topic
    points: Mapping[str, _Topic]  # By topic, or by name in messages of several
    topic_of: Mapping[str, str]  # Of each of these
    unused: dict[str, str]  # Topic -> type of the message, of topics without points
    scale: float  # Unit of the points, m

    @classmethod
    def of(
        cls,
        path: Path,
        chain: SerialChain,
        joint_topics: Sequence[str],
        point_topics: Sequence[str],
        length: str,
        links: Container[str],
    ) -> _Bag | RawRows:
        """Read a bag; of a bag of robot_calibration return its rows instead.

        Arguments as of `read_bag`. Raises InputError for a damaged bag, without joint states
        of this arm or without points, for several topics of joint states or of poses, and for
        numbers beyond any arm or sensor.
        """
        joints: dict[str, _Topic] = defaultdict(_Topic)
        found: dict[str, dict[str, _Topic]] = {kind: defaultdict(_Topic) for kind in _KINDS}
        calibration: list[tuple[float, Any]] = []
        seen: dict[str, str] = {}
        of: dict[str, str] = {}
        for topic, kind, message, log_s in _messages(path, seen):
            if kind == CALIBRATION_DATA:
                calibration.append((log_s, message))
            elif kind == JOINT_STATE:
                if joint_topics and topic not in joint_topics:
                    continue
                position = dict(zip(message.name, message.position))
                if all(name in position for name in chain.joint_names):
                    joints[topic].stamps.append(_stamp(message.header, log_s))
                    joints[topic].values.append([position[name] for name in chain.joint_names])
            else:
                for name, header, place in _places(topic, kind, message):
                    if point_topics and not {topic, name} & {*point_topics}:
                        continue
                    if name not in links:
                        found[kind][name].stamps.append(_stamp(header, log_s))
                        found[kind][name].values.append(place)
                        of[name] = topic
        if calibration:
            return rows_of(path, calibration, chain, point_topics, length)
        joint_topic = _joint_topic(path, joints, seen, chain)
        kind = next((kind for kind in _KINDS if found[kind]), '')
        if not kind:
            raise InputError(
                f'{path}: no geometry_msgs/PointStamped or PoseStamped, and no transform of a '
                f'frame that is no link of the robot; it has {_topics(seen)}'
            )
        points = found[kind]
        scale = LENGTHS[length or 'm']
        _require_sensible(path, joints[joint_topic], points, scale)
        if kind in SEVERAL and not point_topics:
            # Frames of a camera and of the room stand still.
            extent = {
                name: np.ptp(np.array(series.values)[:, :3], axis=0).max()
                for name, series in points.items()
            }
            points = {
                name: series
                for name, series in points.items()
                if extent[name] > STATIC * max(extent.values())
            } or points
        if len(points) > 1 and not point_topics and kind != next(iter(PLACES)):
            # One of them may well be where the robot believes its tool to be.
            raise InputError(
                f'{path}: poses on {", ".join(sorted(points))}; name those of the sensor with '
                '--points'
            )
        used = {of[name] for name in points}
        unused = {topic: what for topic, what in seen.items() if topic not in used}
        return cls(joint_topic, joints[joint_topic], points, of, unused, scale)


def _require_sensible(
    path: Path, joints: _Topic, points: Mapping[str, _Topic], scale: float
) -> None:
    """Raise InputError for joint angles above 1e4 rad, or points above 200 m along any axis.

    NaN, for a point that was not seen, is allowed. `scale`: unit of the points, m; `path`: for
    the message.
    """
    angles = np.array(joints.values, dtype=float)
    if np.any(np.abs(angles) > LARGEST_RAD):
        raise InputError(
            f'{path}: joint states with angles beyond {LARGEST_RAD:g} rad, which no joint takes; '
            'take another copy of the bag'
        )
    for series in points.values():
        far = np.abs(scale * np.array(series.values, dtype=float)[:, :3]) > FARTHEST_M
        if far.any():
            raise InputError(
                f'{path}: points further than {FARTHEST_M:g} m away, beyond any sensor; say their '
                'unit with --length'
            )


def _stamp(header: Any, log_s: float) -> float:
    """Stamp of a header, s; `log_s`, the time of recording, if the stamp is 0."""
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec or log_s)


def _messages(path: Path, seen: dict[str, str]) -> Iterator[tuple[str, str, Any, float]]:
    """Yield topic, type, message and time of recording, s, of joint states and points.

    Messages of other types are skipped; topic -> type of all topics is put into `seen`, in
    place. Raises InputError for a damaged bag.
    """
    # Imported here: it takes a quarter of a second, which tables need not wait for.
    from rosbags.highlevel import AnyReader

    wanted = (JOINT_STATE, CALIBRATION_DATA, *_KINDS)
    if path.suffix == '.mcap' or (path.is_dir() and any(path.glob('*.mcap'))):
        bag = BagReader(path)
        seen.update(bag.topics)
        for topic, kind, data, stamp_ns in bag:
            if kind in wanted:
                yield topic, kind, bag.decoded(kind, data), 1e-9 * stamp_ns
        return
    folder = path.parent if path.suffix == '.db3' else path
    # rosbags raises whatever bad bytes lead to.
    try:
        with AnyReader([folder], default_typestore=jazzy_types()) as reader:
            seen.update({c.topic: c.msgtype for c in reader.connections})
            kept = [c for c in reader.connections if c.msgtype in wanted]
            if not kept:
                # Of no connections rosbags gives the messages of all.
                return
            for connection, stamp_ns, data in reader.messages(connections=kept):
                message = reader.deserialize(data, connection.msgtype)
                yield connection.topic, connection.msgtype, message, 1e-9 * stamp_ns
    except Exception as error:
        what = ' '.join(str(error).split())[:120]
        raise InputError(
            f'{path}: not a bag that can be read ({type(error).__name__}: {what}); take another '
            'copy, or convert it with "ros2 bag convert"'
        ) from None


def _topics(seen: dict[str, str]) -> str:
    """Topics with their types as text; 'no topics' if there are none."""
    return ', '.join(f'{topic} ({kind})' for topic, kind in sorted(seen.items())) or 'no topics'


def _joint_topic(
    path: Path, joints: dict[str, _Topic], seen: dict[str, str], chain: SerialChain
) -> str:
    """Name of the one topic with all joints of the robot.

    If several have them, the only one that ends in ``joint_states``. Raises InputError for
    none, or if more than one is left. `joints`: topics with all joints; `seen`: topic -> type,
    for the message.
    """
    named = [topic for topic in joints if topic.endswith('joint_states')] or list(joints)
    if len(named) == 1:
        return named[0]
    if named:
        raise InputError(
            f'{path}: joint states on {", ".join(sorted(named))}; name one of them with --joints'
        )
    raise InputError(
        f'{path}: no sensor_msgs/JointState with the joints {", ".join(chain.joint_names)}; it '
        f'has {_topics(seen)}'
    )


class _Rows:
    """Rows of a bag, collected by `add`: one for each standstill of the joints and topic."""

    def __init__(
        self,
        path: Path,
        chain: SerialChain,
        joints: Stream,
        joint_topic: str,
        clock_offset_s: float | None,
    ) -> None:
        self._path, self._chain, self._joint_topic = path, chain, joint_topic
        self._still = joint_standstills(joints)
        self._clock_offset_s = clock_offset_s
        self._rows: list[tuple[int, str, FloatArray, FloatArray, int, FloatArray]] = []
        self._unsteady = self._dropped = 0
        self._matched: list[str] = []

    def add(self, topic: str, stream: Stream) -> None:
        """Add a row for each standstill of the joints: the mean of the topic's points in it.

        `stream`: points, m, or poses (n, 7). The first 0.5 s of a standstill are not used. A
        standstill without points gives no row; nor does one at which the marker was not still
        (`standstills.reading_of`), and a warning of `raw` states the number of these. Raises
        InputError if the user stated no offset between the clocks, and none is found.
        """
        still = self._still
        if not len(still) or not len(stream.stamps):
            return
        points = Stream(stream.stamps, stream.values[:, :3])
        seen = point_visits(points)
        offset = self._clock_offset_s or 0.0
        if self._clock_offset_s is None and len(seen):
            names = f'{self._path}, {topic}', self._joint_topic
            matching = match(seen, still, names, self._chain)
            self._matched.append(matching.in_words(seen, still, (topic, self._joint_topic)))
            offset = matching.offset_s or 0.0
        for j in range(len(still)):
            # A shot is taken when somebody has seen the arm at rest.
            part = between(stream, still.begin[j] - offset, still.end[j] - offset)
            if part.start == part.stop:
                continue
            reading = reading_of(points.values[part])
            if reading is None:
                self._unsteady += 1
                continue
            place, std, kept = reading
            if np.isfinite(std).all():
                self._dropped += part.stop - part.start - len(kept)
            turns = stream.values[part][kept, 3:]
            turn = mean_quaternion_xyzw(turns) if turns.size else np.full(4, np.nan)
            self._rows.append((j, topic, place, std, len(kept), turn))

    def raw(self, topics: Sequence[str], length: str, seen: dict[str, str]) -> RawRows:
        """All rows, sorted by standstill and topic. Raises InputError if there are none.

        `topics`: those with the points; `length`: unit of the points in the bag, for the texts
        only, as the rows are in m already; `seen`: topic -> type of the bag's topics, of which
        those that are not used are listed, too.
        """
        path, chain, joint_topic = self._path, self._chain, self._joint_topic
        if not self._rows:
            raise InputError(
                f'{path}: no point of {", ".join(topics)} was measured while the joints of '
                f'{joint_topic} stood still for {SWING_S:g} s ({self._unsteady} were unsteady); '
                'are the clocks of both the same?'
            )
        self._rows.sort(key=lambda row: row[:2])
        at, sensors, places, std, samples, turns = zip(*self._rows, strict=True)
        orientation = np.array(turns)
        ends, q = self._still.end[[*at]], self._still.mean[[*at]]
        position = np.array(places)
        names = {topic: topic.strip('/').split('/')[0] for topic in topics}
        if len(set(names.values())) < len(names):
            names = {topic: topic.strip('/').replace('/', '_') for topic in topics}
        what = 'points' if np.isnan(orientation).all() else 'poses'
        columns = {topic: f'{what} of sensor {names[topic]}, {length}' for topic in topics} | {
            joint_topic: f'joint angles ({", ".join(chain.joint_names)}), rad'
        }
        columns |= {topic: 'not used' for topic in seen if topic not in columns}
        unsteady = f'{self._unsteady} standstills with a marker that was not still were left out'
        dropped = f'{self._dropped} points far from all others of their standstill were left out'
        return RawRows(
            source=tuple(f'{path}, {end:.3f} s' for end in ends),
            joint_columns=chain.joint_names,
            q=q,
            from_q=np.full((len(q), len(chain)), np.nan),
            position=position,
            std=np.array(std),
            stamp_s=ends,
            labels={'sensor': [names[topic] for topic in sensors]},
            temperature_c=np.full(len(q), np.nan),
            samples=np.array(samples, dtype=float),
            columns=columns,
            description=(
                f'{path}: {len(set(at))} standstills with points; means of the points from '
                f'{SWING_S:g} s after the joints stood still',
                *self._matched,
            ),
            length_unit=length,
            orientation=orientation if np.isfinite(orientation).any() else None,
            warnings=(
                *((unsteady,) if self._unsteady else ()),
                *((dropped,) if self._dropped else ()),
            ),
        )
