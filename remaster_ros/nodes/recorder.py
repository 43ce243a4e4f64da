"""Pair settled joints with marker readings; write the session and the bag; register the sensors.

What is read when, and what becomes of it, is decided in `collection.recording`. The event of a
configuration goes out after its observations are on disk; the bridge moves on only then. While
the disk is full the arm is held, and what is to be written is kept and tried again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection import events
from remaster_ros.collection.first_registration import FirstRegistration
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.collection.recording import BY_HAND, EndedReading, Recording
from remaster_ros.collection.setup_changes import SetupChanges
from remaster_ros.errors import DiskError, InputError
from remaster_ros.nodes.cell_sensors import CellSensors
from remaster_ros.nodes.messages import (
    JointOrder,
    seconds,
    solutions_of,
    stamp_key,
    transform_message,
)
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.recorder_parameters import Parameters, sensor_rules, session_header
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.session_keeper import SessionKeeper
from remaster_ros.nodes.simulated_clock import ReportsTaken
from remaster_ros.nodes.status import (
    EVENTS,
    JOINT_STATES,
    LATCHED,
    NodeStatus,
    Summary,
    receiver,
)
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION
from remaster_ros.session.session_yaml import ExitStatus
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import FloatArray


class Recorder(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('recorder')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        self.chain = self.cell.chain()
        self._waited_s = dict.fromkeys(self.cell.sensors, 0.0)
        self._order = JointOrder(self.chain.joint_names)
        markers = {name: np.array(position) for name, position in self.cell.markers.items()}
        self.counts: Counter[str] = Counter()
        self._trouble = ''
        self._was_waiting = False
        # The token of the planner's run; in memory alone, so that it lives no longer than this.
        self._run = ''
        self.recording = Recording(
            sensor_rules(self.cell, self.p),
            self.p.motion_tolerance,
            self.p.require,
            Plausibility(self.chain, markers, self.p.max_deviation_m, self.cell.marker_std_m),
        )
        self.sensors = CellSensors(self, self.p, self.cell, self.recording, self._end_reading)
        self.registration = FirstRegistration(
            self.chain,
            markers,
            self.cell.sensors,
            self.p.max_deviation_m / 2,
            {
                name: sensor.markers
                for name, sensor in self.cell.sensors.items()
                if sensor.single_shot and sensor.further_markers
            },
        )
        self._registrations = self.create_publisher(
            TransformStamped, 'remaster/registration', LATCHED
        )
        # Of /remaster/register, while the reading that it has begun is under way.
        self._by_hand: Future | None = None
        self._changes = SetupChanges(self.chain, markers, self.p.reference_stop_m)
        header = session_header(self.cell, self.p.settle_s)
        self.keeper = SessionKeeper(self, Path(self.p.session), header, with_bag=self.p.bag)
        self.journal = self.keeper.journal
        self._taken = ReportsTaken(self, self.p.simulated_clock_rate)
        self._subscribe()
        # A group of its own: while it waits for the reading, what makes the reading goes on.
        self.create_service(
            Trigger,
            'remaster/register',
            self._on_register,
            callback_group=ReentrantCallbackGroup(),
        )
        self.status = NodeStatus(self, self._summary, model=self.cell.model())
        for note in (*self.journal.notes, *self.keeper.bag.notes):
            self.get_logger().warning(note)
        self._register(self.journal.registration)
        self._changes.take_back(self.journal.watched, self.registration.T_R_N)
        self.create_timer(0.05, self._look, clock=self.status.steady)

    def _subscribe(self) -> None:
        """Take each topic once, raw: into the bag as it came, then decoded."""
        bag = self.keeper.bag
        bag.subscribe(JointState, 'joint_states', self._on_joint_state, JOINT_STATES)
        bag.subscribe(JointState, 'remaster/settled', self._on_settled)
        bag.subscribe(JointTrajectory, 'remaster/joint_solutions', self._on_solutions)
        bag.subscribe(JointTrajectory, 'joint_trajectory_controller/joint_trajectory')
        self.sensors.subscribe(bag)
        bag.subscribe(String, EVENTS, receiver(self, self._on_record))
        bag.subscribe_rest()

    # What comes in

    def _positions(self, message: JointState) -> FloatArray | None:
        """Return the positions of the cell's joints, rad, (k,); None, with a reason, without."""
        try:
            return self._order.positions(message)
        except InputError as error:
            self._trouble = str(error)
            return None

    def _on_joint_state(self, message: JointState) -> None:
        self._taken.take(message.header.stamp)
        if (q := self._positions(message)) is not None:
            self._trouble = ''
            self.recording.take_joints(seconds(message.header.stamp), q)
            self._end_reading()

    def _on_solutions(self, message: JointTrajectory) -> None:
        try:
            solutions = solutions_of(message, self.chain.joint_names)
        except InputError as error:
            self._trouble = f'joint_solutions dropped: {error}'
            solutions = np.empty((0, len(self.chain)))
        self.recording.take_solutions(stamp_key(message.header.stamp), solutions)

    def _on_settled(self, message: JointState) -> None:
        if (q := self._positions(message)) is None:
            return
        if self.recording.take_settled(seconds(message.header.stamp), q):
            # The bridge waits for an answer, but a bag at ten times the speed does not: a reading
            # under way is finished first, by the stamps of its own messages.
            self._take_next()
        else:
            self.counts['settled_unknown'] += 1
            self._trouble = 'settled at no joint solution of an announced pose'

    def _on_record(self, record: events.EventRecord) -> None:
        match record.body:
            case events.PoseAnnounced() as pose:
                self._on_pose(pose)
            case events.PlannerState() as planner:
                self._on_planner(planner)
            case events.SensorReport() as sensor:
                self.sensors.take(record, sensor)
            case events.RecorderBegan():
                # From a bag: that recorder was started again here, with no reading under way.
                self.recording.forget()
            case events.ArmStopped():
                self.recording.take_stop()

    def _on_pose(self, pose: events.PoseAnnounced) -> None:
        self.recording.announced = pose
        if pose.split not in (REFERENCE, REGISTRATION):
            self._report_change(self._changes.leave(self.registration.T_R_N))
        if not self.keeper.full and not self.journal.closed:
            # Before the arm gets there: it is held where there is no room.
            self.keeper.write(partial(self.journal.follow, pose.plan))

    def _on_planner(self, planner: events.PlannerState) -> None:
        self._run = planner.run_held(self._run)
        accepted = self._changes.follow(planner.state, self._run)
        if accepted and not self.keeper.full and not self.journal.closed:
            self.keeper.write(self._accept_change)
        if self.keeper.full or not self.recording.is_idle:
            return
        if planner.state == 'complete':
            self.keeper.write(partial(self._close, 'complete'))
        elif planner.state == 'stopped' and self.journal.observations:
            self.keeper.write(partial(self._close, 'stopped'))
        elif planner.state == 'running' and self.journal.closed == 'stopped':
            self.keeper.write(self.keeper.reopen)
        elif planner.goes_further(self.journal.plan_id) and self.journal.closed == 'complete':
            self.keeper.write(self._go_further)

    def _go_further(self) -> None:
        """Open the complete session again, for what separates causes."""
        try:
            self.keeper.reopen(go_further=True)
        except InputError as error:
            self._trouble = str(error)
        if not self.registration.T_R_N:
            # This recorder was started when the session was complete already.
            self._register(self.journal.registration)
            self._changes.take_back(self.journal.watched, self.registration.T_R_N)
        self.status.publish()

    # A configuration

    def _take_next(self) -> None:
        """Begin the reading that is due, unless one is under way or written down."""
        while not self.keeper.full and (settled := self.recording.next()) is not None:
            pose = settled.pose
            if self.journal.closed or not self.journal.follow(pose.plan):
                self._trouble = (
                    'settled, but the session is closed, or was begun with another plan'
                )
                continue
            known = self.journal.result(pose.pose, settled.id)
            if known is None:
                self.recording.begin(settled)
                self.sensors.trigger()
                continue
            registered = self.sensors.required.are_among(self.registration.T_R_N)
            self._report(settled.recorded_before(known, registered=registered))

    def _look(self) -> None:
        """Trigger sensors, give up readings, and publish at once what the arm has to wait for."""
        if self.keeper.look():
            self.status.publish()
        self.sensors.trigger()
        self.sensors.give_up()
        self._end_reading()
        self.recording.look_again()
        self._take_next()
        is_waiting = bool(self.keeper.full or self.sensors.missing())
        if is_waiting != self._was_waiting:
            self._was_waiting = is_waiting
            self.status.publish()

    def _end_reading(self) -> None:
        ended = self.recording.end(self.registration.T_R_N)
        if ended is None:
            return
        for name, waited_s in ended.waited_s.items():
            self._waited_s[name] += waited_s
        refused = (*ended.rejected, *ended.left_out)
        self.counts.update(f'{item.sensor}_{item.reason}' for item in refused)
        for item in ended.accepted:
            if item.dropped:
                self.counts[f'{item.sensor}_frames_dropped'] += item.dropped
        self.counts.update(f'{name}_accepted' for name in {item.sensor for item in ended.accepted})
        self.keeper.write(partial(self._write_down, ended))

    def _write_down(self, ended: EndedReading) -> None:
        """Write what became of a configuration; publish it after that, and not before."""
        settled, pose = ended.settled, ended.settled.pose
        number = self.journal.write(
            pose=pose.pose,
            solution=settled.id,
            split=pose.split,
            result=ended.result,
            reason=ended.why,
            readings=ended.accepted,
            from_q=ended.from_q,
            temperatures_c=[ended.temperature_c] * len(ended.accepted),
        )
        if pose.split == REGISTRATION:
            self._register(ended.accepted)
        if pose.split == REFERENCE:
            # Before the planner learns that it may go on.
            known = self.registration.T_R_N
            self._report_change(self._changes.read(number, ended.accepted, known, pose.last))
        if pose == BY_HAND:
            if self._by_hand is not None:
                self._by_hand.set_result(ended)
            return
        registered = self.sensors.required.are_among(self.registration.T_R_N)
        self._report(ended.event(registered=registered))
        self._take_next()

    def _register(self, readings: Sequence[PairedReading]) -> None:
        """Take readings at registration poses; publish what they register."""
        for name in self.registration.add(readings):
            message = transform_message(self.chain.base_link, name, self.registration.T_R_N[name])
            message.header.stamp = self.get_clock().now().to_msg()
            self._registrations.publish(message)
            self.get_logger().info(f'{name} is registered; {self.registration.describe()}')
        for name in {reading.sensor for reading in readings} & self.registration.troubles.keys():
            self.get_logger().warning(self.registration.troubles[name])

    def _report(self, end: events.ConfigurationEnded) -> None:
        self.counts[f'configurations_{end.result}'] += 1
        self.status.event(end)

    # The references

    def _report_change(self, new: bool) -> None:
        """Report what has changed at the references; the planner pauses where it is large."""
        event = self._changes.report(self._run) if new else None
        if event is not None:
            self.get_logger().error(event.text)
            self.status.event(event)
            self.status.publish()

    def _accept_change(self) -> None:
        self.journal.note_accepted()
        self._changes.accept()
        self.status.publish()

    # Registration by hand

    async def _on_register(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Take the point where the arm stands now; the third point completes the registration."""
        if self.keeper.full or self.recording.pairing is not None:
            response.message = 'a reading is under way; try again when it is done'
            return response
        if self.recording.q is None:
            response.message = 'no joint_states yet: is the robot running?'
            return response
        if self.journal.closed:
            response.message = f'the session is closed ({self.journal.closed})'
            return response
        self._by_hand = future = Future()
        self.recording.begin_here()
        self.sensors.trigger()
        ended = await future
        response.success = bool(ended.accepted)
        response.message = ended.why or self.registration.describe()
        return response

    # State

    def _summary(self) -> Summary:
        busy = self.keeper.full or self.recording.pairing is not None
        state = 'closed' if self.journal.closed else 'measuring' if busy else 'waiting'
        waiting_for = self.keeper.waits_for or self.sensors.missing()
        changed, pose = self._changes.describe(), self.recording.pose
        reasons = (
            self._trouble,
            f'waiting for {waiting_for}' if waiting_for else '',
            self.journal.beyond_repair,
            self.keeper.restored,
            changed,
            self.recording.unseen,
        )
        trouble = next(filter(None, reasons), '')
        values = {
            **{f'waited_s_{name}': f'{s:.1f}' for name, s in self._waited_s.items()},
            'bag_dropped': self.keeper.bag.dropped,
            'restored': self.keeper.restored,
            'reference_rounds': self._changes.rounds,
            **{f'{name}_not_finite': n for name, n in self.sensors.not_finite.items()},
            **dict(sorted(self.counts.items())),
        }
        report = events.RecorderState(
            state=state,
            exit_status=self.journal.closed,
            session=self.p.session,
            observations=self.journal.observations,
            pose='' if pose is None else pose.stamp,
            plan=self.journal.plan_id,
            run=self._run,
            decided=self.journal.decided(),
            registration=self.registration.describe(),
            require=self.p.require,
            waiting_for=waiting_for,
            read_age_s=self.sensors.read_age_s(),
            changed=changed,
            changed_run=self._changes.stopped_run,
        )
        return Summary('warn' if trouble else 'ok', trouble or state, values, report)

    def _close(self, exit_status: ExitStatus) -> None:
        if self.journal.closed:
            return
        self._report_change(self._changes.judge(self.registration.T_R_N))
        self.keeper.close(exit_status)
        waited = ', '.join(f'{name} {s:.1f} s' for name, s in self._waited_s.items())
        self.get_logger().info(f'the arm stood still for measuring: {waited} (sum)')
        self.status.publish()

    def close(self) -> None:
        """Close the session; what is recorded so far stays readable."""
        if self._by_hand is not None:
            self._by_hand.cancel()
        try:
            self._close('stopped')
        except DiskError as error:
            self.get_logger().error(f'{error}; `remaster recover` finishes the session')


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Recorder, args)


if __name__ == '__main__':
    raise SystemExit(main())
