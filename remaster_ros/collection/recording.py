# SPDX-License-Identifier: Apache-2.0
"""Recording of settled configurations: order of their readings, messages of each, and outcomes.

Stamps come with the messages. Nothing here uses clocks, files or ROS: the recorder's node passes
the messages in, takes the outcomes, and writes them.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from remaster_ros.collection.events import ConfigurationEnded, Outcome, PoseAnnounced
from remaster_ros.collection.pairing import PairedReading, Pairing, Rejection, SensorRules
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.motion.joint_units import TURNING, JointUnits
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, nearest_solution
from remaster_ros.types import FloatArray, MarkerReading

TEMPERATURE_S = 600.0
"""Largest age of a temperature for a reading, s."""
SET_BACK_S = 1.0
"""Largest step back of joint_states' stamps, s; a larger one means a clock that was set back."""
UNSEEN = 5
"""Number of configurations without a marker, with others visible, from which it is reported."""
BY_HAND = PoseAnnounced(stamp='', pose=-1_000_000, split=REGISTRATION, ids=(0,))
"""Pose to which a user has driven the arm for a registration; its number is not a planner's."""


@dataclass(frozen=True)
class SettledArm:
    """Arm at a joint solution of a pose: joints, rad, (k,), and time of settling, s.

    `change` is the change of the wanted joints by a correction, rad, (k,); None without one.
    """

    q: FloatArray
    stamp_s: float
    pose: PoseAnnounced
    solution: int
    change: FloatArray | None = None

    @property
    def id(self) -> int:
        """Planner's number of the solution."""
        return self.pose.ids[self.solution]

    def recorded_before(self, result: Outcome, *, registered: bool) -> ConfigurationEnded:
        """Event that this configuration was recorded before and needs no further reading.

        ``result``: outcome that was recorded then; ``registered``: whether every sensor that
        the arm waits for is registered.
        """
        return ConfigurationEnded(
            stamp=self.pose.stamp,
            solution=self.solution,
            result=result,
            reason='recorded before',
            registered=registered,
        )


@dataclass(frozen=True)
class EndedReading:
    """Outcome of a configuration: its readings, and why others are missing."""

    settled: SettledArm  # The configuration
    from_q: FloatArray | None  # Configuration before the motion, rad, (k,); None if unknown
    # Readings of each sensor's visible markers, and reasons without a reading; of a camera on the
    # tool its own pose in the frame of its target
    accepted: Sequence[PairedReading]
    rejected: Sequence[Rejection]
    left_out: Sequence[Rejection]  # Markers without a reading, of sensors with other readings
    waited_s: Mapping[str, float]  # Waiting time of the arm for each sensor, s
    # Stamp of the last accepted reading, or of the last joint states if none was accepted, s
    last_s: float
    # Last temperature before the arm settled, degrees Celsius; None if that is long ago
    temperature_c: float | None

    @property
    def result(self) -> Outcome:
        """Outcome: ``rejected`` without readings, ``partial`` if some are missing, ``recorded``.

        Readings are missing of sensors that were rejected for another reason than
        ``not_waited`` or ``absent``.
        """
        if not self.accepted:
            return 'rejected'
        missed = any(item.reason not in ('not_waited', 'absent') for item in self.rejected)
        return 'partial' if missed else 'recorded'

    @property
    def why(self) -> str:
        """Reasons why sensors have no reading, as one text; '' if no sensor was rejected."""
        return '; '.join(f'{r.sensor}: {r.reason}: {r.detail}' for r in self.rejected)

    def event(self, *, registered: bool) -> ConfigurationEnded:
        """Event that informs the other nodes of the outcome.

        ``registered``: whether every sensor that the arm waits for is registered.
        """
        return ConfigurationEnded(
            stamp=self.settled.pose.stamp,
            solution=self.settled.solution,
            result=self.result,
            reason=self.why,
            registered=registered,
            measuring_s=self.last_s - self.settled.stamp_s,
        )


class Recording:
    """Readings of settled configurations, one after the other.

    Parameters
    ----------
    rules
        Rules for the reading of each sensor.
    motion_tolerance
        Largest joint movement during a reading, rad; for a slide as in `JointUnits`.
    require
        ``all``, ``any``, or the name of the sensor that the arm waits for.
    plausibility
        Judges readings by the marker positions of the robot's model.
    units
        Units of the arm's joints.
    patient
        Whether the messages are those of a bag; see `Pairing`.

    Attributes
    ----------
    announced
        Last announcement of the planner; set from outside.
    pairing
        Present reading; None if there is none.
    q, now_s
        Last joint states, rad, (k,), and their stamp, s.
    """

    def __init__(
        self,
        rules: tuple[SensorRules, ...],
        motion_tolerance: float,
        require: str,
        plausibility: Plausibility,
        *,
        units: JointUnits = TURNING,
        patient: bool = False,
    ) -> None:
        self._units, self._patient = units, patient
        self._rules, self._tolerance, self._require = rules, motion_tolerance, require
        self._on_tool = {rule.sensor for rule in rules if rule.on_tool}
        self._plausibility = plausibility
        self.announced: PoseAnnounced | None = None
        self._solutions: FloatArray | None = None
        self._solutions_stamp = ''
        self.pairing: Pairing | None = None
        self._settled: SettledArm | None = None
        self._previous_q: FloatArray | None = None
        self._due: deque[SettledArm] = deque(maxlen=100)
        # Topics have no common order: messages of a dwell may arrive before the settling.
        self._joints: deque[tuple[float, FloatArray]] = deque(maxlen=4000)
        most = max(1 + len(rule.further) for rule in rules)
        self._readings: deque[tuple[str, MarkerReading]] = deque(maxlen=4000 * most)
        self._temperatures: deque[tuple[float, float]] = deque(maxlen=500)
        # Number of successive configurations without the marker, by sensor and marker.
        self._unseen: Counter[tuple[str, str]] = Counter()
        self.q: FloatArray | None = None
        self.now_s = 0.0
        self._from_q: FloatArray | None = None
        # Settled configuration without an announced solution (yet): joints, rad, time, s, change.
        self._unknown: tuple[FloatArray, float, FloatArray | None] | None = None

    # What comes in

    def take_solutions(self, stamp: str, solutions: FloatArray) -> None:
        """Process the joint solutions of an announcement, rad, (m, k).

        With m = 0 the pose is withdrawn.
        """
        self._solutions_stamp = stamp if len(solutions) else ''
        self._solutions = solutions if len(solutions) else None

    def take_joints(self, stamp_s: float, q: FloatArray) -> None:
        """Process joint states: stamp, s, and positions, rad or m, (k,).

        A stamp that goes back by more than `SET_BACK_S` clears what is stored.
        """
        if stamp_s < self.now_s - SET_BACK_S:
            # The robot's clock was set back: stored messages are later than all new ones.
            self._joints.clear()
            self._readings.clear()
        self.now_s, self.q = stamp_s, q
        self._joints.append((stamp_s, q))
        if self.pairing is not None:
            self.pairing.add_joint_state(stamp_s, q)

    def take_reading(self, sensor: str, reading: MarkerReading) -> None:
        """Process a reading of a sensor: it is stored, and added to the reading under way."""
        self._readings.append((sensor, reading))
        if self.pairing is not None:
            self.pairing.add_reading(sensor, reading)

    def take_temperature(self, stamp_s: float, temperature_c: float) -> None:
        """Store a temperature, °C, with its stamp, s, for later configurations."""
        self._temperatures.append((stamp_s, temperature_c))

    def take_settled(
        self, stamp_s: float, q: FloatArray, change: FloatArray | None = None
    ) -> bool:
        """Process that the arm has settled; return whether it is at a known solution.

        If so, the configuration is queued to be read. Solutions are wanted joints: if a
        correction has changed the joints, rad, (k,), that ``change`` is subtracted first. At
        an unknown solution, either the planner finds by the recorder's state that the pose is
        not known here and announces it again, or the announcement has not arrived yet: see
        `look_again`. ``stamp_s``: when it settled.
        """
        self._unknown = None
        if self._queue(q, stamp_s, change):
            return True
        self._unknown = q, stamp_s, change
        return False

    def take_stop(self) -> None:
        """Note that the arm was stopped during a motion: where its next one starts is unknown.

        The `from_q` of the next reading is None; a reading under way is not changed.
        """
        self._from_q = None

    # What is known

    @property
    def pose(self) -> PoseAnnounced | None:
        """Present pose; None if its event or its solutions have not arrived."""
        pose = self.announced
        return pose if pose is not None and pose.stamp == self._solutions_stamp else None

    @property
    def is_idle(self) -> bool:
        """Whether no reading is in progress and no configuration is queued to be read."""
        return self.pairing is None and not self._due

    def _queue(self, q: FloatArray, stamp_s: float, change: FloatArray | None) -> bool:
        """Queue a configuration to be read; False, and nothing, if the pose has no such solution.

        False also if no pose is known. ``change``: by a correction, subtracted from q, rad or m,
        (k,). ``stamp_s``: when the arm settled.
        """
        pose = self.pose
        if pose is None or self._solutions is None:
            return False
        wanted = q if change is None else q - change
        solution = nearest_solution(self._solutions, wanted, self._units)
        if solution is None:
            return False
        self._due.append(SettledArm(q, stamp_s, pose, solution, change))
        return True

    # The readings, one after the other

    def look_again(self) -> None:
        """Queue an unknown configuration once its pose is known, if the arm still stands there.

        It stands if no joint has moved by more than the tolerance since; else it is forgotten.
        """
        if self._unknown is None or self.pose is None:
            return
        q, settled_s, change = self._unknown
        since = [joints for stamp_s, joints in self._joints if stamp_s > settled_s]
        stands = all(self._units.largest(joints - q) <= self._tolerance for joints in since)
        if not stands or self._queue(q, settled_s, change):
            self._unknown = None

    def next(self) -> SettledArm | None:
        """Remove the next configuration from the queue, and return it; None if there is none.

        None, without a change, while a reading is in progress.
        """
        return self._due.popleft() if self._due and self.pairing is None else None

    def begin(self, settled: SettledArm) -> None:
        """Begin to read a configuration, with the messages stored so far as well."""
        self.pairing, self._settled = self._new_pairing(settled), settled
        # Set now and not after the reading, as a stop may come in between.
        self._previous_q, self._from_q = self._from_q, settled.q

    def begin_by_hand(self, stamp_s: float, q: FloatArray) -> None:
        """Begin to read where a person has driven the arm: joints, rad, (k,), and time, s."""
        self.begin(SettledArm(q, stamp_s, BY_HAND, 0))

    def _new_pairing(self, settled: SettledArm) -> Pairing:
        """Pairing of a settled configuration, with the kept joint states and readings added."""
        pairing = Pairing(
            settled.stamp_s,
            settled.q,
            self._rules,
            self._tolerance,
            self._require,
            units=self._units,
            patient=self._patient,
        )
        for stamp_s, joints in self._joints:
            pairing.add_joint_state(stamp_s, joints)
        for sensor, reading in self._readings:
            pairing.add_reading(sensor, reading)
        return pairing

    def give_up(self, absent: Collection[str], words: Mapping[str, int]) -> None:
        """Reject sensors that are late in the reading under way; see `Pairing.give_up`.

        ``absent``: names of absent sensors; ``words``: number of messages of each sensor's node.
        Nothing without a reading.
        """
        if self.pairing is not None:
            self.pairing.give_up(self.now_s, absent, words)

    def is_open(self, stamp: str, solution: int) -> bool:
        """Whether a settled configuration is being read or is queued to be read.

        ``stamp``: of the announcement of its pose; ``solution``: index of its joint solution
        there.
        """
        under_way = [] if self._settled is None else [self._settled]
        return any(
            (settled_arm.pose.stamp, settled_arm.solution) == (stamp, solution)
            for settled_arm in (*under_way, *self._due)
        )

    @property
    def is_by_hand(self) -> bool:
        """Whether a reading for a registration by hand is in progress."""
        return self._settled is not None and self._settled.pose == BY_HAND

    def end_as_recorded(self, result: str, reason: str) -> None:
        """Decide the present reading as the recorder of a bag had; see `Pairing`.

        Nothing if no reading is in progress.
        """
        if self.pairing is not None:
            self.pairing.end_as_recorded(result, reason)

    def end(self, T_R_N: Mapping[str, FloatArray]) -> EndedReading | None:
        """Outcome of the configuration once it is decided; None before, and without a reading.

        The reading is over then. ``T_R_N``: registrations so far, sensor -> (4, 4).
        """
        pairing, settled = self.pairing, self._settled
        if pairing is None or settled is None or not pairing.complete:
            return None
        self.pairing = self._settled = None
        pairing.finish()
        at_reference = settled.pose.split == REFERENCE
        accepted: list[PairedReading] = []
        rejected, left_out = [], list(pairing.left_out)
        for decided in pairing.decided.values():
            item = self._in_fixed_frame(decided)
            if isinstance(item, Rejection):
                rejected.append(item)
                continue
            frame = [item, *pairing.further.get(item.sensor, ())]
            judged = self._plausibility.judge_frame(
                frame, T_R_N.get(item.sensor), anywhere=at_reference
            )
            good = [reading for reading in judged if isinstance(reading, PairedReading)]
            bad = [reading for reading in judged if isinstance(reading, Rejection)]
            accepted += good
            if good:
                left_out += bad
            else:
                rejected.append(bad[0])
        if settled.pose.split != REGISTRATION:
            self._count_unseen(accepted)
        return EndedReading(
            settled,
            self._previous_q,
            accepted,
            rejected,
            left_out,
            pairing.waited_s(),
            max((reading.stamp_s for reading in accepted), default=self.now_s),
            self._temperature_c(settled.stamp_s),
        )

    def _in_fixed_frame(self, item: PairedReading | Rejection) -> PairedReading | Rejection:
        """Decision on a sensor; a reading of a camera on the tool becomes that of a fixed sensor.

        It is the camera's pose in its target's frame then, or a Rejection (``device``) if it
        has no orientation. Other readings and rejections are returned as they are.
        """
        if isinstance(item, Rejection) or item.sensor not in self._on_tool:
            return item
        if item.orientation is None:
            detail = 'the poses have no orientation, without which one on the tool tells nothing'
            return Rejection(item.sensor, 'device', detail)
        return item.inverted()

    def _count_unseen(self, accepted: Sequence[PairedReading]) -> None:
        """Count, by marker, successive configurations at which its sensor measured only others.

        A reading of the marker ends its count; a configuration without any reading of the
        sensor is not counted.
        """
        seen = {(reading.sensor, reading.marker) for reading in accepted}
        measured = {reading.sensor for reading in accepted}
        for rules in self._rules:
            for marker in (rules.marker, *rules.further):
                key = rules.sensor, marker
                if key in seen:
                    del self._unseen[key]
                elif rules.sensor in measured:
                    self._unseen[key] += 1

    @property
    def unseen(self) -> str:
        """Markers without a reading for `UNSEEN` configurations or more, as text; ''.

        Only configurations count at which the same sensor measured others.
        """
        return '; '.join(
            f'{marker} of {sensor} was not seen at the last {count} configurations, and is left '
            'out: is it still on the tool, and not covered?'
            for (sensor, marker), count in self._unseen.items()
            if count >= UNSEEN
        )

    def _temperature_c(self, stamp_s: float) -> float | None:
        """Last temperature at or before a time, °C; None if it is `TEMPERATURE_S` old or older.

        The temperature of the reading itself is not used: it is on a separate topic and may
        come after the point, and a replay must write the same as the recording.
        """
        known = [item for item in self._temperatures if 0.0 <= stamp_s - item[0] < TEMPERATURE_S]
        return max(known)[1] if known else None
