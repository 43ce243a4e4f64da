# SPDX-License-Identifier: Apache-2.0
"""Observations from a settled configuration, joint states and marker readings, or reasons why not.

All decisions use the messages' own time stamps and never their time of arrival, so that a bag
replayed at any speed gives the same observations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.collection.still_frames import are_too_many, of_the_marker
from remaster_ros.kinematics.transforms import inverse_poses, mean_quaternion_xyzw
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.types import FloatArray, MarkerReading

LONGEST_GAP_S = 5.0
"""Longest time without a report of the joints, s, with the arm assumed at standstill."""
CLOCK_BACK_S = 0.1
"""Largest step back of a report's stamp, s; a larger one means a clock that was set back."""


@dataclass(frozen=True)
class SensorRules:
    """Rules for the reading of one sensor."""

    # Names as in the session
    sensor: str
    marker: str
    # True for an instrument that measures on request and integrates by itself (a laser tracker);
    # False for a stream that is averaged over the dwell
    single_shot: bool = False
    dwell_s: float = 0.5  # Length of the average after the arm has settled, s (streams)
    # Fewest samples of a dwell (streams): a dwell with fewer is prolonged, up to the time-out, so
    # that a marker hidden for a moment does not cost the configuration
    min_samples: int = 5
    # Largest standard deviation on any axis over the dwell of a marker at standstill, m (streams)
    max_std_m: float = 0.5e-3
    # Longest wait for a reading after the dwell (stream) or settling (single shot), s
    timeout_s: float = 2.0
    # Further markers: of a stream in the same frames; otherwise measured one by one, with a
    # message (NaN) after a failure
    further: tuple[str, ...] = ()
    # True for a camera on the tool, which measures the pose of a fixed target
    on_tool: bool = False

    @property
    def allowed_s(self) -> float:
        """Longest wait for a reading after the settling, s."""
        return (0.0 if self.single_shot else self.dwell_s) + self.timeout_s


@dataclass(frozen=True)
class PairedReading:
    """Accepted reading of a marker by one sensor at one configuration."""

    sensor: str
    marker: str
    stamp_s: float  # End of the dwell, or the time of the single shot, s
    q: FloatArray  # Mean reported joint positions from settling to `stamp_s`, rad or m, (k,)
    # Mean marker position and sample standard deviation (None for a single shot), m, (3,)
    position: FloatArray
    std: FloatArray | None = None
    samples: int = 1  # Number of samples in the mean
    # Mean orientation of the measured body as x, y, z, w, (4,); None if no sample has one
    orientation: FloatArray | None = None
    # Number of frames of the dwell that are not in the mean, too far from the others
    dropped: int = 0

    def inverted(self) -> PairedReading:
        """Reading with the inverse pose: of the sensor in its target, or the reverse.

        `std` stays. It must have an orientation.
        """
        assert self.orientation is not None
        position, turn = inverse_poses(self.position, self.orientation)
        return replace(self, position=position, orientation=turn)


@dataclass(frozen=True)
class Rejection:
    """Reason why a sensor, or one of its markers, has no observation at a configuration."""

    sensor: str
    # Name for counts: ``moving``, ``unseen``, ``clock``, ``stale``, ``too_few``, ``unsteady``,
    # ``scattered``, ``frozen``, ``swapped``, ``device``, ``absent`` or ``not_waited``; of a single
    # marker also ``hidden``
    reason: str
    detail: str  # One line with the numbers


class Pairing:
    """Decision on each sensor's reading at one settled configuration, from its messages.

    Parameters
    ----------
    settled_stamp_s
        Time when the arm was judged settled, s. Earlier captures are never used.
    q_settled
        Reported joint positions at that time, rad or m, (k,).
    sensors
        Rules, one per sensor.
    motion_tolerance
        Largest difference of a report from `q_settled` on any joint at standstill, rad.
    require
        Sensors that the arm waits for: ``all``, ``any`` of them, or one by its name. A sensor that
        is not required and has no reading by then is left out.
    units
        Units of the joints.
    patient
        Whether no sensor is late before `end_as_recorded`: the messages do not show how long a
        sensor was silent.

    Attributes
    ----------
    decided
        Decision on each sensor. A reading of one of its markers is enough.
    further
        Readings of further markers in the same frames, of sensors that have a reading.
    left_out
        Markers without a reading, of sensors that have one.
    """

    def __init__(
        self,
        settled_stamp_s: float,
        q_settled: FloatArray,
        sensors: tuple[SensorRules, ...],
        motion_tolerance: float = 5e-4,
        require: str = 'all',
        *,
        units: JointUnits = TURNING,
        patient: bool = False,
    ) -> None:
        self._units, self._patient = units, patient
        self.settled_stamp_s = settled_stamp_s
        self.q_settled = np.asarray(q_settled, float)
        self.rules = {rules.sensor: rules for rules in sensors}
        self.motion_tolerance = motion_tolerance
        self.require = require
        self.decided: dict[str, PairedReading | Rejection] = {}
        self.further: dict[str, list[PairedReading]] = {}
        self.left_out: list[Rejection] = []
        self._decided_s: dict[str, float] = {}
        self._now_s = self._looked_s = settled_stamp_s
        self._excused_s = dict.fromkeys(self.rules, 0.0)
        self._silent_s = dict.fromkeys(self.rules, 0.0)
        self._message_counts: dict[str, int] = {}
        self._joints: list[tuple[float, FloatArray]] = []
        self._readings: dict[str, list[MarkerReading]] = {name: [] for name in self.rules}

    def add_joint_state(self, stamp_s: float, q: FloatArray) -> None:
        """Add a report of the joint positions, rad or m, (k,), in the order of arrival.

        A stamp that goes back by more than `CLOCK_BACK_S` rejects all undecided sensors
        (``clock``); another one that does not advance is ignored.
        """
        if self._joints and stamp_s < self._now_s - CLOCK_BACK_S:
            detail = f'the clock of joint_states went back by {self._now_s - stamp_s:.1f} s'
            self._reject_undecided('clock', detail)
        elif stamp_s > self._now_s:
            self._now_s = stamp_s
            self._joints.append((stamp_s, np.asarray(q, float)))
            self._decide()

    def add_reading(self, sensor: str, reading: MarkerReading) -> None:
        """Add one marker reading, unless it is older than the settling or of an unknown sensor."""
        if sensor in self._readings and reading.stamp_s > self.settled_stamp_s:
            self._readings[sensor].append(reading)
            self._decide()

    def fail(self, sensor: str, detail: str) -> None:
        """Reject a sensor (``device``), whose device reported that there is no measurement.

        An earlier decision stays. ``detail``: the device's reason.
        """
        self._set(Rejection(sensor, 'device', detail))

    def give_up(
        self,
        now_s: float,
        absent: Collection[str] = (),
        message_counts: Mapping[str, int] | None = None,
    ) -> None:
        """Decide on every sensor whose time is over at `now_s`: by its readings, else reject it.

        A cut cable shows only when the heartbeat is over, and simulated time may run faster: a
        required sensor is not rejected before another message of its node has come; if the node
        turns out to be absent, the whole time without messages is excused.

        Parameters
        ----------
        now_s
            Stamp of the latest joint state, s.
        absent
            Sensors that are absent now: a required one is waited for, and the time is not counted;
            another one is left out.
        message_counts
            Number of messages of each sensor's node (`Liveness.reports`); without it, or for a
            sensor that is not in it, a time without messages is not counted.
        """
        passed = max(now_s - self._looked_s, 0.0)
        self._looked_s = now_s
        for name in absent:
            if name in self.rules and self.is_required(name):
                self._excused_s[name] += self._silent_s[name] + passed
                self._silent_s[name] = 0.0
            elif name in self.rules:
                self._set(Rejection(name, 'absent', 'it is not there, and not required'))
        self._add_silence(message_counts or {}, passed, absent)
        for name, rules in self.rules.items():
            allowed = self._allowed_s(rules)
            unsure = self.is_required(name) and self._silent_s[name] > 0.0
            if now_s <= self.settled_stamp_s + allowed or unsure or name in self.decided:
                continue
            used = self._used(rules, waits=False)
            if used and self._joints and self._joints[-1][0] >= used[0]:
                self._settle(rules, *used)
            else:
                self._set(self._late(rules, allowed))

    def end_as_recorded(self, result: str, reason: str) -> None:
        """Decide on every sensor now, at the point where the recorder of a bag had decided.

        A sensor without a decision is decided by its readings if its time is over, they are
        usable, and a joint state has come since the end of its measurement. Otherwise it is
        rejected: as ``absent`` if the recorder's result was ``recorded``, else as ``stale``.
        ``result, reason``: as published by the recorder (`events.ConfigurationEnded`); the reason
        becomes the detail of these rejections.
        """
        for name, rules in self.rules.items():
            if name in self.decided:
                continue
            late = self._now_s > self.settled_stamp_s + rules.allowed_s
            used = self._used(rules, waits=False) if late else None
            if used and self._joints and self._joints[-1][0] >= used[0]:
                self._settle(rules, *used)
            else:
                kind = 'absent' if result == 'recorded' else 'stale'
                self._set(Rejection(name, kind, reason or 'as recorded'))

    def _add_silence(
        self, counts: Mapping[str, int], passed_s: float, absent: Collection[str]
    ) -> None:
        """Add the time since the last call to the silence of each sensor's node, s.

        Silence: time without a message of the node, as far as it is not excused. It is set to
        0 if a message came, if the sensor is absent, or if ``counts`` does not have it.
        ``counts``: number of messages by sensor; ``passed_s``: time since the last call, s.
        """
        for name in self.rules:
            same = name in counts and counts[name] == self._message_counts.get(name)
            silent = same and name not in absent
            self._silent_s[name] = self._silent_s[name] + passed_s if silent else 0.0
        self._message_counts = dict(counts)

    def has_reading(self, sensor: str) -> bool:
        """Whether any reading of a sensor has arrived, NaN included; KeyError if it is unknown."""
        return bool(self._readings[sensor])

    def is_required(self, sensor: str) -> bool:
        """Whether the arm waits for this sensor: `require` is its name, ``all`` or ``any``."""
        return self.require in ('all', 'any', sensor)

    @property
    def complete(self) -> bool:
        """Whether the arm needs to wait no longer: all sensors are decided, or the required one.

        With ``any``: once one of them has a reading.
        """
        if len(self.decided) == len(self.rules):
            return True
        if self.require == 'any':
            return any(isinstance(item, PairedReading) for item in self.decided.values())
        return self.require in self.decided

    def finish(self) -> None:
        """Reject undecided sensors, for which the arm did not wait, as ``not_waited``."""
        self._reject_undecided('not_waited', f'the arm waits for {self.require}')

    def waited_s(self) -> dict[str, float]:
        """Time that the arm waited for each sensor, s: from the decision before it to its own.

        The first from the settling; 0 for a sensor that is not decided.
        """
        waited, since = dict.fromkeys(self.rules, 0.0), self.settled_stamp_s
        for name, at in sorted(self._decided_s.items(), key=lambda item: item[1]):
            waited[name], since = at - since, at
        return waited

    def _set(self, item: PairedReading | Rejection) -> None:
        """Set the decision on a sensor and its time; an earlier decision stays."""
        if item.sensor not in self.decided:
            self.decided[item.sensor] = item
            self._decided_s[item.sensor] = self._now_s

    def _reject_undecided(self, reason: str, detail: str) -> None:
        """Reject all sensors without a decision.

        ``reason``: the category, such as ``clock``; ``detail``: one line with the numbers.
        """
        for name in self.rules:
            self._set(Rejection(name, reason, detail))

    def _allowed_s(self, rules: SensorRules) -> float:
        """Longest wait for a sensor after the settling, s, with the time excused by its absence.

        Infinite if the pairing is ``patient``.
        """
        return np.inf if self._patient else rules.allowed_s + self._excused_s[rules.sensor]

    def _late(self, rules: SensorRules, allowed: float) -> Rejection:
        """Rejection of a sensor after `allowed` s: too few samples, or none that can be used.

        ``too_few`` for a stream with some, but fewer than `min_samples`; else ``stale``.
        """
        count = max(len(_seen(part)) for part in self._by_marker(rules).values())
        if 0 < count < rules.min_samples and not rules.single_shot:
            detail = f'{count} usable samples in {allowed:.1f} s (at least {rules.min_samples})'
            return Rejection(rules.sensor, 'too_few', detail)
        what = 'no joint state followed the reading' if count else 'no reading'
        detail = f'{what} within {allowed:.1f} s after the arm settled'
        return Rejection(rules.sensor, 'stale', detail)

    def _decide(self) -> None:
        """Decide on each sensor whose readings are complete and followed by a joint state."""
        for name, rules in self.rules.items():
            used = None if name in self.decided else self._used(rules)
            # Only a joint state after the end of the dwell shows standstill until the end.
            if used and self._joints and self._joints[-1][0] >= used[0]:
                self._settle(rules, *used)

    def _settle(
        self, rules: SensorRules, end: float, used: Mapping[str, list[MarkerReading]]
    ) -> None:
        """Decide on a sensor by the readings of its markers up to the end of the measurement.

        ``end``: s; ``used``: of `_used`. Its first accepted marker decides; others go to `further`
        and `left_out`. If none is accepted, the first rejection decides.
        """
        judged = [self._judge(rules, end, marker, part) for marker, part in used.items()]
        accepted = [item for item in judged if isinstance(item, PairedReading)]
        if not accepted:
            self._set(judged[0])
            return
        self._set(accepted[0])
        self.further[rules.sensor] = accepted[1:]
        self.left_out += [item for item in judged if isinstance(item, Rejection)]
        self.left_out += [
            Rejection(rules.sensor, 'hidden', f'{marker} was not seen')
            for marker in (rules.marker, *rules.further)
            if marker not in used
        ]

    def _by_marker(self, rules: SensorRules) -> dict[str, list[MarkerReading]]:
        """Readings of each of a sensor's markers, by name; [] for one without readings."""
        readings = self._readings[rules.sensor]
        if not rules.further:
            return {rules.marker: readings}
        return {
            name: [reading for reading in readings if (reading.marker or rules.marker) == name]
            for name in (rules.marker, *rules.further)
        }

    def _used(
        self, rules: SensorRules, *, waits: bool = True
    ) -> tuple[float, dict[str, list[MarkerReading]]] | None:
        """End of a measurement, s, and each marker's visible readings; None while it lasts.

        A single-shot sensor: the first reading of each marker. A stream: the readings until
        the end of the dwell; if no marker has `min_samples` by then, until the first marker
        has so many. Markers with fewer are left out. ``waits``: whether to wait for messages
        of every marker of the sensor; if False, those that have sent none are taken to be
        hidden.
        """
        if not self._readings[rules.sensor]:
            return None
        parts = self._by_marker(rules)
        seen = {name: _seen(part) for name, part in parts.items()}
        if rules.single_shot:
            shots = {name: part[:1] for name, part in seen.items() if part}
            if not shots or (waits and not all(parts.values())):
                return None
            return max(part[0].stamp_s for part in shots.values()), shots

        def within(end: float) -> dict[str, list[MarkerReading]]:
            used = {
                name: [reading for reading in part if reading.stamp_s <= end]
                for name, part in seen.items()
            }
            return {name: part for name, part in used.items() if len(part) >= rules.min_samples}

        end = self.settled_stamp_s + rules.dwell_s
        # The dwell is over for a marker once a later message has arrived: every frame has a
        # message of every marker, hidden or not.
        over = [bool(part) and part[-1].stamp_s > end for part in parts.values()]
        if not any(over) or (waits and not all(over)):
            return None
        if used := within(end):
            return end, used
        # A damaged stamp has no order.
        enough = [
            sorted(reading.stamp_s for reading in part)[rules.min_samples - 1]
            for part in seen.values()
            if len(part) >= rules.min_samples
        ]
        end = min(enough, default=np.inf)
        if end > self.settled_stamp_s + self._allowed_s(rules):
            return None
        # Other markers of the same frame may still arrive.
        complete = all(part and part[-1].stamp_s >= end for part in parts.values())
        return (end, within(end)) if complete or not waits else None

    def _judge(
        self, rules: SensorRules, end: float, marker: str, used: list[MarkerReading]
    ) -> PairedReading | Rejection:
        """Paired mean of a marker's used readings until `end`, s, or a Rejection.

        In this order: ``moving`` (`motion_tolerance`), ``unseen`` (`LONGEST_GAP_S`), and of a
        stream ``scattered`` (`of_the_marker`), ``unsteady`` (`max_std_m`) and ``frozen`` (all the
        same).
        """
        if rules.single_shot:
            end = used[0].stamp_s
        stamps = np.array([stamp for stamp, _ in self._joints])
        q = np.array([joints for _, joints in self._joints])
        # The first report at or after the end proves standstill and is not in the mean.
        until = int(np.searchsorted(stamps, end)) + 1
        moved = np.max(np.abs(q[:until] - self.q_settled), axis=0)
        if not self._units.largest(moved) <= self.motion_tolerance:
            detail = self._moved_text(moved)
            return Rejection(rules.sensor, 'moving', detail)
        gap = float(np.max(np.diff(stamps[:until], prepend=self.settled_stamp_s)))
        if gap > LONGEST_GAP_S:
            detail = f'no report of the joints for {gap:.1f} s (or their clock jumped)'
            return Rejection(rules.sensor, 'unseen', detail)
        inside = q[stamps <= end]
        q_mean = inside.mean(axis=0) if len(inside) else q[0]
        positions = np.array([reading.position for reading in used]).reshape(-1, 3)
        std, dropped = None, 0
        if not rules.single_shot:
            kept = of_the_marker(positions)
            dropped = int(np.sum(~kept))
            if are_too_many(dropped, len(used)) or len(used) - dropped < rules.min_samples:
                detail = (
                    f'{dropped} of {len(used)} frames are far from the others: damaged on their '
                    'way, or another marker in between?'
                )
                return Rejection(rules.sensor, 'scattered', detail)
            used = [reading for reading, keep in zip(used, kept, strict=True) if keep]
            positions = positions[kept]
            std = positions.std(axis=0, ddof=1) if len(used) > 1 else np.zeros(3)
            if not np.all(std <= rules.max_std_m):
                detail = f'std {1e3 * std.max():.3f} mm (allowed {1e3 * rules.max_std_m:.3f} mm)'
                return Rejection(rules.sensor, 'unsteady', detail)
            if len(used) > 1 and not np.any(np.ptp(positions, axis=0)):
                detail = f'{len(used)} readings are the same to the last bit'
                return Rejection(rules.sensor, 'frozen', detail)
        turns = [reading.orientation for reading in used if reading.orientation is not None]
        turn = mean_quaternion_xyzw(turns) if turns else None
        mean, count = positions.mean(axis=0), len(used)
        return PairedReading(rules.sensor, marker, end, q_mean, mean, std, count, turn, dropped)

    def _moved_text(self, moved: FloatArray) -> str:
        """Text with the largest of the joint movements (k,) and the allowed one, rad or mm."""
        joint, allowed = self._units.farthest(moved), self.motion_tolerance
        if self._units.slide(joint):
            allowed *= self._units.per_radian[joint]
            return f'a joint moved {1e3 * moved[joint]:.3f} mm (allowed {1e3 * allowed:.3f})'
        return f'a joint moved {moved[joint]:.2e} rad (allowed {allowed:.1e})'


def _seen(readings: list[MarkerReading]) -> list[MarkerReading]:
    """Readings with a visible marker, in order."""
    return [reading for reading in readings if reading.seen]
