# SPDX-License-Identifier: Apache-2.0
"""Node that pairs settled joints with marker readings, and writes the session and the bag.

The session is decided in `session.session_recorder`, which makes the same session from a bag; here
are the topics, services and clocks. The bridge goes on only after the event of a configuration. If
the disk is full, the arm waits, and the write is repeated.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection import events
from remaster_ros.collection.recording import EndedReading
from remaster_ros.errors import DiskError
from remaster_ros.nodes.arm_states import JOINTS, ArmStates
from remaster_ros.nodes.cell_sensors import CellSensors
from remaster_ros.nodes.controller_link import COMMANDS, COPIES
from remaster_ros.nodes.messages import transform_message
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.session_keeper import SessionKeeper
from remaster_ros.nodes.simulated_clock import ReportsTaken
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
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.session_recorder import (
    Outlet,
    Parameters,
    SessionRecorder,
    session_header,
)
from remaster_ros.types import FloatArray


class Recorder(RemasterNode):
    """Node that pairs settled joints with marker readings, and writes the session and the bag."""

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
        # Result of the reading that /remaster/register has begun, while it is under way.
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
        # A separate group: it waits for a reading, which other callbacks make.
        group = ReentrantCallbackGroup()
        register = self._on_register
        self.create_service(Trigger, 'remaster/register', register, callback_group=group)
        self.create_service(Trigger, MESSAGES_TAKEN, self._on_taken)
        self.status = NodeStatus(self, self._summary, model=self.cell.model())
        for note in (*self.journal.notes, *self.keeper.bag.notes):
            self.get_logger().warning(note)
        self.create_timer(0.05, self._look, clock=self.status.steady)

    def _subscribe(self) -> None:
        """Subscribe to each topic once, raw: the bag gets the bytes, then they are decoded."""
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
        """Record joint states; with two publishers of the arm's joints, report the rival."""
        self._taken.take(message.header.stamp)
        self._states.note(message, info)
        if rival := self._states.rival():
            self.recorder.trouble = rival
        else:
            self.recorder.take_joints(message)

    def _on_record(self, record: events.EventRecord) -> None:
        """Count a record, and pass an event or state of another node on.

        A sensor's report goes to `sensors`, all others to the session recorder. Records that
        this node has published since its start are only counted.
        """
        self._records[taken_key(record)] += 1
        if isinstance(record.body, events.SensorReport):
            self.sensors.take(record, record.body)
        elif record.started != self.status.started:
            self.recorder.take_record(record)

    def _on_taken(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve the number of messages taken of each topic, as JSON, for which a replay waits.

        Several nodes publish on remaster/events beside the replay: its records are counted by the
        start times of their nodes (`taken_key`).
        """
        topics = {k: n for k, n in self.keeper.bag.taken.items() if k != f'/{EVENTS}'}
        response.success = True
        response.message = json.dumps(topics | self._records)
        return response

    def _look(self) -> None:
        """Trigger sensors, reject overdue readings, and publish why the arm has to wait.

        Timer callback, every 50 ms. It also repeats failed writes; the state is published when
        waiting begins or ends, and after a repair. With messages from a bag no sensor is
        triggered.
        """
        if self.keeper.look():
            self.status.publish()
        recording = self.recorder.recording
        if recording.pairing is not None and not self.recorder.from_bag:
            self.sensors.trigger(recording.pairing)
            self.sensors.give_up(recording)
        self.recorder.look()
        is_waiting = bool(
            self.keeper.full or self.recorder.other_correction or self.sensors.missing()
        )
        if is_waiting != self._was_waiting:
            self._was_waiting = is_waiting
            self.status.publish()

    async def _on_register(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Register with the present position of the arm; the third point completes it.

        The answer comes when the reading has ended. Refused while a reading or a write is under
        way, before the first joint states, and in a closed session.
        """
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

    def _summary(self) -> Summary:
        """Return the state of the recorder for the status: warn with a trouble, else ok."""
        recorder, recording = self.recorder, self.recorder.recording
        busy = self.keeper.full or recording.pairing is not None
        state = 'closed' if self.journal.closed else 'measuring' if busy else 'waiting'
        other_correction = recorder.other_correction
        waiting_for = self.keeper.waits_for or other_correction or self.sensors.missing()
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
        """Close the session as stopped; its records remain readable.

        A registration by hand under way is cancelled. A full disk is logged, not raised.
        """
        if self._by_hand is not None:
            self._by_hand.cancel()
        try:
            self.recorder.close('stopped')
        except DiskError as error:
            self.get_logger().error(f'{error}; `remaster recover` finishes the session')


class _Outlet(Outlet):
    """Output of the session recorder: publishes its events, states and registrations."""

    def __init__(self, node: Recorder) -> None:
        self._node = node

    def event(self, event: events.Event) -> None:
        """Publish an event of the recorder."""
        self._node.status.event(event)

    def state(self) -> None:
        """Publish the recorder's state now."""
        self._node.status.publish()

    def registered(self, sensor: str, T_R_N: FloatArray) -> None:
        """Publish a registration, T_R_N (4, 4)."""
        message = transform_message(self._node.base_link, sensor, T_R_N)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._node._registrations.publish(message)

    def measure(self) -> None:
        """Trigger the single-shot sensors for the configuration that is being read, if any.

        Nothing is triggered if the recorder takes its messages from a replayed bag.
        """
        pairing = self._node.recorder.recording.pairing
        if pairing is not None and not self._node.recorder.from_bag:
            self._node.sensors.trigger(pairing)

    def ended_by_hand(self, ended: EndedReading) -> None:
        """Answer a registration by hand with its reading; nothing if none is under way."""
        if self._node._by_hand is not None:
            self._node._by_hand.set_result(ended)

    def log(self, level: int, text: str) -> None:
        """Log a line as error, warning or info; `level` as in `logging`.

        Below WARNING all are info.
        """
        logger = self._node.get_logger()
        # Separate calls: rclpy refuses a line of code that logs with several severities.
        if level >= logging.ERROR:
            logger.error(text)
        elif level >= logging.WARNING:
            logger.warning(text)
        else:
            logger.info(text)


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run(Recorder, args)


if __name__ == '__main__':
    raise SystemExit(main())
