"""A settled configuration + joint states + marker readings -> observations, or the reason why not.

Everything is decided on the messages' own time stamps and never on their time of arrival, so a
bag replayed at any speed gives the same observations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.core.types import FloatArray, MarkerReading


@dataclass(frozen=True)
class SensorRules:
    """How one sensor's reading is taken.

    Attributes
    ----------
    sensor, marker
        Names as in the session.
    single_shot
        True for an instrument that measures on request and integrates by itself (a laser
        tracker); False for a stream that is averaged over the dwell.
    dwell_s
        Length of the average after the arm has settled, s (streams).
    min_samples
        While the dwell has fewer, it is prolonged, up to the time-out: a marker that was hidden
        for a moment costs a moment and not the configuration (streams).
    max_std_m
        A larger standard deviation on any axis over the dwell is no still marker, m (streams).
    timeout_s
        How long after the dwell (stream) or settling (single shot) a reading may stay out, s.
    """

    sensor: str
    marker: str
    single_shot: bool = False
    dwell_s: float = 0.5
    min_samples: int = 5
    max_std_m: float = 0.5e-3
    timeout_s: float = 2.0


@dataclass(frozen=True)
class PairedReading:
    """One sensor's accepted reading at one configuration.

    Attributes
    ----------
    stamp_s
        End of the dwell, or the time of the single shot, s.
    q
        Mean reported joint positions from settling to `stamp_s`, rad, (k,).
    position, std
        Mean marker position and sample standard deviation (None for a single shot), m, (3,).
    samples
        Samples in the mean.
    """

    sensor: str
    marker: str
    stamp_s: float
    q: FloatArray
    position: FloatArray
    std: FloatArray | None
    samples: int


@dataclass(frozen=True)
class Rejection:
    """Why a sensor has no observation at a configuration.

    Attributes
    ----------
    reason
        A word to count by: ``moving``, ``stale``, ``too_few``, ``unsteady`` or ``device``.
    detail
        One line with the numbers.
    """

    sensor: str
    reason: str
    detail: str


class Pairing:
    """Collect what belongs to one settled configuration and decide on each sensor.

    Parameters
    ----------
    settled_stamp_s
        When the arm was judged settled, s. Nothing captured before it is ever used.
    q_settled
        Reported joint positions then, rad, (k,).
    sensors
        The rules, one per sensor.
    motion_tolerance
        A report further than this from `q_settled` on any joint means the arm moved, rad.
    """

    def __init__(
        self,
        settled_stamp_s: float,
        q_settled: FloatArray,
        sensors: tuple[SensorRules, ...],
        motion_tolerance: float = 5e-4,
    ) -> None:
        self.settled_stamp_s = settled_stamp_s
        self.q_settled = np.asarray(q_settled, float)
        self.rules = {rules.sensor: rules for rules in sensors}
        self.motion_tolerance = motion_tolerance
        self.decided: dict[str, PairedReading | Rejection] = {}
        self._joints: list[tuple[float, FloatArray]] = []
        self._readings: dict[str, list[MarkerReading]] = {name: [] for name in self.rules}

    def add_joint_state(self, stamp_s: float, q: FloatArray) -> None:
        """Take a report of the joint positions, rad, (k,)."""
        if stamp_s > self.settled_stamp_s:
            self._joints.append((stamp_s, np.asarray(q, float)))
            self._decide(stamp_s)

    def add_reading(self, sensor: str, reading: MarkerReading) -> None:
        """Take one marker reading; older than the settling, or of an unknown sensor: ignored."""
        if sensor in self._readings and reading.stamp_s > self.settled_stamp_s:
            self._readings[sensor].append(reading)
            self._decide(reading.stamp_s)

    def fail(self, sensor: str, detail: str) -> None:
        """Note that the device itself said that there is no measurement."""
        self.decided.setdefault(sensor, Rejection(sensor, 'device', detail))

    def give_up(self, now_s: float) -> None:
        """Reject every sensor whose time is over at `now_s`."""
        for name, rules in self.rules.items():
            allowed = rules.timeout_s + (0.0 if rules.single_shot else rules.dwell_s)
            if name not in self.decided and now_s > self.settled_stamp_s + allowed:
                self.decided[name] = self._late(rules, allowed)

    @property
    def complete(self) -> bool:
        """Whether every sensor has been decided on."""
        return len(self.decided) == len(self.rules)

    def _late(self, rules: SensorRules, allowed: float) -> Rejection:
        count = len(self._readings[rules.sensor])
        if 0 < count < rules.min_samples and not rules.single_shot:
            detail = f'{count} usable samples in {allowed:.1f} s (at least {rules.min_samples})'
            return Rejection(rules.sensor, 'too_few', detail)
        what = 'no joint state followed the reading' if count else 'no reading'
        return Rejection(
            rules.sensor, 'stale', f'{what} within {allowed:.1f} s after the arm settled'
        )

    def _decide(self, stamp_s: float) -> None:
        for name, rules in self.rules.items():
            if name in self.decided:
                continue
            readings = self._readings[name]
            if rules.single_shot:
                if not readings:
                    continue
                end = readings[0].stamp_s
                used = readings[:1]
            else:
                dwell = self._dwell(rules, readings)
                if dwell is None:
                    continue
                end, used = dwell
            # Without a later joint state nobody knows that the arm stood still to the end.
            if not self._joints or self._joints[-1][0] < end:
                continue
            self.decided[name] = self._judge(rules, used, end)

    def _dwell(
        self, rules: SensorRules, readings: list[MarkerReading]
    ) -> tuple[float, list[MarkerReading]] | None:
        """End of a stream's dwell and the readings in it; None while it lasts."""
        end = self.settled_stamp_s + rules.dwell_s
        # The dwell is over for this sensor once it has sent something later than its end.
        if not readings or readings[-1].stamp_s <= end:
            return None
        used = [reading for reading in readings if reading.stamp_s <= end]
        if len(used) < rules.min_samples:
            if len(readings) < rules.min_samples:
                return None
            used = readings[: rules.min_samples]
            end = used[-1].stamp_s
            if end > self.settled_stamp_s + rules.dwell_s + rules.timeout_s:
                return None
        return end, used

    def _judge(
        self, rules: SensorRules, used: list[MarkerReading], end: float
    ) -> PairedReading | Rejection:
        stamps = np.array([stamp for stamp, _ in self._joints])
        q = np.array([joints for _, joints in self._joints])
        # The first report at or after the end is part of the proof of stillness, not of the mean.
        until = int(np.searchsorted(stamps, end)) + 1
        moved = np.max(np.abs(q[:until] - self.q_settled))
        if not moved <= self.motion_tolerance:
            detail = f'a joint moved {moved:.2e} rad (allowed {self.motion_tolerance:.1e})'
            return Rejection(rules.sensor, 'moving', detail)
        inside = q[stamps <= end]
        q_mean = inside.mean(axis=0) if len(inside) else q[0]
        positions = np.array([reading.position for reading in used]).reshape(-1, 3)
        if rules.single_shot:
            std = None
        else:
            std = positions.std(axis=0, ddof=1) if len(used) > 1 else np.zeros(3)
            if not np.all(std <= rules.max_std_m):
                detail = f'std {1e3 * std.max():.3f} mm (allowed {1e3 * rules.max_std_m:.3f} mm)'
                return Rejection(rules.sensor, 'unsteady', detail)
        return PairedReading(
            rules.sensor, rules.marker, end, q_mean, positions.mean(axis=0), std, len(used)
        )
