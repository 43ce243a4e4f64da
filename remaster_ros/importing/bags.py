"""Rows from a ROS bag: joint states, and the points measured while the arm stood still."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.collection.frame_mean import are_too_many, of_the_marker
from remaster_ros.collection.pairing import SensorRules
from remaster_ros.errors import InputError
from remaster_ros.importing.rows import RawRows
from remaster_ros.importing.units import LENGTHS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.settling import SettleRules
from remaster_ros.session.bag import BagReader
from remaster_ros.types import FARTHEST_M, FloatArray

JOINT_STATE = 'sensor_msgs/msg/JointState'
POINT = 'geometry_msgs/msg/PointStamped'
SUFFIXES = ('.mcap', '.db3', '.bag')
# The arm may still swing so long after its encoders stand still, s.
SWING_S = 0.5
# Fewer samples have no standard deviation worth the name.
FEWEST_SAMPLES = 5


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file of one, or a folder that holds one."""
    if path.is_dir():
        return (path / 'metadata.yaml').exists() or any(
            any(path.glob(f'*{suffix}')) for suffix in SUFFIXES
        )
    return path.suffix in SUFFIXES


@dataclass(eq=False)
class _Stream:
    """Stamps and values of one topic."""

    stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and values (n, m) in the order of the stamps."""
        order = np.argsort(self.stamps, kind='stable')
        return np.array(self.stamps)[order], np.array(self.values, dtype=float)[order]


def read_bag(
    path: Path,
    chain: SerialChain,
    joint_topics: Sequence[str] = (),
    point_topics: Sequence[str] = (),
    length: str = '',
) -> RawRows:
    """Read a bag; each topic of points is a sensor.

    Parameters
    ----------
    joint_topics, point_topics
        As told; () for all that fit.
    length
        Unit of the points where it is not the metre of ROS.

    Raises
    ------
    InputError
        No such topics, no standstill with a point in it, or a damaged bag.
    """
    joints: dict[str, _Stream] = defaultdict(_Stream)
    points: dict[str, _Stream] = defaultdict(_Stream)
    seen: dict[str, str] = {}
    for topic, kind, message, log_s in _messages(path, seen):
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec or log_s
        if kind == POINT and (not point_topics or topic in point_topics):
            place = message.point
            points[topic].stamps.append(stamp)
            points[topic].values.append((place.x, place.y, place.z))
        elif kind == JOINT_STATE and (not joint_topics or topic in joint_topics):
            position = dict(zip(message.name, message.position))
            if all(name in position for name in chain.joint_names):
                joints[topic].stamps.append(stamp)
                joints[topic].values.append([position[name] for name in chain.joint_names])
    joint_topic = _joint_topic(path, joints, seen, chain)
    if not points:
        raise InputError(f'{path}: no geometry_msgs/PointStamped; it has {_topics(seen)}')
    rows = _Rows(LENGTHS[length or 'm'])
    for start, end, q in _standstills(*joints[joint_topic].arrays()):
        for topic, stream in sorted(points.items()):
            rows.add(topic, stream, start, end, q)
    return rows.raw(path, chain, joint_topic, sorted(points), length or 'm', seen)


def _messages(path: Path, seen: dict[str, str]) -> Iterator[tuple[str, str, Any, float]]:
    """Give the joint states and points of a bag of any kind; `seen` gets its topics."""
    # Imported here: it takes a quarter of a second, which tables need not wait for.
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    wanted = (JOINT_STATE, POINT)
    if path.suffix == '.mcap' or (path.is_dir() and any(path.glob('*.mcap'))):
        bag = BagReader(path)
        seen.update(bag.topics)
        for topic, kind, data, stamp_ns in bag:
            if kind in wanted:
                try:
                    message = types.deserialize_cdr(data, kind)
                except Exception as error:
                    raise _damaged(path, error) from None
                yield topic, kind, message, 1e-9 * stamp_ns
        return
    folder = path.parent if path.suffix == '.db3' else path
    # rosbags raises whatever bad bytes lead to.
    try:
        with AnyReader([folder], default_typestore=types) as reader:
            seen.update({c.topic: c.msgtype for c in reader.connections})
            kept = [c for c in reader.connections if c.msgtype in wanted]
            for connection, stamp_ns, data in reader.messages(connections=kept):
                message = reader.deserialize(data, connection.msgtype)
                yield connection.topic, connection.msgtype, message, 1e-9 * stamp_ns
    except Exception as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> InputError:
    what = ' '.join(str(error).split())[:120]
    return InputError(
        f'{path}: not a bag that can be read ({type(error).__name__}: {what}); take another copy, '
        'or convert it with "ros2 bag convert"'
    )


def _topics(seen: dict[str, str]) -> str:
    return ', '.join(f'{topic} ({kind})' for topic, kind in sorted(seen.items())) or 'no topics'


def _joint_topic(
    path: Path, joints: dict[str, _Stream], seen: dict[str, str], chain: SerialChain
) -> str:
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


def _standstills(stamps: FloatArray, q: FloatArray) -> Iterator[tuple[float, float, FloatArray]]:
    """Give begin, end (s) and mean joints (rad, (k,)) of each time that the arm stood still."""
    rules = SettleRules()
    first = 0
    low = high = q[0]
    for i in range(1, len(q) + 1):
        if i < len(q) and stamps[i] - stamps[i - 1] <= rules.max_gap_s:
            lower, higher = np.minimum(low, q[i]), np.maximum(high, q[i])
            if np.all(higher - lower <= rules.still_tolerance):
                low, high = lower, higher
                continue
        if stamps[i - 1] - stamps[first] > SWING_S:
            yield stamps[first], stamps[i - 1], q[first:i].mean(axis=0)
        if i < len(q):
            first, low, high = i, q[i], q[i]


class _Rows:
    """Rows as they are found.

    Parameters
    ----------
    unit
        Of the points, m.
    """

    def __init__(self, unit: float) -> None:
        self._unit = unit
        self._rows: list[tuple[str, float, FloatArray, FloatArray, FloatArray, int]] = []
        self._unsteady = self._dropped = 0
        self._arrays: dict[str, tuple[FloatArray, FloatArray]] = {}

    def add(self, topic: str, stream: _Stream, start: float, end: float, q: FloatArray) -> None:
        """Take the mean of the points of a standstill."""
        if topic not in self._arrays:
            self._arrays[topic] = stream.arrays()
        stamps, values = self._arrays[topic]
        part = slice(*np.searchsorted(stamps, (start + SWING_S, end)))
        points = values[part] * self._unit
        points = points[np.all(np.isfinite(points), axis=1)]
        if not len(points):
            return
        std = np.full(3, np.nan)
        if len(points) >= FEWEST_SAMPLES:
            kept = of_the_marker(points)
            dropped = len(points) - int(kept.sum())
            if are_too_many(dropped, len(points)):
                self._unsteady += 1
                return
            points = points[kept]
            self._dropped += dropped
            std = points.std(axis=0, ddof=1)
            if std.max() > SensorRules('', '').max_std_m:
                self._unsteady += 1
                return
        else:
            # Shots of an instrument: the last one is the one that was kept.
            points = points[-1:]
        self._rows.append((topic, end, q, points.mean(axis=0), std, len(points)))

    def raw(
        self,
        path: Path,
        chain: SerialChain,
        joint_topic: str,
        topics: Sequence[str],
        length: str,
        seen: dict[str, str],
    ) -> RawRows:
        """Return the rows."""
        if not self._rows:
            raise InputError(
                f'{path}: no point of {", ".join(topics)} was measured while the joints of '
                f'{joint_topic} stood still for {SWING_S:g} s ({self._unsteady} were unsteady); '
                'are the clocks of both the same?'
            )
        sensors, ends, q, places, std, samples = zip(*self._rows, strict=True)
        position = np.array(places)
        if np.abs(position).max() > FARTHEST_M:
            raise InputError(
                f'{path}: points further than {FARTHEST_M:g} m away, beyond any sensor; say their '
                'unit with --length'
            )
        names = {topic: topic.strip('/').split('/')[0] for topic in topics}
        if len(set(names.values())) < len(names):
            names = {topic: topic.strip('/').replace('/', '_') for topic in topics}
        columns = {topic: f'points of sensor {names[topic]}, {length}' for topic in topics} | {
            joint_topic: f'joint angles ({", ".join(chain.joint_names)}), rad'
        }
        columns |= {topic: 'not used' for topic in seen if topic not in columns}
        unsteady = f'{self._unsteady} standstills with a marker that was not still were left out'
        dropped = f'{self._dropped} points far from all others of their standstill were left out'
        return RawRows(
            where=tuple(f'{path}, {end:.3f} s' for end in ends),
            joint_columns=chain.joint_names,
            q=np.array(q),
            from_q=np.full((len(q), len(chain)), np.nan),
            position=position,
            std=np.array(std),
            stamp_s=np.array(ends),
            labels={'sensor': [names[topic] for topic in sensors]},
            temperature_c=np.full(len(q), np.nan),
            samples=np.array(samples, dtype=float),
            columns=columns,
            description=(
                f'{path}: {len(set(ends))} standstills with points; means of the points from '
                f'{SWING_S:g} s after the joints stood still',
            ),
            warnings=(
                *((unsteady,) if self._unsteady else ()),
                *((dropped,) if self._dropped else ()),
            ),
        )
