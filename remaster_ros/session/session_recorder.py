# SPDX-License-Identifier: Apache-2.0
"""From messages to a session: the logic of the recorder, for its node and for bags.

Messages and event records come in through `SessionRecorder.take_joints` and the like, in the order
of arrival. Which of them belong together is decided by their stamps, in `collection.recording`.
The event of a configuration is published after its observations are on the disk; the bridge goes
on only then.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any, Protocol

import numpy as np

from remaster_ros.collection import events
from remaster_ros.collection.first_registration import FirstRegistration
from remaster_ros.collection.message_fields import (
    JointOrder,
    seconds,
    solutions_of,
    stamp_key,
    unit_quaternion,
    wanted_of,
)
from remaster_ros.collection.pairing import PairedReading, SensorRules
from remaster_ros.collection.peers import RequiredSensors
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.collection.recording import BY_HAND, EndedReading, Recording
from remaster_ros.collection.setup_changes import SetupChanges
from remaster_ros.errors import InputError
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.parameters import SimulationParameters, parameter
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.session.records.session_journal import SessionJournal
from remaster_ros.session.records.session_yaml import ExitStatus
from remaster_ros.types import (
    BRIDGE,
    Correction,
    FloatArray,
    MarkerReading,
    Measurements,
    Session,
)


@dataclass(frozen=True)
class Parameters(SimulationParameters):
    """Parameters of the recorder."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    session: str = parameter(
        'session', 'folder of the session: new, empty, or of an unfinished one, which goes on'
    )
    bag: bool = parameter(True, 'record a rosbag2 (MCAP) of the raw topics into session/bag')
    call_measure: bool = parameter(
        True, 'call the measure service of single-shot sensors; false when a bag is replayed'
    )
    dwell_s: float = parameter(0.5, 'how long a stream is averaged', unit='s', low=0.01, high=60.0)
    min_samples: int = parameter(5, 'fewest samples in the dwell', low=1)
    max_std_m: float = parameter(
        0.5e-3, 'largest standard deviation over the dwell', unit='m', low=1e-6, high=0.1
    )
    motion_tolerance: float = parameter(
        5e-4,
        'largest joint movement during a reading; of one that slides 0.25 m for each rad',
        unit='rad',
        low=1e-7,
        high=0.01,
    )
    stream_timeout_s: float = parameter(
        3.0, 'how long after the dwell a stream may stay out', unit='s', low=0.1, high=600.0
    )
    shot_timeout_s: float = parameter(
        60.0, 'how long after settling a single shot may stay out', unit='s', low=0.1, high=3600.0
    )
    settle_s: float = parameter(
        3.0, 'settle time of the bridge, noted in the session', unit='s', low=0.1, high=60.0
    )
    require: str = parameter(
        'all', "whom the arm waits for at each configuration: all, any, or a sensor's name"
    )
    heartbeat_s: float = parameter(
        3.0, 'longest silence of a sensor node, wall time', unit='s', low=0.5, high=60.0
    )
    max_deviation_m: float = parameter(
        0.05,
        'a reading further than this from where the robot has the marker is of another one',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    reference_stop_m: float = parameter(
        0.5e-3,
        'a change at the reference configurations that is larger than this pauses the collection '
        'until a person has looked; 0 for never',
        unit='m',
        low=0.0,
        high=1.0,
    )


def sensor_rules(cell: Workcell, p: Parameters) -> tuple[SensorRules, ...]:
    """Return the rules by which each sensor of the cell is read, in the cell's order.

    Thresholds and waiting times are the parameters', the rest is the cell's.
    """
    return tuple(
        SensorRules(
            sensor=name,
            marker=sensor.marker,
            further=tuple(sensor.further_markers),
            single_shot=sensor.single_shot,
            on_tool=bool(sensor.mounted_on),
            dwell_s=p.dwell_s,
            min_samples=p.min_samples,
            max_std_m=p.max_std_m,
            timeout_s=p.shot_timeout_s if sensor.single_shot else p.stream_timeout_s,
        )
        for name, sensor in cell.sensors.items()
    )


def session_header(cell: Workcell, settle_s: float) -> Session:
    """Return a session of this cell without observations, created now (UTC).

    Raises InputError if the URDF has no such arm.
    """
    chain = cell.chain()
    return Session(
        urdf=cell.urdf_text,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers={name: np.array(position) for name, position in cell.markers.items()},
        sensors={name: sensor.marker for name, sensor in cell.sensors.items()},
        further_markers={
            name: tuple(sensor.further_markers)
            for name, sensor in cell.sensors.items()
            if sensor.further_markers
        },
        oriented=frozenset(name for name, sensor in cell.sensors.items() if sensor.pose_topic),
        on_tool=frozenset(name for name, sensor in cell.sensors.items() if sensor.mounted_on),
        sensor_kinds=cell.sensor_kinds,
        measurements=Measurements.empty(len(chain)),
        marker_std_m=cell.marker_std_m,
        settle_s=settle_s,
        created=datetime.now(UTC).isoformat(timespec='seconds'),
    )


class Keeper(Protocol):
    """Writer of a recorder's session: a write for which the disk has no room is repeated later."""

    journal: SessionJournal
    # Why nothing can be written now; ''.
    full: str

    def write(self, write: Callable[[], object]) -> None:
        """Call `write`, now or when the disk has room; its result is dropped."""

    def reopen(self, *, go_further: bool = False) -> None:
        """Continue a stopped session; with `go_further`, a complete one."""

    def close(self, exit_status: ExitStatus) -> None:
        """Close the session."""


class Outlet:
    """Receives the results of recording; this one ignores them, that of a node publishes them."""

    def event(self, event: events.Event) -> None:
        """Publish an event of this recorder; this base class does nothing."""

    def state(self) -> None:
        """Publish the recorder's state, which has changed."""

    def registered(self, sensor: str, T_R_N: FloatArray) -> None:
        """Publish a sensor's registration: pose of its frame N in the robot base R, (4, 4)."""

    def measure(self) -> None:
        """Request measurements from single-shot sensors: a reading has begun."""

    def ended_by_hand(self, ended: EndedReading) -> None:
        """Answer the request for a registration by hand with its reading, which has ended."""

    def log(self, level: int, text: str) -> None:
        """Log a line; `level` as in `logging`."""


class SessionRecorder:
    """Makes a session of messages and event records, without ROS itself; see the module.

    Parameters
    ----------
    cell, p
        The workcell, and the recorder's parameters.
    keeper, outlet
        Destinations of the session and of results.

    Attributes
    ----------
    recording
        The readings under way.
    registration
        Registrations of the sensors so far.
    changes
        Changes of the setup found at the references.
    required
        Sensors that the arm waits for.
    counts, not_finite, waited_s
        Outcomes of readings and configurations; readings with non-finite numbers, and time the
        arm stood still, s, per sensor.
    trouble
        What is wrong with the last message; ''.
    run
        Token of the planner's run; in memory only, so that it ends with this process.
    from_bag
        Whether the messages are from a bag.
    correction
        SHA-256 of the compensation.json that the bridge applies; '' for none, None if unknown.
    """

    def __init__(self, cell: Workcell, p: Parameters, keeper: Keeper, outlet: Outlet) -> None:
        self.cell, self.keeper, self._outlet = cell, keeper, outlet
        self.chain = cell.chain()
        self._order = JointOrder(self.chain.joint_names)
        self.required = RequiredSensors(cell.sensors, p.require)
        self.counts: Counter[str] = Counter()
        self.not_finite: Counter[str] = Counter()
        self.waited_s = dict.fromkeys(cell.sensors, 0.0)
        self.trouble = self.run = ''
        self.from_bag = False
        self.correction: str | None = None
        # The correction at the beginning of the reading under way.
        self._read_with = ''
        # Their poses may be announced on their way here.
        self._failed: list[events.SolutionFailed] = []
        self._p = p
        self._begin()

    @property
    def journal(self) -> SessionJournal:
        """The session on the disk."""
        return self.keeper.journal

    def _begin(self) -> None:
        """Restore the state from the session on the disk, as a recorder does when it starts.

        Readings under way are dropped; registrations and changes are restored from the
        journal.
        """
        cell, p = self.cell, self._p
        markers = {name: np.array(position) for name, position in cell.markers.items()}
        self.recording = Recording(
            sensor_rules(cell, p),
            p.motion_tolerance,
            p.require,
            Plausibility(self.chain, markers, p.max_deviation_m, cell.marker_std_m),
            units=JointUnits.of(self.chain),
            patient=self.from_bag,
        )
        self.registration = FirstRegistration(
            self.chain,
            markers,
            cell.sensors,
            p.max_deviation_m / 2,
            {
                name: sensor.markers
                for name, sensor in cell.sensors.items()
                if sensor.single_shot and sensor.further_markers
            },
        )
        self.changes = SetupChanges(self.chain, markers, p.reference_stop_m)
        self._restore_measurements()

    def _restore_measurements(self) -> None:
        """Restore registrations and reference measurements from the session's journal."""
        self._register(self.journal.registration)
        self.changes.take_back(self.journal.watched, self.registration.T_R_N)

    def _positions(self, message: Any) -> FloatArray | None:
        """Return positions of the cell's joints in a JointState, rad or m, (k,).

        None if the message is invalid, with the reason in `trouble`.
        """
        try:
            return self._order.positions(message)
        except InputError as error:
            self.trouble = str(error)
            return None

    def take_joints(self, message: Any) -> None:
        """Take a sensor_msgs/JointState of the robot; those of a gripper are ignored.

        An invalid one is dropped and sets `trouble`. A valid one clears it; if the outcome of
        the reading under way is now decided, that is ended and written.
        """
        if self._order.concerns(message) and (q := self._positions(message)) is not None:
            self.trouble = ''
            self.recording.take_joints(seconds(message.header.stamp), q)
            self.end_reading()

    def take_solutions(self, message: Any) -> None:
        """Take a trajectory_msgs/JointTrajectory with the solutions of the announced pose.

        An invalid one counts as one without solutions and sets `trouble`.
        """
        try:
            solutions = solutions_of(message, self.chain.joint_names)
        except InputError as error:
            self.trouble = f'joint_solutions dropped: {error}'
            solutions = np.empty((0, len(self.chain)))
        self.recording.take_solutions(stamp_key(message.header.stamp), solutions)

    def take_settled(self, message: Any) -> None:
        """Take a sensor_msgs/JointState of a settled arm; begin to read the configuration.

        It waits if a reading is under way. An arm at no solution of the announced pose is
        counted as 'settled_unknown' and sets `trouble`, as an invalid message does, which is
        dropped.
        """
        if (q := self._positions(message)) is None:
            return
        try:
            wanted = wanted_of(message, self.chain.joint_names)
        except InputError as error:
            self.trouble = str(error)
            return
        if self.from_bag and self.recording.is_by_hand:
            # The end of that reading is in no message; the arm has gone on.
            self._end_as_recorded('rejected', '')
        change = None if wanted is None else q - wanted
        if self.recording.take_settled(seconds(message.header.stamp), q, change):
            # The bridge waits for an answer, but a bag does not: a reading under way is
            # finished first, by the stamps of its own messages.
            self.take_next()
        else:
            self.counts['settled_unknown'] += 1
            self.trouble = 'settled at no joint solution of an announced pose'

    def take_marker(self, sensor: str, marker: str, message: Any) -> bool:
        """Process a reading (PointStamped or PoseStamped); return whether the marker is seen.

        A position that is not finite is dropped and counted, and False returned. But if the
        sensor has several markers, a position of NaN alone means a hidden marker: it is
        recorded as such, and False is returned, too.
        """
        body = getattr(message, 'pose', None)
        point = message.point if body is None else body.position
        position = np.array([point.x, point.y, point.z])
        hidden = bool(np.all(np.isnan(position))) and len(self.cell.sensors[sensor].markers) > 1
        # Hidden, while others of the frame are seen on topics of their own.
        if not (hidden or np.all(np.isfinite(position))):
            self.not_finite[sensor] += 1
            return False
        turn = None if body is None else unit_quaternion(body.orientation)
        reading = MarkerReading(
            seconds(message.header.stamp), position, marker=marker, orientation=turn
        )
        self.recording.take_reading(sensor, reading)
        self.end_reading()
        return not hidden

    def take_temperature(self, message: Any) -> None:
        """Record a sensor_msgs/Temperature; ignore one that is not finite."""
        if np.isfinite(message.temperature):
            self.recording.take_temperature(seconds(message.header.stamp), message.temperature)

    def take_record(self, record: events.EventRecord) -> None:
        """Update the state by an event record of another node, or of the recorder of a bag.

        Always: poses, failed solutions, states of planner and bridge, stops of the arm, and a
        recorder's start (of a bag). Only from a bag: outcomes and readings by hand. Other
        records are ignored.
        """
        match record.body:
            case events.PoseAnnounced() as pose:
                self._on_pose(pose)
            case events.SolutionFailed() as failed:
                self._failed.append(failed)
            case events.PlannerState() as planner:
                self._on_planner(planner)
            case events.BridgeState() as bridge:
                self.correction = bridge.correction
            case events.ArmStopped():
                self.recording.take_stop()
            case events.RecorderBegan() as began:
                self._on_began(began)
            case events.ConfigurationEnded() as end if self.from_bag:
                # Sensors undecided by the messages are decided as the recorder did.
                while self.recording.is_open(end.stamp, end.solution) and (
                    self.recording.pairing is not None
                ):
                    self._end_as_recorded(end.result, end.reason)
            case events.ReadByHand() as read if self.from_bag:
                if self.recording.is_by_hand:
                    self._end_as_recorded('rejected', '')
                self.recording.begin_by_hand(read.stamp_s, np.array(read.q))

    def _on_began(self, began: events.RecorderBegan) -> None:
        """Process the event of a recorder's start that is in a bag: restart as that recorder did.

        The state is restored from the session on the disk. Before that, at each start but the
        first, the session is closed as stopped and reopened, unless it is closed already.
        ``began.continued``: the same process has opened a closed session again; then only
        `from_bag` is set.
        """
        first, self.from_bag = not self.from_bag, True
        if began.continued:
            return
        if not first and not self.journal.closed:
            self.keeper.close('stopped')
            self.keeper.reopen()
        self._begin()

    def _end_as_recorded(self, result: str, reason: str) -> None:
        """End the reading under way with the result and the reason of the bag's recorder."""
        self.recording.end_as_recorded(result, reason)
        self.end_reading()

    def _on_pose(self, pose: events.PoseAnnounced) -> None:
        """Set the announced pose, and record which of its solutions are unreachable.

        A pose that is neither a reference nor of a registration ends the round of visits to
        the references: if that shows a new change of the set-up, the change is reported.
        """
        self.recording.announced = pose
        self._failed = [failed for failed in self._failed if failed.stamp == pose.stamp]
        if pose.split not in (REFERENCE, REGISTRATION):
            self._report_change(self.changes.leave(self.registration.T_R_N))
        self._record_unreached()

    def _on_planner(self, planner: events.PlannerState) -> None:
        """Process the planner's state: its run, and a person's consent to a change of the set-up.

        The consent is recorded unless the disk is full or the session closed. While no reading is
        under way and the disk has room, the session is closed when the planner completes, or stops
        after an observation, and reopened when a stopped run resumes or measurements are added to
        a complete one.
        """
        self.run = planner.run_held(self.run)
        accepted = self.changes.follow(planner.state, self.run)
        if accepted and not self.keeper.full and not self.journal.closed:
            self.keeper.write(self._accept_change)
        if self.keeper.full or not self.recording.is_idle:
            return
        if planner.state == 'complete':
            self.keeper.write(partial(self.close, 'complete'))
        elif planner.state == 'stopped' and self.journal.observations:
            self.keeper.write(partial(self.close, 'stopped'))
        elif planner.state == 'running' and self.journal.closed == 'stopped':
            self.keeper.write(self.keeper.reopen)
        elif planner.goes_further(self.journal.plan_id) and self.journal.closed == 'complete':
            self.keeper.write(self._go_further)

    def _go_further(self) -> None:
        """Reopen the complete session for measurements that separate causes of error.

        An InputError of that sets `trouble`. The state is published in any case.
        """
        try:
            self.keeper.reopen(go_further=True)
        except InputError as error:
            self.trouble = str(error)
        if not self.registration.T_R_N:
            # This recorder was started when the session was complete already.
            self._restore_measurements()
        self._outlet.state()

    @property
    def other_correction(self) -> str:
        """Why the bridge's correction does not fit the rows of this session; '' if it does.

        '' also without a correction in the bridge, or before the first row.
        """
        noted, now = self.journal.correction, self.correction
        if not now or self.journal.closed or (noted is not None and noted.sha256 == now):
            return ''
        if noted is None and not self.journal.observations:
            return ''
        begun = 'without a correction' if noted is None else f'with another correction ({noted})'
        return (
            f'a bridge that corrects as this session does: it was begun {begun}, and the bridge '
            f'has one with checksum {now[: events.SHORT]}; name a new folder, or start the bridge '
            'as before'
        )

    def look(self) -> None:
        """End a reading that is decided by now, and begin the next one; to be called often.

        Unreachable solutions are recorded, too.
        """
        self.end_reading()
        self.recording.look_again()
        self.take_next()
        self._record_unreached()

    def _record_unreached(self) -> None:
        """Record the plan of the announced pose, and its solutions without a path or that failed.

        Each solution once. Nothing is recorded without an announced pose, if the session is
        closed, or while the disk is full.
        """
        pose = self.recording.announced
        if pose is None or self.journal.closed or self.keeper.full:
            return
        # Before the arm arrives: it waits if the disk is full.
        self.keeper.write(partial(self.journal.follow, pose.plan))
        ends = [(number, events.NO_FREE_PATH, '') for number in pose.unreached]
        ends += [
            (pose.ids[failed.solution], 'failed', failed.reason)
            for failed in self._failed
            if pose == self.recording.pose
            and failed.stamp == pose.stamp
            and failed.solution < len(pose.ids)
        ]
        for number, result, reason in ends:
            if self.keeper.full or self.journal.plan_id != pose.plan:
                return
            if not self.journal.outcomes.of(pose.pose, number):
                end = partial(
                    self.journal.write, pose=pose.pose, solution=number, split=pose.split
                )
                self.keeper.write(partial(end, result=result, reason=reason))
                self._outlet.state()

    def take_next(self) -> None:
        """Begin to read the next settled configuration, unless a reading is under way.

        Nothing happens either while the disk is full. A configuration with an outcome is
        reported, not read again; one of another plan or correction is skipped, with `trouble`.
        """
        while not self.keeper.full and (settled := self.recording.next()) is not None:
            pose = settled.pose
            if self.journal.closed or not self.journal.follow(pose.plan):
                self.trouble = 'settled, but the session is closed, or was begun with another plan'
                continue
            untold = settled.change is not None and not self.correction
            if self.other_correction or untold:
                self.trouble = self.other_correction or 'the bridge does not tell what it corrects'
                continue
            known = self.journal.result(pose.pose, settled.id)
            if known is None:
                self._read_with = self.correction or ''
                self.recording.begin(settled)
                self._outlet.measure()
                continue
            self._report(settled.recorded_before(known, registered=self.is_registered))

    def read_by_hand(self) -> None:
        """Begin a reading at the arm's present position, for a registration by hand.

        Requires that a joint state has come (AssertionError otherwise).
        """
        q, now_s = self.recording.q, self.recording.now_s
        assert q is not None
        self._outlet.event(events.ReadByHand(stamp_s=now_s, q=tuple(q.tolist())))
        self.recording.begin_by_hand(now_s, q)
        self._outlet.measure()

    @property
    def is_registered(self) -> bool:
        """Whether every required sensor is registered."""
        return self.required.are_among(self.registration.T_R_N)

    def end_reading(self) -> None:
        """End the reading under way if it is decided by now: count and write its outcome.

        Counted are waiting times, refused and accepted readings, and dropped frames. Nothing
        happens if no reading is under way, or it is not decided yet.
        """
        ended = self.recording.end(self.registration.T_R_N)
        if ended is None:
            return
        for name, waited_s in ended.waited_s.items():
            self.waited_s[name] += waited_s
        refused = (*ended.rejected, *ended.left_out)
        self.counts.update(f'{item.sensor}_{item.reason}' for item in refused)
        for item in ended.accepted:
            if item.dropped:
                self.counts[f'{item.sensor}_frames_dropped'] += item.dropped
        self.counts.update(f'{name}_accepted' for name in {item.sensor for item in ended.accepted})
        self.keeper.write(partial(self._write_outcome, ended))

    def _write_outcome(self, ended: EndedReading) -> None:
        """Write the outcome of a configuration, publish it, and begin the next reading.

        Registers sensors by a registration pose, and looks for changes at a reference. Two
        cases begin no next reading: a rejected configuration of a pose that is no longer
        announced is only published, not written; a reading by hand is written and answered,
        but not published.
        """
        settled, pose = ended.settled, ended.settled.pose
        if ended.result == 'rejected' and pose not in (self.recording.pose, BY_HAND):
            # The pose was retracted, or announced again, and will be visited again.
            self._report(ended.event(registered=self.is_registered))
            return
        if self._read_with and ended.accepted and pose.split != REGISTRATION:
            # Before the first row, even if it is off there: it decides the columns of the file.
            self.journal.take_correction(Correction(BRIDGE, self._read_with))
        number = self.journal.write(
            pose=pose.pose,
            solution=settled.id,
            split=pose.split,
            result=ended.result,
            reason=ended.why,
            readings=ended.accepted,
            from_q=ended.from_q,
            temperatures_c=[ended.temperature_c] * len(ended.accepted),
            change=settled.change,
        )
        if pose.split == REGISTRATION:
            self._register(ended.accepted)
        if pose.split == REFERENCE:
            # Before the planner learns that it may go on.
            known = self.registration.T_R_N
            self._report_change(self.changes.read(number, ended.accepted, known, pose.last))
        if pose == BY_HAND:
            self._outlet.ended_by_hand(ended)
            return
        self._report(ended.event(registered=self.is_registered))
        self.take_next()

    def _register(self, readings: Sequence[PairedReading]) -> None:
        """Add readings of registration poses, and publish the registrations that they complete.

        Troubles of the sensors of these readings are logged as warnings.
        """
        for name in self.registration.add(readings):
            self._outlet.registered(name, self.registration.T_R_N[name])
            self._outlet.log(logging.INFO, f'{name} is registered; {self.registration.describe()}')
        for name in {reading.sensor for reading in readings} & self.registration.troubles.keys():
            self._outlet.log(logging.WARNING, self.registration.troubles[name])

    def _report(self, end: events.ConfigurationEnded) -> None:
        """Count and publish the outcome of a configuration, and the recorder's state."""
        self.counts[f'configurations_{end.result}'] += 1
        self._outlet.event(end)
        # The planner continues by the outcomes in the state.
        self._outlet.state()

    def _report_change(self, new: bool) -> None:
        """Log and publish the change found at the references; the planner pauses by it.

        Nothing happens unless ``new``, or if the changes have nothing to report.
        """
        event = self.changes.report(self.run) if new else None
        if event is not None:
            self._outlet.log(logging.ERROR, event.text)
            self._outlet.event(event)
            self._outlet.state()

    def _accept_change(self) -> None:
        """Record that a person has accepted a change at the references."""
        self.journal.note_accepted()
        self.changes.accept()
        self._outlet.state()

    def close(self, exit_status: ExitStatus) -> None:
        """Report a new change of the set-up at the references, and close the session.

        Nothing happens if it is closed already.
        """
        if self.journal.closed:
            return
        self._report_change(self.changes.judge(self.registration.T_R_N))
        self.keeper.close(exit_status)
        waited = ', '.join(f'{name} {s:.1f} s' for name, s in self.waited_s.items())
        self._outlet.log(logging.INFO, f'the arm stood still for measuring: {waited} (sum)')
        self._outlet.state()
