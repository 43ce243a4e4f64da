"""Pair settled joints with marker readings; write the session and the bag; register the sensors.

What becomes of each configuration is said as an event on /remaster/status, after its observations
are on disk; the bridge moves on only then. While the disk is full the arm is held, and what is to
be written is kept and tried again.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import (
    ArmStopped,
    ConfigurationEnded,
    EventRecord,
    Outcome,
    PlannerState,
    PoseAnnounced,
    RecorderBegan,
    RecorderState,
    SensorReport,
    SetupChanged,
)
from remaster_ros.collection.pairing import PairedReading, Pairing, Rejection
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.errors import DiskError, InputError
from remaster_ros.motion.liveness import Liveness
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.messages import JointOrder, seconds, temperature_topic
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.pose_tracker import PoseTracker
from remaster_ros.nodes.recorder_parameters import Parameters, sensor_rules
from remaster_ros.nodes.registering import Registrar
from remaster_ros.nodes.retrying_writer import RetryingWriter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import EVENTS, JOINT_STATES, NodeStatus, Summary, receiver
from remaster_ros.nodes.triggered_sensors import TriggeredSensors
from remaster_ros.nodes.watching import Watching
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION
from remaster_ros.session.session_journal import SessionJournal
from remaster_ros.session.session_writer import ExitStatus
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import FloatArray, MarkerReading, Measurements, Session

TEMPERATURE_S = 600.0
"""A temperature older than this says nothing of a reading, s."""
CHECK_S = 1.0
"""How often it is looked whether the session's files are still the ones that are written, s."""
SET_BACK_S = 1.0
"""Stamps of joint_states that go back by more than this are those of a clock that was set, s."""
PAUSED = 'paused'
"""In place of a run that was paused, and whose token was lost with the recorder."""
BY_HAND = -1_000_000
"""The number of poses that a user drove to for a registration: no planner's."""


@dataclass
class _Taking:
    """A reading under way: of a configuration, or (`future`) asked for by /remaster/register."""

    pairing: Pairing
    solution: int
    pose: PoseAnnounced
    from_q: FloatArray | None
    future: Future | None = None


class Recorder(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('recorder')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        self.chain = self.cell.chain()
        self.rules = sensor_rules(self.cell, self.p)
        if self.p.require not in ('all', 'any', *self.cell.sensors):
            raise InputError(
                f'recorder: parameter require is {self.p.require!r}; it must be all, any or one '
                f'of {", ".join(self.cell.sensors)}'
            )
        streams = [name for name, sensor in self.cell.sensors.items() if not sensor.single_shot]
        self._liveness = Liveness(
            self.cell.sensors, self.p.heartbeat_s, streams, since_s=time.monotonic()
        )
        self._waited_s = dict.fromkeys(self.cell.sensors, 0.0)
        self._order = JointOrder(self.chain.joint_names)
        folder = Path(self.p.session)
        header = Session(
            urdf=self.cell.urdf_text,
            base_link=self.chain.base_link,
            tip_link=self.chain.tip_link,
            markers={name: np.array(position) for name, position in self.cell.markers.items()},
            sensors={name: sensor.marker for name, sensor in self.cell.sensors.items()},
            measurements=Measurements.empty(len(self.chain)),
            marker_std_m=self.cell.marker_std_m,
            settle_s=self.p.settle_s,
            created=datetime.now(UTC).isoformat(timespec='seconds'),
        )
        self.journal = SessionJournal(folder, header)
        self.counts: Counter[str] = Counter()
        self._trouble = self._restored = ''
        self._pose_tracker = PoseTracker(self.chain.joint_names)
        self._taking: _Taking | None = None
        self._due: deque[tuple[FloatArray, float, int, PoseAnnounced]] = deque(maxlen=100)
        # Topics come in no common order: what belongs to a dwell may be here before /settled is.
        self._recent_joints: deque[tuple[float, FloatArray]] = deque(maxlen=4000)
        self._recent_readings: deque[tuple[str, MarkerReading]] = deque(maxlen=4000)
        self._q: FloatArray | None = None
        self._now = 0.0
        self._from_q: FloatArray | None = None
        self._temperatures: deque[tuple[float, float]] = deque(maxlen=500)
        self._was_waiting = False
        # The token of the planner's run; in memory alone, so that it lives no longer than this.
        self._run = ''
        # Settled where no announced pose has a solution (yet): joints, rad, and when.
        self._unknown: tuple[FloatArray, float] | None = None
        self._checked_wall = time.monotonic()
        self._disk = RetryingWriter(lambda why: self.get_logger().error(f'the arm is held: {why}'))
        self.registrar = Registrar(self, self.cell, self.chain, self.p.max_deviation_m / 2)
        markers = {name: np.array(position) for name, position in self.cell.markers.items()}
        self._plausibility = Plausibility(self.chain, markers, self.p.max_deviation_m)
        self._watching = Watching(self.chain, markers, self.p.reference_stop_m)
        recording = self.p.bag and not self.journal.closed
        self._bag = BagRecorder(self, folder / 'bag' if recording else None)
        self._subscribe()
        # A group of its own: while it waits for the reading, what makes the reading goes on.
        self.create_service(
            Trigger,
            'remaster/register',
            self._on_register,
            callback_group=ReentrantCallbackGroup(),
        )
        self.status = NodeStatus(self, self._summary)
        for note in (*self.journal.notes, *self._bag.notes):
            self.get_logger().warning(note)
        self.registrar.add(self.journal.registration)
        self._watching.take_back(self.journal.watched, self.registrar.T_R_N)
        self.create_timer(0.05, self._look, clock=self.status.steady)

    def _subscribe(self) -> None:
        """Take each topic once, raw: into the bag as it came, then decoded."""
        bag = self._bag
        bag.subscribe(JointState, 'joint_states', self._on_joint_state, JOINT_STATES)
        bag.subscribe(JointState, 'remaster/settled', self._on_settled)
        poses = self._pose_tracker
        bag.subscribe(JointTrajectory, 'remaster/joint_solutions', poses.take_solutions)
        bag.subscribe(JointTrajectory, 'joint_trajectory_controller/joint_trajectory')
        clients = {}
        for name, sensor in self.cell.sensors.items():
            bag.subscribe(PointStamped, sensor.topic, self._on_point(name))
            bag.subscribe(Temperature, temperature_topic(sensor.topic), self._on_temperature)
            if sensor.single_shot and sensor.measure_service and self.p.call_measure:
                clients[name] = self.create_client(Trigger, sensor.measure_service)
        self._shots = TriggeredSensors(clients)
        bag.subscribe(String, EVENTS, receiver(self, self._on_record))
        bag.subscribe_rest()

    # What comes in

    def _on_point(self, sensor: str) -> Callable[[PointStamped], None]:
        def receive(message: PointStamped) -> None:
            point = message.point
            position = np.array([point.x, point.y, point.z])
            if not np.all(np.isfinite(position)):
                self.counts[f'{sensor}_not_finite'] += 1
                return
            self._liveness.reads(sensor, time.monotonic())
            reading = MarkerReading(seconds(message.header.stamp), position)
            self._recent_readings.append((sensor, reading))
            if self._taking is not None:
                self._taking.pairing.add_reading(sensor, reading)
                self._finish_if_complete()

        return receive

    def _on_joint_state(self, message: JointState) -> None:
        try:
            self._q = self._order.positions(message)
        except InputError as error:
            self._trouble = str(error)
            return
        now = seconds(message.header.stamp)
        if now < self._now - SET_BACK_S:
            # The robot's clock was set back: what is kept lies in the future of all that comes.
            self._recent_joints.clear()
            self._recent_readings.clear()
        self._now, self._trouble = now, ''
        self._recent_joints.append((self._now, self._q))
        if self._taking is not None:
            self._taking.pairing.add_joint_state(self._now, self._q)
            self._finish_if_complete()

    def _on_temperature(self, message: Temperature) -> None:
        if np.isfinite(message.temperature):
            self._temperatures.append((seconds(message.header.stamp), message.temperature))

    def _temperature_c(self, stamp_s: float) -> float | None:
        """Return the last temperature measured before a time, if that is not long ago."""
        known = [item for item in self._temperatures if 0.0 <= stamp_s - item[0] < TEMPERATURE_S]
        return max(known)[1] if known else None

    def _on_record(self, record: EventRecord) -> None:
        match record.body:
            case PoseAnnounced() as pose:
                self._on_pose(pose)
            case PlannerState() as planner:
                self._on_planner(planner)
            case SensorReport() as sensor:
                self._liveness.node_reports(
                    sensor.sensor,
                    sensor.ready,
                    sensor.message,
                    time.monotonic(),
                    record.started,
                    hidden=sensor.hidden,
                )
            case RecorderBegan():
                # From a bag: that recorder was started again here, with no reading under way.
                self._taking = None
                self._due.clear()
            case ArmStopped():
                # On its way: where it will come from next is not known.
                self._from_q = None

    def _on_pose(self, pose: PoseAnnounced) -> None:
        self._pose_tracker.announced = pose
        if pose.split not in (REFERENCE, REGISTRATION):
            self._say_change(self._watching.leave(self.registrar.T_R_N))
        if not self._disk.full and not self.journal.closed:
            # Before the arm gets there: it is held where there is no room.
            self._disk.write(partial(self.journal.follow, pose.plan))

    def _on_planner(self, planner: PlannerState) -> None:
        self._run = planner.run_held(self._run)
        self._follow_stop(planner.state)
        if self._busy() or self._due:
            return
        if planner.state == 'complete':
            self._disk.write(partial(self._close, 'complete'))
        elif planner.state == 'stopped' and self.journal.observations:
            self._disk.write(partial(self._close, 'stopped'))
        elif planner.state == 'running' and self.journal.closed == 'stopped':
            self._disk.write(self._reopen)

    # A configuration

    def _on_settled(self, message: JointState) -> None:
        try:
            q = self._order.positions(message)
        except InputError as error:
            self._trouble = str(error)
            return
        pose, solution = self._pose_tracker.now, self._pose_tracker.which(q)
        if pose is None or solution is None:
            # The planner sees by the summary what is not known here, and announces it again. Or it
            # is on its way: topics overtake each other.
            self._unknown = q, seconds(message.header.stamp)
            self.counts['settled_unknown'] += 1
            self._trouble = 'settled at no joint solution of an announced pose'
            return
        self._unknown = None
        # The bridge waits for an answer, but a bag at ten times the speed does not: what is read
        # now is finished first, by the stamps of its own messages.
        self._due.append((q, seconds(message.header.stamp), solution, pose))
        self._take_next()

    def _look_again(self) -> None:
        """Take up a settled configuration that was not known, if the arm still stands there."""
        pose = self._pose_tracker.now
        if self._unknown is None or pose is None:
            return
        q, settled_s = self._unknown
        since = [joints for stamp_s, joints in self._recent_joints if stamp_s > settled_s]
        stands = all(np.max(np.abs(joints - q)) <= self.p.motion_tolerance for joints in since)
        solution = self._pose_tracker.which(q) if stands else None
        if solution is not None:
            self._due.append((q, settled_s, solution, pose))
        if solution is not None or not stands:
            self._unknown = None

    def _take_next(self) -> None:
        """Begin the reading that is due, unless one is under way."""
        while self._due and not self._busy():
            q, settled_s, solution, pose = self._due.popleft()
            if self.journal.closed or not self.journal.follow(pose.plan):
                self._trouble = (
                    'settled, but the session is closed, or was begun with another plan'
                )
                continue
            known = self.journal.result(pose.pose, pose.ids[solution])
            if known:
                self._report(
                    ConfigurationEnded(
                        stamp=pose.stamp,
                        solution=solution,
                        result=known,
                        reason='recorded before',
                        registered=self._registered(),
                    )
                )
                continue
            self._take(q, settled_s, solution, pose)

    def _registered(self) -> bool:
        """Whether every sensor that the arm waits for is registered."""
        known = [name in self.registrar.T_R_N for name in self._wanted()]
        return any(known) if self.p.require == 'any' else all(known)

    def _wanted(self) -> list[str]:
        """Return the sensors that the arm waits for, or for one of them."""
        return [name for name in self.cell.sensors if self.p.require in ('all', 'any', name)]

    def _absent(self) -> dict[str, str]:
        """Return why, for each sensor that is not there (`Liveness.absent`)."""
        return self._liveness.absent(time.monotonic(), self._wanted())

    def _take(
        self,
        q: FloatArray,
        settled_s: float,
        solution: int,
        pose: PoseAnnounced,
        future: Future | None = None,
    ) -> None:
        pairing = Pairing(settled_s, q, self.rules, self.p.motion_tolerance, self.p.require)
        # Now, not when the reading is done: a stop may come in between.
        self._taking = _Taking(pairing, solution, pose, self._from_q, future)
        self._from_q = q
        for stamp_s, recent in self._recent_joints:
            pairing.add_joint_state(stamp_s, recent)
        for sensor, reading in self._recent_readings:
            pairing.add_reading(sensor, reading)
        self._shots.look(pairing, self._absent())

    def _look(self) -> None:
        """Ask, give up, and say at once when a required sensor goes or comes back."""
        absent = self._absent()
        self._disk.look()
        self._check_files()
        if self._taking is not None:
            self._shots.look(self._taking.pairing, absent)
            self._taking.pairing.give_up(self._now, absent, self._liveness.words)
            self._finish_if_complete()
        self._look_again()
        self._take_next()
        waiting_for = self._waiting_for(absent)
        if bool(waiting_for) != self._was_waiting:
            self._was_waiting = bool(waiting_for)
            self.status.publish()

    def _waiting_for(self, absent: Mapping[str, str]) -> str:
        """Say what is missing, and why: room on the disk, required sensors; '' if nothing is."""
        if self._disk.full:
            return self._disk.why
        wanted = self._wanted()
        gone = [name for name in wanted if name in absent]
        if not gone or (self.p.require == 'any' and len(gone) < len(wanted)):
            return ''
        return '; '.join(f'{name}: {absent[name]}' for name in gone)

    def _finish_if_complete(self) -> None:
        taking = self._taking
        if taking is None or not taking.pairing.complete:
            return
        self._taking = None
        taking.pairing.finish()
        of_reference = taking.pose.split == REFERENCE
        decided = [self._judged(item, of_reference) for item in taking.pairing.decided.values()]
        waited_s = taking.pairing.waited_s()
        for name, seconds_waited in waited_s.items():
            self._waited_s[name] += seconds_waited
        good = [item for item in decided if isinstance(item, PairedReading)]
        bad = [item for item in decided if not isinstance(item, PairedReading)]
        for rejection in bad:
            self.counts[f'{rejection.sensor}_{rejection.reason}'] += 1
        for reading in good:
            self.counts[f'{reading.sensor}_accepted'] += 1
        self._disk.write(partial(self._write_down, taking, good, bad, waited_s))

    def _write_down(
        self,
        taking: _Taking,
        good: list[PairedReading],
        bad: list[Rejection],
        waited_s: Mapping[str, float],
    ) -> None:
        """Write what became of a configuration; then, and only then, say it."""
        why = '; '.join(f'{r.sensor}: {r.reason}: {r.detail}' for r in bad)
        missed = [item for item in bad if item.reason not in ('not_waited', 'absent')]
        result: Outcome = 'rejected' if not good else 'partial' if missed else 'recorded'
        number = self._write(good, taking, result, why)
        if taking.pose.split == REGISTRATION:
            self.registrar.add(good)
        if taking.pose.split == REFERENCE:
            # Before the planner hears that it may go on.
            known, ends = self.registrar.T_R_N, taking.pose.last
            self._say_change(self._watching.read(number, good, known, ends))
        if taking.future is not None:
            taking.future.set_result((good, why))
            return
        last = max((reading.stamp_s for reading in good), default=self._now)
        self._report(
            ConfigurationEnded(
                stamp=taking.pose.stamp,
                solution=taking.solution,
                result=result,
                reason=why,
                registered=self._registered(),
                measuring_s=last - taking.pairing.settled_stamp_s,
                waited_s=dict(waited_s),
            )
        )
        self._take_next()

    def _judged(
        self, item: PairedReading | Rejection, of_reference: bool
    ) -> PairedReading | Rejection:
        if isinstance(item, Rejection):
            return item
        T_R_N = self.registrar.T_R_N.get(item.sensor)
        return self._plausibility.judge(item, T_R_N, anywhere=of_reference)

    def _write(self, good: list[PairedReading], taking: _Taking, result: str, reason: str) -> int:
        """Write what became of one configuration; on disk when this returns."""
        return self.journal.write(
            pose=taking.pose.pose,
            solution=taking.pose.ids[taking.solution],
            split=taking.pose.split,
            result=result,
            reason=reason,
            readings=good,
            from_q=taking.from_q,
            # Not that of this very reading: a topic of its own, it may come after the point, and
            # a replay must write what the recording wrote.
            temperatures_c=[self._temperature_c(taking.pairing.settled_stamp_s)] * len(good),
        )

    def _report(self, end: ConfigurationEnded) -> None:
        self.counts[f'configurations_{end.result}'] += 1
        self.status.event(end)

    # The references

    def _say_change(self, new: bool) -> None:
        """Say what has changed at the references, and have the planner pause where it is large."""
        watching = self._watching
        if not new or watching.change is None:
            return
        text, stops = watching.describe(), watching.stops
        if stops:
            watching.stopped_run = self._run
        self.get_logger().error(text)
        change = watching.change
        self.status.event(
            SetupChanged(stops=stops, text=text, cause=change.kind, size_m=change.size_m)
        )
        self.status.publish()

    def _follow_stop(self, state: str) -> None:
        """Take it that a person has looked once another run has begun, as /remaster/collect does.

        A recorder that was started again does not know which run was stopped: the one it finds
        running is, and after a pause none.
        """
        watching = self._watching
        if watching.stopped_run == '':
            watching.stopped_run = (
                self._run if state == 'running' else PAUSED * (state == 'paused')
            )
        elif (
            watching.stopped_run not in (None, self._run)
            and self._run
            and not self._disk.full
            and not self.journal.closed
        ):
            self._disk.write(self._accept_change)

    def _accept_change(self) -> None:
        self.journal.note_accepted()
        self._watching.accept()
        self.status.publish()

    # Registration by hand

    async def _on_register(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Take the point where the arm stands now; the third point completes the registration."""
        if self._busy():
            response.message = 'a reading is under way; try again when it is done'
            return response
        if self._q is None:
            response.message = 'no joint_states yet: is the robot running?'
            return response
        if self.journal.closed:
            response.message = f'the session is closed ({self.journal.closed})'
            return response
        future: Future = Future()
        pose = PoseAnnounced(stamp='', pose=BY_HAND, split=REGISTRATION, ids=(0,))
        self._take(self._q, self._now, 0, pose, future)
        good, why = await future
        response.success = bool(good)
        response.message = why or self.registrar.describe()
        return response

    # State

    def _summary(self) -> Summary:
        state = 'closed' if self.journal.closed else 'measuring' if self._busy() else 'waiting'
        now, sensors = time.monotonic(), self.cell.sensors
        waiting_for = self._waiting_for(self._absent())
        trouble = self._trouble or (f'waiting for {waiting_for}' if waiting_for else '')
        trouble = trouble or self.journal.beyond_repair or self._restored
        trouble = trouble or self._watching.describe()
        pose = self._pose_tracker.now
        ages_s = {name: self._liveness.read_age_s(name, now) for name in sensors}
        values = {
            **{f'waited_s_{name}': f'{s:.1f}' for name, s in self._waited_s.items()},
            'bag_dropped': self._bag.dropped,
            'restored': self._restored,
            'reference_rounds': self._watching.rounds,
            **dict(sorted(self.counts.items())),
        }
        report = RecorderState(
            state=state,
            exit_status=self.journal.closed,
            session=self.p.session,
            observations=self.journal.observations,
            pose='' if pose is None else pose.stamp,
            plan=self.journal.plan_id,
            run=self._run,
            decided=self.journal.decided(),
            registration=self.registrar.describe(),
            require=self.p.require,
            waiting_for=waiting_for,
            read_age_s={n: age_s if np.isfinite(age_s) else None for n, age_s in ages_s.items()},
            changed=self._watching.describe(),
            changed_run=self._watching.stopped_run,
        )
        return Summary('warn' if trouble else 'ok', trouble or state, values, report)

    # The disk

    def _busy(self) -> bool:
        """Whether a configuration is being read or written down."""
        return self._taking is not None or bool(self._disk.full)

    def _check_files(self) -> None:
        """Notice within a second or two what others did to the session's files."""
        if time.monotonic() - self._checked_wall < CHECK_S:
            return
        self._checked_wall = time.monotonic()
        if not self._disk.full:
            self._disk.write(self.journal.check)
        self._say_restored()

    def _say_restored(self) -> None:
        for line in self.journal.take_restored():
            self.get_logger().error(line)
            self._restored = line
            self.status.publish()

    def _reopen(self) -> None:
        self.journal.reopen()
        self._bag.reopen()

    def _close(self, exit_status: ExitStatus) -> None:
        if not self.journal.closed:
            self._say_change(self._watching.judge(self.registrar.T_R_N))
            self.journal.close(exit_status)
            self._say_restored()
            if self.journal.closed != exit_status:
                self.get_logger().error(
                    f'the session is closed as {self.journal.closed}, not as {exit_status}: '
                    f'{self.journal.beyond_repair}; its observations are all there'
                )
            self._bag.close()
            waited = ', '.join(f'{name} {s:.1f} s' for name, s in self._waited_s.items())
            self.get_logger().info(f'the arm stood waiting for {waited}')
            self.status.publish()

    def close(self) -> None:
        """Close the session; what is recorded so far stays readable."""
        if self._taking is not None and self._taking.future is not None:
            self._taking.future.cancel()
        try:
            self._close('stopped')
        except DiskError as error:
            self.get_logger().error(f'{error}; `remaster recover` finishes the session')


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Recorder, args)


if __name__ == '__main__':
    raise SystemExit(main())
