# SPDX-License-Identifier: Apache-2.0
"""Which settled configuration is read next, by which messages, and what becomes of it.

Stamps come with the messages. Nothing here uses clocks, files or ROS: the recorder's node
hands the messages in, takes what has ended, and writes it down.
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
"""A temperature that is older than this is not used for a reading, s."""
SET_BACK_S = 1.0
"""Stamps of joint_states that go back by more than this are those of a clock that was set, s."""
UNSEEN = 5
"""A marker that was not seen at so many configurations, where others were, is reported."""
BY_HAND = PoseAnnounced(stamp='', pose=-1_000_000, split=REGISTRATION, ids=(0,))
"""Where a user has driven the arm for a registration: the number is no planner's."""


@dataclass(frozen=True)
class SettledArm:
    """The arm stands at a joint solution of a pose: joints, rad, (k,), and since when, s.

    `change` is what a correction changed of what was wanted, rad, (k,); None where it is off.
    """

    q: FloatArray
    stamp_s: float
    pose: PoseAnnounced
    solution: int
    change: FloatArray | None = None

    @property
    def id(self) -> int:
        """The planner's own number of the solution."""
        return self.pose.ids[self.solution]

    def recorded_before(self, result: Outcome, *, registered: bool) -> ConfigurationEnded:
        """Return the event of a configuration that needs no other reading."""
        return ConfigurationEnded(
            stamp=self.pose.stamp,
            solution=self.solution,
            result=result,
            reason='recorded before',
            registered=registered,
        )


@dataclass(frozen=True)
class EndedReading:
    """What became of a configuration."""

    settled: SettledArm  # Which one
    from_q: FloatArray | None  # Where the arm came from, rad, (k,); None where that is not known
    # What each sensor gave, a reading of each of its markers that was seen, or why nothing; a
    # camera on the tool its own place in the frame of what it sees
    accepted: Sequence[PairedReading]
    rejected: Sequence[Rejection]
    left_out: Sequence[Rejection]  # Markers without a reading, of sensors that gave others
    waited_s: Mapping[str, float]  # How long the arm stood for each sensor, s
    # Stamp of the last reading that was accepted; of the last joint states where none was, s
    last_s: float
    # The last one from before the arm settled, degrees Celsius; None where that is long ago
    temperature_c: float | None

    @property
    def result(self) -> Outcome:
        """``partial`` where a sensor that was waited for has no reading."""
        if not self.accepted:
            return 'rejected'
        missed = any(item.reason not in ('not_waited', 'absent') for item in self.rejected)
        return 'partial' if missed else 'recorded'

    @property
    def why(self) -> str:
        """Why sensors have no reading; ''."""
        return '; '.join(f'{r.sensor}: {r.reason}: {r.detail}' for r in self.rejected)

    def event(self, *, registered: bool) -> ConfigurationEnded:
        """Return the event by which the others learn of it."""
        return ConfigurationEnded(
            stamp=self.settled.pose.stamp,
            solution=self.settled.solution,
            result=self.result,
            reason=self.why,
            registered=registered,
            measuring_s=self.last_s - self.settled.stamp_s,
        )


class Recording:
    """Read one settled configuration after the other.

    Parameters
    ----------
    rules
        How each sensor is read.
    motion_tolerance
        Largest joint movement during a reading, rad; of one that slides as `JointUnits` has it.
    require
        ``all``, ``any``, or the name of the sensor that the arm waits for.
    plausibility
        Judges readings by where the robot has the marker.
    units
        Those of the arm's joints.
    patient
        Whether the messages are those of a bag; see `Pairing`.

    Attributes
    ----------
    announced
        The planner's last announcement; set from outside.
    pairing
        The reading under way; None where there is none.
    q, now_s
        The last joint states, rad, (k,), and their stamp, s.
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
        self._on_tool = {one.sensor for one in rules if one.on_tool}
        self._plausibility = plausibility
        self.announced: PoseAnnounced | None = None
        self._solutions: FloatArray | None = None
        self._solutions_stamp = ''
        self.pairing: Pairing | None = None
        self._settled: SettledArm | None = None
        self._came_from: FloatArray | None = None
        self._due: deque[SettledArm] = deque(maxlen=100)
        # Topics come in no common order: what belongs to a dwell may come before the settling.
        self._joints: deque[tuple[float, FloatArray]] = deque(maxlen=4000)
        most = max(1 + len(one.further) for one in rules)
        self._readings: deque[tuple[str, MarkerReading]] = deque(maxlen=4000 * most)
        self._temperatures: deque[tuple[float, float]] = deque(maxlen=500)
        # At how many configurations in a row a marker was not seen, by sensor and marker.
        self._unseen: Counter[tuple[str, str]] = Counter()
        self.q: FloatArray | None = None
        self.now_s = 0.0
        self._from_q: FloatArray | None = None
        # Settled where no announced pose has a solution (yet): joints, rad, when, s, and change.
        self._unknown: tuple[FloatArray, float, FloatArray | None] | None = None

    # What comes in

    def take_solutions(self, stamp: str, solutions: FloatArray) -> None:
        """Take the joint solutions of an announcement, rad, (m, k); none take the pose back."""
        self._solutions_stamp = stamp if len(solutions) else ''
        self._solutions = solutions if len(solutions) else None

    def take_joints(self, stamp_s: float, q: FloatArray) -> None:
        """Take joint states, rad, (k,)."""
        if stamp_s < self.now_s - SET_BACK_S:
            # The robot's clock was set back: what is kept lies in the future of all that comes.
            self._joints.clear()
            self._readings.clear()
        self.now_s, self.q = stamp_s, q
        self._joints.append((stamp_s, q))
        if self.pairing is not None:
            self.pairing.add_joint_state(stamp_s, q)

    def take_reading(self, sensor: str, reading: MarkerReading) -> None:
        """Take a reading of a sensor."""
        self._readings.append((sensor, reading))
        if self.pairing is not None:
            self.pairing.add_reading(sensor, reading)

    def take_temperature(self, stamp_s: float, temperature_c: float) -> None:
        """Take a temperature, degrees Celsius."""
        self._temperatures.append((stamp_s, temperature_c))

    def take_settled(
        self, stamp_s: float, q: FloatArray, change: FloatArray | None = None
    ) -> bool:
        """Take it that the arm has settled; return whether it is at a known solution.

        Solutions are what was wanted: of joints, rad, (k,), that a correction has changed, the
        change is taken off first.
        Where it is not, either the planner finds by the recorder's state that the pose is not
        known here and announces it again, or the announcement is on its way.
        """
        self._unknown = None
        if self._queue(q, stamp_s, change):
            return True
        self._unknown = q, stamp_s, change
        return False

    def take_stop(self) -> None:
        """Take it that the arm was stopped on its way: where it comes from next is not known."""
        self._from_q = None

    # What is known

    @property
    def pose(self) -> PoseAnnounced | None:
        """The pose under way; None where its event or its solutions have not come."""
        pose = self.announced
        return pose if pose is not None and pose.stamp == self._solutions_stamp else None

    @property
    def is_idle(self) -> bool:
        """Whether no reading is under way and none is due."""
        return self.pairing is None and not self._due

    def _queue(self, q: FloatArray, stamp_s: float, change: FloatArray | None) -> bool:
        """Queue a configuration; return False where no solution of the pose is there."""
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
        """Take up an unknown configuration whose pose has come, if the arm still stands there."""
        if self._unknown is None or self.pose is None:
            return
        q, settled_s, change = self._unknown
        since = [joints for stamp_s, joints in self._joints if stamp_s > settled_s]
        stands = all(self._units.largest(joints - q) <= self._tolerance for joints in since)
        if not stands or self._queue(q, settled_s, change):
            self._unknown = None

    def next(self) -> SettledArm | None:
        """Return the configuration that is to be read now, once; None where none is."""
        return self._due.popleft() if self._due and self.pairing is None else None

    def begin(self, settled: SettledArm) -> None:
        """Begin to read a configuration, with the messages that came before as well."""
        self.pairing, self._settled = self._new_pairing(settled), settled
        # Now, not when the reading is done: a stop may come in between.
        self._came_from, self._from_q = self._from_q, settled.q

    def begin_by_hand(self, stamp_s: float, q: FloatArray) -> None:
        """Begin to read where a person has driven the arm: joints, rad, (k,), and since when."""
        self.begin(SettledArm(q, stamp_s, BY_HAND, 0))

    def _new_pairing(self, settled: SettledArm) -> Pairing:
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
        """Reject what does not come in time; see `Pairing.give_up`."""
        if self.pairing is not None:
            self.pairing.give_up(self.now_s, absent, words)

    def is_open(self, stamp: str, solution: int) -> bool:
        """Whether a configuration is under way or due, by its announcement's stamp and index."""
        under_way = [] if self._settled is None else [self._settled]
        return any(
            (one.pose.stamp, one.solution) == (stamp, solution) for one in (*under_way, *self._due)
        )

    @property
    def is_by_hand(self) -> bool:
        """Whether a reading for a registration by hand is under way."""
        return self._settled is not None and self._settled.pose == BY_HAND

    def end_as_recorded(self, result: str, reason: str) -> None:
        """Decide what is under way as the recorder of a bag had; see `Pairing`."""
        if self.pairing is not None:
            self.pairing.end_as_recorded(result, reason)

    def end(self, T_R_N: Mapping[str, FloatArray]) -> EndedReading | None:
        """Return what became of the configuration, once it is decided; None before.

        Parameters
        ----------
        T_R_N
            The registrations so far: sensor -> (4, 4).
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
            item = self._standing(decided)
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
            self._came_from,
            accepted,
            rejected,
            left_out,
            pairing.waited_s(),
            max((reading.stamp_s for reading in accepted), default=self.now_s),
            self._temperature_c(settled.stamp_s),
        )

    def _standing(self, item: PairedReading | Rejection) -> PairedReading | Rejection:
        """Return a reading as one of a sensor that stands: a camera on the tool has its place."""
        if isinstance(item, Rejection) or item.sensor not in self._on_tool:
            return item
        if item.orientation is None:
            detail = 'the poses have no orientation, without which one on the tool tells nothing'
            return Rejection(item.sensor, 'device', detail)
        return item.turned_round()

    def _count_unseen(self, accepted: Sequence[PairedReading]) -> None:
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
        """Which markers were not seen for long, where others of their sensor were; ''."""
        return '; '.join(
            f'{marker} of {sensor} was not seen at the last {count} configurations, and is left '
            'out: is it still on the tool, and not covered?'
            for (sensor, marker), count in self._unseen.items()
            if count >= UNSEEN
        )

    def _temperature_c(self, stamp_s: float) -> float | None:
        """Return the last temperature from before a time, if that is not long ago.

        Not that of the reading itself: it is on a topic of its own and may come after the point,
        and a replay must write what the recording wrote.
        """
        known = [item for item in self._temperatures if 0.0 <= stamp_s - item[0] < TEMPERATURE_S]
        return max(known)[1] if known else None
