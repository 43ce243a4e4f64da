# SPDX-License-Identifier: Apache-2.0
"""Pair settled joints with marker readings; write the session and the bag; register the sensors.

What becomes of a message is decided in `session.session_recorder`, which a bag gives the same
session by; here are the topics, services and clocks. The bridge moves on only after the event of
a configuration. While the disk is full the arm is held, and what is to be written is kept and
tried again.
"""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.task import Future
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection import events
from remaster_ros.collection.events import EventRecord, RecorderBegan, SensorReport
from remaster_ros.collection.message_fields import temperature_topic
from remaster_ros.collection.pairing import Pairing
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.collection.recording import EndedReading, Recording
from remaster_ros.errors import DiskError, InputError, MovedError
from remaster_ros.motion.liveness import Liveness
from remaster_ros.nodes.bagging import BagRecorder
from remaster_ros.nodes.controller_link import COMMANDS, COPIES
from remaster_ros.nodes.messages import transform_message
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.rivals import JOINTS, ArmStates
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.simulated_clock import ReportsTaken, SteadyTime
from remaster_ros.nodes.status import (
    EVENTS,
    JOINT_STATES,
    LATCHED,
    MESSAGES_TAKEN,
    NodeStatus,
    Summary,
    receiver,
    taken_key,
)
from remaster_ros.session.session_journal import SessionJournal
from remaster_ros.session.session_recorder import (
    Outlet,
    Parameters,
    SessionRecorder,
    session_header,
)
from remaster_ros.session.session_yaml import ExitStatus
from remaster_ros.session.workcell import Workcell, read_cell
from remaster_ros.types import FloatArray, Session

# The sensors of a cell as the recorder follows them: readings, heartbeats, measure services.


PATIENCE_WALL_S = 1.0
"""An answer counts after so long: in this time the status of the node may show that the instrument
is gone, and the reading of a measurement arrives."""
MISSING_WALL_S = 5.0
"""A service that is not there counts after so long: by then a node that died is absent."""


@dataclass
class _Shot:
    """A measurement: since when it is needed, the request, and when it was answered."""

    since_wall: float
    future: Future | None = None
    answered_wall: float | None = None


class TriggeredSensors:
    """The measurements that one configuration after the other needs, by service clients."""

    def __init__(self, clients: Mapping[str, Client]) -> None:
        self._clients = clients
        self._pairing: Pairing | None = None
        self._shots: dict[str, _Shot] = {}

    def look(self, pairing: Pairing, absent: Mapping[str, str], now: float) -> None:
        """Send the requests that this pairing still needs, and note the refusals.

        ``now`` is of the recorder's watchdogs, s.

        The request is sent again to a sensor that was absent meanwhile, and to one whose reading
        was lost.
        """
        if pairing is not self._pairing:
            self._pairing, self._shots = pairing, {}
        for name, client in self._clients.items():
            if name in absent or name in pairing.decided:
                self._shots.pop(name, None)
                continue
            shot = self._shots.setdefault(name, _Shot(now))
            if shot.future is not None:
                self._take_answer(name, shot, pairing, now)
            elif client.service_is_ready():
                shot.future = client.call_async(Trigger.Request())
            elif now - shot.since_wall > MISSING_WALL_S:
                pairing.fail(name, f'the service {client.srv_name} is not there')

    def _take_answer(self, name: str, shot: _Shot, pairing: Pairing, now: float) -> None:
        assert shot.future is not None
        response = shot.future.result() if shot.future.done() else None
        if response is None:
            return
        if shot.answered_wall is None:
            shot.answered_wall = now
        if now - shot.answered_wall <= PATIENCE_WALL_S:
            return
        if not response.success:
            pairing.fail(name, response.message)
        elif not pairing.has_reading(name):
            del self._shots[name]


class CellSensors:
    """Subscribe to all sensors and find which are missing; `InputError` for a wrong require."""

    def __init__(self, node: RemasterNode, p: Parameters, cell: Workcell) -> None:
        try:
            self.required = RequiredSensors(cell.sensors, p.require)
        except InputError as error:
            raise InputError(f'{node.get_name()}: {error}') from None
        streams = [name for name, sensor in cell.sensors.items() if not sensor.single_shot]
        self._steady_s = SteadyTime(node, p.simulated_clock_rate)
        self._liveness = Liveness(cell.sensors, p.heartbeat_s, streams, since_s=self._steady_s())
        self._sensors = cell.sensors
        self._shots = TriggeredSensors(
            {
                name: node.create_client(Trigger, sensor.measure_service)
                for name, sensor in cell.sensors.items()
                if sensor.single_shot and sensor.measure_service and p.call_measure
            }
        )

    def subscribe(self, bag: BagRecorder, recorder: SessionRecorder) -> None:
        """Subscribe to the readings, through the bag."""
        for name, sensor in self._sensors.items():
            for marker, topic in sensor.topics.items():
                take = self._taker(recorder, name, marker)
                bag.subscribe(PointStamped, topic, None if sensor.pose_topic else take)
            if sensor.pose_topic:
                take = self._taker(recorder, name, sensor.marker)
                bag.subscribe(PoseStamped, sensor.pose_topic, take)
            topic = temperature_topic(sensor.topic)
            bag.subscribe(Temperature, topic, recorder.take_temperature)

    def _taker(self, recorder: SessionRecorder, sensor: str, marker: str) -> Callable[[Any], None]:
        def take(message: PointStamped | PoseStamped) -> None:
            if recorder.take_marker(sensor, marker, message):
                self._liveness.reads(sensor, self._steady_s())

        return take

    def take(self, record: EventRecord, report: SensorReport) -> None:
        """Take the state of a sensor's node."""
        self._liveness.node_reports(
            report.sensor,
            report.ready,
            report.message,
            self._steady_s(),
            record.started,
            hidden=report.hidden,
        )

    def missing(self) -> str:
        """Return which sensors the arm has to wait for, and why; ''."""
        return self.required.missing(self._absent())

    def read_age_s(self) -> dict[str, float | None]:
        """Return the time since the last reading of each sensor, s; None for never."""
        now = self._steady_s()
        ages_s = {name: self._liveness.read_age_s(name, now) for name in self._sensors}
        return {name: age_s if np.isfinite(age_s) else None for name, age_s in ages_s.items()}

    def trigger(self, pairing: Pairing) -> None:
        """Have single-shot sensors measure for the reading under way."""
        self._shots.look(pairing, self._absent(), self._steady_s())

    def give_up(self, recording: Recording) -> None:
        """Reject what does not come in time."""
        recording.give_up(self._absent(), self._liveness.reports)

    def _absent(self) -> dict[str, str]:
        return self._liveness.absent(self._steady_s(), self.required.names)


# The session and the bag on a disk that may be full: what it does not take is tried again.


RETRY_S = 1.0
"""How often a full disk is tried again, s of wall time."""
CHECK_S = 1.0
"""How often it is looked whether the session's files are still the ones that are written, s."""


class SessionKeeper:
    """Write a session, one thing at a time.

    ``began``: what a bag begins with; None to record none.
    Attributes: ``journal, bag``: what is written; ``full``: why the disk does not take what waits;
    '' where nothing waits; ``restored``: what was last found changed by others and restored; ''.
    """

    def __init__(
        self, node: RemasterNode, folder: Path, header: Session, began: RecorderBegan | None
    ) -> None:
        self._node = node
        self.journal = SessionJournal(folder, header)
        self.bag = BagRecorder(node, folder / 'bag', began, begin=not self.journal.closed)
        self._waiting: Callable[[], object] | None = None
        self._tried_wall = self._checked_wall = time.monotonic()
        self._moved = False
        self.full = self.restored = ''

    @property
    def waits_for(self) -> str:
        """What has to happen before anything can be written; ''."""
        return self.full if self._moved or not self.full else f'room on the disk: {self.full}'

    def write(self, write: Callable[[], object]) -> None:
        """Call `write`; where the disk does not take it, `look` tries it again."""
        self._waiting, self._tried_wall = None, time.monotonic()
        try:
            write()
        except DiskError as error:
            if not self.full:
                self._node.get_logger().error(f'the arm is held: {error}')
            self._waiting, self.full = write, str(error)
            self._moved = isinstance(error, MovedError)
        else:
            self.full = ''

    def look(self) -> bool:
        """Try again what waits, and restore what others did to the files, once a second.

        Returns whether something was restored.
        """
        now = time.monotonic()
        if self._waiting is not None and now - self._tried_wall > RETRY_S:
            self.write(self._waiting)
        if now - self._checked_wall < CHECK_S:
            return False
        self._checked_wall = now
        if not self.full:
            self.write(self.journal.check)
        return self._report_restored()

    def _report_restored(self) -> bool:
        lines = self.journal.take_restored()
        for line in lines:
            self._node.get_logger().error(line)
            self.restored = line
        return bool(lines)

    def reopen(self, *, go_further: bool = False) -> None:
        """Go on with a session that was stopped; with `go_further`, with one that is complete."""
        self.journal.reopen(go_further=go_further)
        self.bag.reopen()

    def close(self, exit_status: ExitStatus) -> None:
        """Close session and bag; `DiskError` where the session remains open."""
        self.journal.close(exit_status)
        self._report_restored()
        if self.journal.closed != exit_status:
            self._node.get_logger().error(
                f'the session is closed as {self.journal.closed}, not as {exit_status}: '
                f'{self.journal.beyond_repair}; its observations are all there'
            )
        self.bag.close()


class Recorder(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('recorder')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        chain = self.cell.chain()
        self.base_link = chain.base_link
        self._was_waiting = False
        self._records: Counter[str] = Counter()
        self.sensors = CellSensors(self, self.p, self.cell)
        self._registrations = self.create_publisher(
            TransformStamped, 'remaster/registration', LATCHED
        )
        # Of /remaster/register, while the reading that it has begun is under way.
        self._by_hand: Future | None = None
        header = session_header(self.cell, self.p.settle_s)
        began = events.RecorderBegan(
            parameters=asdict(self.p), cell=msgspec.json.encode(self.cell).decode()
        )
        self.keeper = SessionKeeper(
            self, Path(self.p.session), header, began if self.p.bag else None
        )
        self.journal = self.keeper.journal
        self._taken = ReportsTaken(self, self.p.simulated_clock_rate)
        self._states = ArmStates(self, chain.joint_names, self.p.heartbeat_s)
        self.recorder = SessionRecorder(self.cell, self.p, self.keeper, _Outlet(self))
        self._subscribe()
        # A group of its own: while it waits for the reading, what makes the reading goes on.
        group = ReentrantCallbackGroup()
        register = self._on_register
        self.create_service(Trigger, 'remaster/register', register, callback_group=group)
        self.create_service(Trigger, MESSAGES_TAKEN, self._on_taken)
        self.status = NodeStatus(self, self._summary, model=self.cell.model())
        for note in (*self.journal.notes, *self.keeper.bag.notes):
            self.get_logger().warning(note)
        self.create_timer(0.05, self._look, clock=self.status.steady)

    def _subscribe(self) -> None:
        """Take each topic once, raw: into the bag as it came, then decoded."""
        bag, recorder = self.keeper.bag, self.recorder
        bag.subscribe(JointState, JOINTS, self._on_joint_state, JOINT_STATES, with_info=True)
        bag.subscribe(JointState, 'remaster/settled', recorder.take_settled)
        bag.subscribe(JointTrajectory, 'remaster/joint_solutions', recorder.take_solutions)
        for commands in (COMMANDS, COPIES):
            bag.subscribe(JointTrajectory, commands)
        self.sensors.subscribe(bag, recorder)
        bag.subscribe(String, EVENTS, receiver(self, self._on_record))
        bag.subscribe_rest()

    def _on_joint_state(self, message: JointState, info: Mapping[str, Any]) -> None:
        self._taken.take(message.header.stamp)
        self._states.note(message, info)
        if rival := self._states.rival():
            self.recorder.trouble = rival
        else:
            self.recorder.take_joints(message)

    def _on_record(self, record: events.EventRecord) -> None:
        self._records[taken_key(record)] += 1
        if isinstance(record.body, events.SensorReport):
            self.sensors.take(record, record.body)
        elif record.started != self.status.started:
            self.recorder.take_record(record)

    def _on_taken(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Answer how many messages of each topic were taken: a replay waits for that.

        On remaster/events this node and others publish beside the replay: its records are counted
        by their nodes' starts.
        """
        topics = {k: n for k, n in self.keeper.bag.taken.items() if k != f'/{EVENTS}'}
        response.success = True
        response.message = json.dumps(topics | self._records)
        return response

    def _look(self) -> None:
        """Trigger sensors, give up readings, and publish at once what the arm has to wait for."""
        if self.keeper.look():
            self.status.publish()
        recording = self.recorder.recording
        if recording.pairing is not None and not self.recorder.from_bag:
            self.sensors.trigger(recording.pairing)
            self.sensors.give_up(recording)
        self.recorder.look()
        is_waiting = bool(
            self.keeper.full or self.recorder.another_correction or self.sensors.missing()
        )
        if is_waiting != self._was_waiting:
            self._was_waiting = is_waiting
            self.status.publish()

    # Registration by hand

    async def _on_register(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Take the point where the arm stands now; the third point completes the registration."""
        if self.keeper.full or self.recorder.recording.pairing is not None:
            response.message = 'a reading is under way; try again when it is done'
            return response
        if self.recorder.recording.q is None:
            response.message = 'no joint_states yet: is the robot running?'
            return response
        if self.journal.closed:
            response.message = f'the session is closed ({self.journal.closed})'
            return response
        self._by_hand = future = Future()
        self.recorder.read_by_hand()
        ended = await future
        response.success = bool(ended.accepted)
        response.message = ended.why or self.recorder.registration.describe()
        return response

    # State

    def _summary(self) -> Summary:
        recorder, recording = self.recorder, self.recorder.recording
        busy = self.keeper.full or recording.pairing is not None
        state = 'closed' if self.journal.closed else 'measuring' if busy else 'waiting'
        another = recorder.another_correction
        waiting_for = self.keeper.waits_for or another or self.sensors.missing()
        changed, pose = recorder.changes.describe(), recording.pose
        reasons = (
            recorder.trouble,
            f'waiting for {waiting_for}' if waiting_for else '',
            self.journal.beyond_repair,
            self.keeper.restored,
            changed,
            recording.unseen,
        )
        trouble = next(filter(None, reasons), '')
        values = {
            **{f'waited_s_{name}': f'{s:.1f}' for name, s in recorder.waited_s.items()},
            'bag_dropped': self.keeper.bag.dropped,
            'restored': self.keeper.restored,
            'reference_rounds': recorder.changes.rounds,
            **{f'{name}_not_finite': n for name, n in recorder.not_finite.items()},
            **dict(sorted(recorder.counts.items())),
        }
        report = events.RecorderState(
            state=state,
            exit_status=self.journal.closed,
            session=self.p.session,
            observations=self.journal.observations,
            pose='' if pose is None else pose.stamp,
            plan=self.journal.plan_id,
            run=recorder.run,
            decided=self.journal.outcomes.decided(),
            registration=recorder.registration.describe(),
            registered=recorder.is_registered,
            require=self.p.require,
            waiting_for=waiting_for,
            read_age_s=self.sensors.read_age_s(),
            changed=changed,
            changed_run=recorder.changes.stopped_run,
        )
        return Summary('warn' if trouble else 'ok', trouble or state, values, report)

    def close(self) -> None:
        """Close the session; what is recorded so far stays readable."""
        if self._by_hand is not None:
            self._by_hand.cancel()
        try:
            self.recorder.close('stopped')
        except DiskError as error:
            self.get_logger().error(f'{error}; `remaster recover` finishes the session')


class _Outlet(Outlet):
    """Publishes what the recorder's node is to publish."""

    def __init__(self, node: Recorder) -> None:
        self._node = node

    def event(self, event: events.Event) -> None:
        self._node.status.event(event)

    def state(self) -> None:
        self._node.status.publish()

    def registered(self, sensor: str, T_R_N: FloatArray) -> None:
        message = transform_message(self._node.base_link, sensor, T_R_N)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._node._registrations.publish(message)

    def measure(self) -> None:
        pairing = self._node.recorder.recording.pairing
        if pairing is not None and not self._node.recorder.from_bag:
            self._node.sensors.trigger(pairing)

    def ended_by_hand(self, ended: EndedReading) -> None:
        if self._node._by_hand is not None:
            self._node._by_hand.set_result(ended)

    def log(self, level: int, text: str) -> None:
        logger = self._node.get_logger()
        # Each on a line of its own: rclpy refuses a line that logs with several severities.
        if level >= logging.ERROR:
            logger.error(text)
        elif level >= logging.WARNING:
            logger.warning(text)
        else:
            logger.info(text)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Recorder, args)


if __name__ == '__main__':
    raise SystemExit(main())
