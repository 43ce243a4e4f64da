# SPDX-License-Identifier: Apache-2.0
"""Command the joint solutions of a pose one by one; publish when the arm has settled.

Every command comes from the motion gate (`remaster_ros.motion`); this is the ROS shell of its
rules. After a configuration has settled the arm stays until the recorder has answered what became
of it. What is slow (path checks, the file that keeps a halt) runs beside the callbacks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection import events
from remaster_ros.collection.message_fields import (
    WANTED,
    correction_asked,
    seconds,
    solutions_of,
    stamp_key,
)
from remaster_ros.collection.peers import PeerModels
from remaster_ros.errors import InputError
from remaster_ros.kinematics.same_arm import difference
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.actions import (
    Action,
    CheckPath,
    Drive,
    Failed,
    Halted,
    PathAnswer,
    Renew,
    Settled,
    Stop,
    SupervisorRules,
)
from remaster_ros.motion.arm_supervisor import ArmSupervisor
from remaster_ros.motion.joint_reports import JointReport, JointReports
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.limits import SLOWEST_M_S, MotionLimits
from remaster_ros.motion.motion_gate import PROBE_S, Admitted, MotionGate
from remaster_ros.motion.move_queue import PROBE
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.motion.path_search import PathSearch
from remaster_ros.motion.pieces import HORIZON_S, LEAST_HORIZON_S
from remaster_ros.motion.settling import SettleRules
from remaster_ros.nodes.arm_states import JOINTS, ArmStates
from remaster_ros.nodes.background import Background
from remaster_ros.nodes.controller_link import (
    COMMANDS,
    ActionLink,
    ControllerStates,
    ForeignGoals,
    TopicLink,
    control_messages,
)
from remaster_ros.nodes.messages import (
    curves_by_solution,
    duration_of,
    stamp_of,
    waypoints_by_solution,
)
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.rivals import OnlyPublisher
from remaster_ros.nodes.running import RemasterNode, fault_of_this_program, run
from remaster_ros.nodes.simulated_clock import ReportsTaken, SteadyTime
from remaster_ros.nodes.status import RELIABLE, NodeStatus, Summary, listen
from remaster_ros.parameters import SimulationParameters
from remaster_ros.session.bridge_files import HaltFile, LastCommandFile
from remaster_ros.session.cells.workcell import Workcell, read_cell
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.compensation.in_use import CorrectionInUse
from remaster_ros.nodes.emergency_link import EmergencyLink

SOLUTIONS = 'remaster/joint_solutions'
WAYPOINTS = 'remaster/joint_waypoints'
DESCRIPTION = 'robot_description'
DESCRIPTION_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""As robot_state_publisher offers it."""
NEWEST_STATES = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A bridge that is kept busy drops what is old: it needs where the arm is now."""
MATCHED_WALL_S = 0.5
"""So much later than ours the controller's side of a DDS match may come."""
NO_TOPIC = 'none'
"""What `emergency_stop_topic` is where the robot has no such topic."""
LATE_WALL_S = {Stop: 0.1, Renew: 0.1, Drive: 0.5}
"""A command that was decided longer ago is not published any more, s of wall time.

A stop is for where the arm is on its way. A move begins where it stands: a busy machine may take
longer with it, a paused process may not.
"""
WATCH_WALL_S = 0.05
"""How often silence and the graph are looked at."""


@dataclass(frozen=True)
class Parameters(SimulationParameters):
    """ROS parameters of the robot bridge."""

    cell: str = parameter('', 'cell file: a path, or the name of a shipped one; must be given')
    speed_share: float = parameter(
        0.3,
        'share of each joint velocity limit that is used; while a collection runs it can be '
        'lowered: the arm is stopped and goes on with the new one',
        low=0.01,
        high=1.0,
        live=True,
    )
    cartesian_speed_limit_m_s: float = parameter(
        0.25,
        'largest speed of the fastest point of arm and tool; 0.25 is customary in manual mode, '
        '0 means no such limit; while a collection runs it can be lowered',
        unit='m/s',
        low=SLOWEST_M_S,
        high=10.0,
        off=0.0,
        live=True,
    )
    limit_margin_deg: float = parameter(
        0.5,
        'distance kept from the joint limits; of a joint that slides 4.36 mm for each degree',
        unit='deg',
        low=0.0,
        high=45.0,
    )
    compensation: str = parameter(
        '',
        'compensation.json by which every configuration is corrected before it is checked and '
        'commanded; read once, at the start; empty for none',
    )
    settle_s: float = parameter(
        3.0, 'how long the arm must stand still before a reading', unit='s', low=0.1, high=60.0
    )
    arrive_tolerance: float = parameter(
        2e-3,
        'largest distance of a joint from its target; of one that slides 0.25 m for each rad',
        unit='rad',
        low=1e-6,
        high=0.1,
    )
    still_tolerance: float = parameter(
        2e-4,
        'largest spread of a joint position while still; of one that slides 0.25 m for each rad',
        unit='rad',
        low=1e-7,
        high=0.01,
    )
    arrive_timeout_s: float = parameter(
        10.0, 'beyond the expected motion and settle: not arrived', unit='s', low=1.0, high=600.0
    )
    answer_timeout_s: float = parameter(
        180.0,
        "longest wait for the recorder's answer on a settled configuration",
        unit='s',
        low=1.0,
        high=3600.0,
    )
    heartbeat_s: float = parameter(
        3.0,
        'longest silence of planner, recorder or robot, wall time',
        unit='s',
        low=0.5,
        high=60.0,
    )
    stall_s: float = parameter(
        1.0,
        'an arm that stands for so long after its move, and not at its target, will not get there',
        unit='s',
        low=0.2,
        high=60.0,
    )
    reaction_s: float = parameter(
        2.0,
        'how long a command may take to be seen in joint_states, wall time',
        unit='s',
        low=0.1,
        high=60.0,
    )
    lag_s: float = parameter(
        0.35,
        'how far the arm may be behind its trajectory; beyond it the arm is halted',
        unit='s',
        low=0.05,
        high=2.0,
    )
    command_interface: str = parameter(
        'topic',
        'how the controller is commanded: by its topic …/joint_trajectory, or by its action '
        '…/follow_joint_trajectory (needs control_msgs)',
        choices=('topic', 'action'),
    )
    horizon_s: float = parameter(
        HORIZON_S,
        'the controller has no more of a move than what is over so soon, and is given the rest '
        'while the bridge lives; 0 for whole moves, which go on if the bridge fails',
        unit='s',
        low=LEAST_HORIZON_S,
        high=HORIZON_S,
        off=0.0,
    )
    trajectory_stamps: str = parameter(
        'auto',
        'whether the controller keeps the stamps of trajectories, so that a move in pieces goes '
        'on evenly; else a long line is gone in steps from rest to rest; auto: if it has the '
        'topic …/controller_state, as joint_trajectory_controller has',
        choices=('auto', 'kept', 'ignored'),
    )
    emergency_stop_topic: str = parameter(
        '',
        "std_msgs/Bool, true while the robot's own safety stops it; none where there is none: "
        'then a person goes on after every interruption; must be given',
    )
    resume_alone_s: float = parameter(
        5.0,
        'after a longer interruption of a collection /remaster/collect is needed, unless '
        'emergency_stop_topic was false all the time; 0 where that is none; wall time',
        unit='s',
        low=0.0,
        high=60.0,
    )

    def rules(self, units: JointUnits) -> SupervisorRules:
        """Return the supervisor's rules by these parameters; ``units``: of the arm's joints."""
        return SupervisorRules(
            settle=SettleRules(
                self.settle_s, self.arrive_tolerance, self.still_tolerance, units=units
            ),
            arrive_timeout_s=self.arrive_timeout_s,
            answer_timeout_s=self.answer_timeout_s,
            heartbeat_s=self.heartbeat_s,
            stall_s=self.stall_s,
            reaction_s=self.reaction_s,
            lag_s=self.lag_s,
            horizon_s=self.horizon_s,
            # Nothing shows an emergency stop of an arm that rests or waits, or its release.
            resume_alone_s=self.resume_alone_s if self.safety_topic else 0.0,
        )

    @property
    def safety_topic(self) -> str:
        """The topic of the robot's safety circuit; '' if it has none."""
        return '' if self.emergency_stop_topic == NO_TOPIC else self.emergency_stop_topic

    def raised_from(self, before: Parameters) -> str:
        """Return the name of the first speed limit that is higher than in `before`; '' if none is.

        Speed share first; a Cartesian limit of 0 counts as infinite.
        """
        if self.speed_share > before.speed_share:
            return 'speed_share'
        now, then = (p.cartesian_speed_limit_m_s or np.inf for p in (self, before))
        return 'cartesian_speed_limit_m_s' if now > then else ''

    def correction(self, cell: Workcell, chain: SerialChain) -> CorrectionInUse | None:
        """Return the correction in use, None if there is none.

        Raises InputError if the file is invalid, not of this arm, or changes a joint by too much
        (`compensation.in_use.MOST_DEG`), or the arm has a prismatic joint.
        """
        if not self.compensation:
            return None
        if chain.slides.any():
            raise InputError(
                f"robot_bridge: joint '{chain.joint_names[int(np.argmax(chain.slides))]}' slides, "
                'and of such an arm there is no compensation.json; leave the parameter '
                'compensation empty, and set the offsets in the controller (remaster export)'
            )
        # It loads SciPy, which a bridge without a correction needs not.
        from remaster_ros.compensation.in_use import CorrectionInUse

        return CorrectionInUse(self.compensation, chain, cell.urdf_text, cell.robot.urdf)

    def limits(
        self, chain: SerialChain, shifts: FloatArray | None, acceleration: FloatArray | float
    ) -> MotionLimits:
        """Return the limits of every motion.

        ``shifts``: least and largest that a correction adds to reported angles, rad, (2, k); None
        without; ``acceleration``: rad/s² or m/s², (k,) or for all.
        """
        return MotionLimits.of(
            chain,
            self.speed_share,
            shifts,
            acceleration,
            self.cartesian_speed_limit_m_s or np.inf,
            float(np.deg2rad(self.limit_margin_deg)),
        )


class RobotBridge(RemasterNode):
    """Node that commands the joint solutions of a pose, and publishes when the arm has settled."""

    # Without it nobody looks at the arm: it stops and halts the arm, and stays.
    outlives_faults = True

    def __init__(self) -> None:
        super().__init__('robot_bridge')
        self.p = declare(self, Parameters, self._on_parameters)
        if not self.p.cell:
            raise InputError(
                'robot_bridge: parameter cell is empty; give the cell file of this arm (demo, the '
                'shipped one, is for the fakes)'
            )
        if not self.p.emergency_stop_topic:
            raise InputError(
                'robot_bridge: parameter emergency_stop_topic is empty; give the topic '
                "(std_msgs/Bool) that is true while the robot's own safety stops it, or none if "
                'there is no such topic: then /remaster/collect is needed after every interruption'
            )
        cell = read_cell(self.p.cell)
        self.chain = cell.chain()
        self._correction = correction = self.p.correction(cell, self.chain)
        true_arm, unknown_rad, self._shifts = self.chain, None, None
        if correction is not None:
            # Paths are checked where the arm is, not where its encoders put it.
            true_arm, self._shifts = correction.true_arm, correction.shifts
            unknown_rad = correction.joint_angle_bound(np.deg2rad(cell.unknown_offset_deg))
        # What it has changed of each solution of the pose, rad, (m, k); None if it is off.
        self._changes: FloatArray | None = None
        model = cell.collision_model(true_arm, unknown_rad)
        speeds = PointSpeeds(true_arm, model.extent_points)
        self._acceleration = cell.acceleration_limits(self.chain)
        self._halt_file = HaltFile(self.get_fully_qualified_name())
        self._command_file = LastCommandFile(
            self.get_fully_qualified_name(), self.chain.joint_names
        )
        # A simulated arm begins anew with each World: nothing holds from the one before.
        is_kept = not self.p.simulated_clock_rate
        last = self._command_file.read(time.time_ns()) if is_kept else None
        units, robot = JointUnits.of(self.chain), self.chain
        self.supervisor = ArmSupervisor(
            MotionGate(self.p.limits(self.chain, self._shifts, self._acceleration), speeds),
            JointReports(robot.lower, robot.upper, robot.velocity_limits, units),
            self.p.rules(units),
            self._halt_file.read(),
            None if last is None else last.places,
        )
        self._keeps_end, self._kept_end = is_kept, self.supervisor.end
        self._search = PathSearch(model, speeds)
        self._paths, self._disk = Background(self), Background(self)
        self._pose_stamp = self._run = ''
        # The last announcement as it came: its stamp, and what is wanted, rad or m, (m, k).
        self._announced: tuple[str, FloatArray] = ('', np.empty((0, len(self.chain))))
        self.steady_s = SteadyTime(self, self.p.simulated_clock_rate)
        self._taken = ReportsTaken(self, self.p.simulated_clock_rate, leads=True)
        if last is not None:
            self.supervisor.interrupted(self.steady_s() - last.age_s)
        self._settled_wall = self.steady_s()
        self._states = ArmStates(self, self.chain.joint_names, self.p.heartbeat_s)
        self._waypoints = JointTrajectory()
        self.counts = {'commanded': 0, 'settled': 0, 'failed': 0, 'stopped': 0}
        by_action = self.p.command_interface == 'action'
        if by_action:
            control_messages()
        self._foreign = ForeignGoals(self)
        self._states_of_controller = ControllerStates(self)
        self._closing = False
        # How often the next piece of a move came too late, as it was told last.
        self._missed = 0
        # Made when this bridge is known to be the only one of its name.
        self._controller: TopicLink | ActionLink | None = None
        # Since when a controller listens; a command before that would be lost.
        self._listened_wall: float | None = None
        self._settled = self.create_publisher(JointState, 'remaster/settled', RELIABLE)
        arm = cell.model()
        self.status = NodeStatus(self, self._summary, Path(cell.robot.urdf).stem, arm)
        self._models = PeerModels(self.get_fully_qualified_name(), arm)
        # How the description that the robot publishes of itself contradicts ours; ''.
        self._described = ''
        self._urdf_file = arm.urdf_file
        self.create_subscription(String, DESCRIPTION, self._on_description, DESCRIPTION_QOS)
        self.create_subscription(JointState, JOINTS, self._on_joint_state, NEWEST_STATES)
        self.create_subscription(JointTrajectory, WAYPOINTS, self._on_waypoints, RELIABLE)
        self.create_subscription(JointTrajectory, SOLUTIONS, self._on_solutions, RELIABLE)
        self._emergency = EmergencyLink(
            self, self.p.safety_topic, self._on_emergency_stop, self.p.heartbeat_s
        )
        self._only = [
            OnlyPublisher(self, topic, kind, allowed)
            for topic, kind, allowed in (
                (SOLUTIONS, JointTrajectory, 1),
                (WAYPOINTS, JointTrajectory, 1),
                (COMMANDS, JointTrajectory, 0 if by_action else 1),
            )
        ]
        self.create_service(Trigger, 'remaster/clear_halt', self._on_clear_halt)
        listen(self, self._on_record)
        self.create_timer(WATCH_WALL_S, self._watch, clock=self.status.steady)
        if self.supervisor.halted:
            self.get_logger().error(f'halted: {self.supervisor.halted}')
        if correction is not None:
            self.counts |= {'corrected_near_singularity': 0, 'corrected_outside_range': 0}
            self.get_logger().info(
                f'what is commanded is corrected by {correction.path}, checksum '
                f'{correction.sha256[: events.SHORT]}, as it is now: a file that changes is read '
                'when the bridge is started again'
            )
            for remark in correction.remarks:
                self.get_logger().warning(remark)
        for pair in model.left_out:
            self.get_logger().info(f'collisions: {pair}')
        if not self.p.cartesian_speed_limit_m_s:
            self.get_logger().warning(
                'no Cartesian speed limit (cartesian_speed_limit_m_s is 0): the joints alone '
                'limit the speed of the arm'
            )

    def _on_parameters(self, p: Parameters) -> None:
        """Use new speed limits from now on; a move under way is stopped and goes on with them.

        ``p``: all parameters, with the new limits. Raises InputError if a limit is raised
        while a collection runs.
        """
        raised = p.raised_from(self.p)
        if raised and self.supervisor.under_way:
            raise InputError(
                f'robot_bridge: {raised} can be lowered while a collection runs, not raised; call '
                '/remaster/pause, set it when the arm stands, then call /remaster/collect'
            )
        self.p = p
        limits = p.limits(self.chain, self._shifts, self._acceleration)
        self._do(self.supervisor.use_limits(limits, self.steady_s(), raised=bool(raised)))
        self.get_logger().info(
            f'speed_share is {p.speed_share:g}, cartesian_speed_limit_m_s '
            f'{p.cartesian_speed_limit_m_s:g}'
        )

    def on_fault(self, error: Exception) -> None:
        """Halt the arm after a fault of this program, as its state may be inconsistent.

        The fault is logged as in `RemasterNode.on_fault`, and the halt written to its file. If the
        halt itself fails, the controller's goals are cancelled.
        """
        why = str(fault_of_this_program(error))
        super().on_fault(error)
        if not hasattr(self, '_closing'):
            # It is being made: nothing has been commanded.
            return
        try:
            self._do(self.supervisor.fault(why, self.steady_s()))
        except Exception as again:
            # Nothing else follows; the arm completes what is checked, or is held where it is.
            super().on_fault(again)
            self.supervisor.halted = self.supervisor.halted or why
            if self._controller is not None:
                self._controller.cancel()
        # Also where the first attempt has failed on its way.
        self._disk.submit(partial(self._halt_file.write, self.supervisor.halted), self._on_written)

    # What comes in

    def _on_record(self, record: events.EventRecord) -> None:
        """Pass what planner and recorder report on to the supervisor.

        That is: the planner's state, what the recorder waits for, and the recorder's outcome
        of a solution of the present pose. Other records are ignored, but of each the arm model
        it states is kept, to compare it with the bridge's.
        """
        now = self.steady_s()
        self._models.take(record, now)
        match record.body:
            case events.PlannerState(state=state, run=run):
                # First: a planner of another arm must not count as running.
                self._do(self.supervisor.observe('model', self._model_trouble(now), now))
                if state == 'running':
                    # By it a planner that is started again sees that this bridge was there.
                    self._run = run
                self._do(self.supervisor.planner_is(state, now, run))
            case events.RecorderState(waiting_for=waiting_for):
                self._do(self.supervisor.recorder_waits(waiting_for, now))
            case events.ConfigurationEnded(stamp=self._pose_stamp, solution=solution):
                self._do(self.supervisor.answered(solution, now))

    def _on_description(self, message: String) -> None:
        """Keep a sentence on how the robot description contradicts the cell's URDF; '' if not."""
        why = difference(self.chain, message.data)
        self._described = why and (
            f'{self.resolve_topic_name(DESCRIPTION)} is not the URDF of the cell, '
            f'{self._urdf_file}: {why}; make the cell for the arm that is there (remaster init)'
        )

    def _model_trouble(self, now: float) -> str:
        """Return why another node, or the robot description, has a different arm; '' if none has.

        ``now``: `steady_s`, s.
        """
        return self._models.trouble(now) or self._described

    def _on_waypoints(self, message: JointTrajectory) -> None:
        """Keep the waypoints, for the solutions with the same stamp."""
        self._waypoints = message

    def _on_solutions(self, message: JointTrajectory) -> None:
        """Process the joint solutions of a pose: correct them, and have the supervisor plan them.

        A repeated announcement (same stamp and solutions) is ignored, an invalid message dropped
        with an error in the log. Solutions that cannot be corrected are refused, each with its
        reason. A message without points is a stop.
        """
        try:
            targets = solutions_of(message, self.chain.joint_names)
            belongs = self._waypoints.header.stamp == message.header.stamp
            names = self.chain.joint_names
            waypoints = waypoints_by_solution(self._waypoints, names) if belongs else {}
            shares = curves_by_solution(self._waypoints) if belongs else {}
        except InputError as error:
            self.get_logger().error(f'joint_solutions dropped: {error}')
            return
        announced = stamp_key(message.header.stamp), targets
        if (
            len(targets)
            and announced[0] == self._announced[0]
            and (np.array_equal(targets, self._announced[1]))
        ):
            # Repeated for a node that lags. The arm goes on with it.
            return
        self._announced = announced
        refused: dict[int, str] = {}
        asked, self._changes = correction_asked(message), None
        if asked == 'on' and self._correction is None:
            why = 'a correction is asked for, and robot_bridge has none: see its compensation'
            refused = dict.fromkeys(range(len(targets)), why)
        # Switched between two poses, when the arm stands: a move under way is stopped first. With
        # it off the arm is where it is all the same, and so are its limits and its surroundings.
        if self._correction is not None and asked != 'off':
            # Before all checks: they are of what is commanded.
            done = self._correction.commands(targets)
            targets, self._changes = done.command, done.change
            for number, points in waypoints.items():
                waypoints[number], too_far = self._correction.for_waypoints(points)
                for why in too_far.values():
                    refused[number] = f'on its way {why}'
            refused |= done.refused
            self.counts['corrected_near_singularity'] += int(done.incomplete.sum())
            self.counts['corrected_outside_range'] += int(done.outside_range.sum())
            for note in done.notes:
                self.get_logger().info(note)
        self._pose_stamp = stamp_key(message.header.stamp)
        self._do(self.supervisor.plan(targets, self.steady_s(), waypoints, refused, shares))

    def _on_joint_state(self, message: JointState, info: Mapping[str, Any]) -> None:
        """Process a report of the joints, then count its message as taken."""
        self._take_report(message, info)
        # Last: what was decided by this report has been published.
        self._taken.take(message.header.stamp)

    def _take_report(self, message: JointState, info: Mapping[str, Any]) -> None:
        """Pass the arm's joint positions on to the supervisor, or why a message has none.

        Instead of positions it is told: that there is no time, that the message is invalid,
        has no joint of the arm, or that several publishers send the arm's joints.
        """
        now = self.steady_s()
        if self.clock_trouble:
            self._do(self.supervisor.observe('clock', self.clock_trouble, now))
            return
        try:
            q = self._states.take(message, info)
        except InputError as error:
            self.supervisor.reports.refused['joints'] += 1
            self._do(self.supervisor.doubt(str(error), now))
            return
        if q is None:
            self.supervisor.other_joints(self._states.others, now)
            return
        if rival := self._states.rival():
            # Whose report this is, is not known.
            self._do(self.supervisor.observe('rivals', rival, now))
            return
        report = JointReport(seconds(message.header.stamp), q, self.now_s(), now)
        self._do(self.supervisor.report(report))

    def _on_emergency_stop(self, stopped: bool) -> None:
        """Tell the supervisor whether the robot's own safety stops it."""
        self._do(self.supervisor.emergency(stopped, self.steady_s()))

    def _on_clear_halt(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve a request to clear a halt, also in its file; or answer why it is refused."""
        refusal = self.supervisor.clear_halt()
        response.success = not refusal
        response.message = refusal or 'cleared; /remaster/collect goes on'
        if not refusal:
            self._disk.submit(self._halt_file.clear, self._on_written)
            self._keep_end()
            self.status.event(events.HaltCleared(stamp=self._pose_stamp))
            self.status.publish()
        return response

    def _watch(self) -> None:
        """Tell the supervisor the present trouble, or '', of each thing that can block the arm.

        These are rivals (other publishers), arm model, controller, clock and safety circuit;
        also whether the controller keeps stamps. Timer callback, every `WATCH_WALL_S`.
        """
        now = self.steady_s()
        troubles = (only.trouble() for only in self._only)
        rivals = self._states.rival() or next(filter(None, troubles), '')
        if self._controller is not None:
            rivals = rivals or self._controller.rival()
        self.supervisor.use_stamps(kept=self._keeps_stamps())
        for name, trouble in (
            ('rivals', rivals),
            ('model', self._model_trouble(now)),
            ('controller', self._controller_trouble(time.monotonic())),
            ('clock', self.clock_trouble),
            ('safety_link', self._emergency.trouble()),
        ):
            self._do(self.supervisor.observe(name, trouble, now))

    def _keeps_stamps(self) -> bool:
        """Whether the controller starts a trajectory at the time of its stamp.

        By the parameter `trajectory_stamps`; if that is auto, it does if it publishes its
        state as joint_trajectory_controller does (`ControllerStates`).
        """
        if self.p.trajectory_stamps != 'auto':
            return self.p.trajectory_stamps == 'kept'
        return self._states_of_controller.is_there()

    def _controller_trouble(self, now: float) -> str:
        """Return why a command would be lost, or another client commands; '' if neither.

        Makes the link to the controller once this bridge is the only one of its name. A controller
        counts `MATCHED_WALL_S` after it was seen to listen. ``now``: `time.monotonic`, s.
        """
        if self._controller is None:
            if not self.status.alone(now):
                return 'looking for another robot_bridge of this name'
            if self.p.command_interface == 'action':
                rules = self.supervisor.rules
                self._controller = ActionLink(self, rules, self._foreign, self._on_given_up)
            else:
                self._controller = TopicLink(self, simulated=bool(self.p.simulated_clock_rate))
        if not self._controller.listens():
            self._listened_wall = None
        elif self._listened_wall is None:
            self._listened_wall = now
        if self._listened_wall is None or now - self._listened_wall < MATCHED_WALL_S:
            self._foreign.begin()
            return self._controller.missing
        return self._foreign.trouble()

    def _on_given_up(self, why: str) -> None:
        """Log why the controller has given up a command, and tell the supervisor."""
        self.get_logger().error(why)
        self._do(self.supervisor.given_up(why))

    # What goes out

    def _do(self, actions: list[Action]) -> None:
        """Carry out the supervisor's actions in order; late commands are not published.

        Path checks and the halt file go to the background; commands to the controller; outcomes to
        events, counts and log. The supervisor is told of a command that is late (`_is_late`).
        Moves are left out once the node is closing.
        """
        stops = any(isinstance(action, Stop) for action in actions)
        for action in actions:
            match action:
                case Drive() | Renew() if self._closing:
                    pass
                case CheckPath():
                    self._paths.submit(
                        partial(self._search.find, action), partial(self._on_path, action.number)
                    )
                case Drive() | Renew() | Stop() if self._is_late(action):
                    # Paused in between (SIGSTOP, a host that swaps): the arm is elsewhere now, or
                    # must not move any more.
                    self._do(self.supervisor.not_sent(action, self.steady_s()))
                case Drive():
                    self._send(action)
                    self._on_commanded(action)
                case Renew():
                    self._send(action)
                case Stop(_, reason):
                    self._send(action)
                    self.counts['stopped'] += 1
                    self.status.event(events.ArmStopped(stamp=self._pose_stamp, reason=reason))
                    self.get_logger().info(f'stopping the arm: {reason}')
                case Settled():
                    self._announce(action)
                case Failed(solution, reason):
                    self.counts['failed'] += 1
                    self.status.event(
                        events.SolutionFailed(
                            stamp=self._pose_stamp, solution=solution, reason=reason
                        )
                    )
                case Halted(reason):
                    if self._controller is not None and not stops:
                        # Nothing else follows.
                        self._controller.cancel()
                    self._disk.submit(partial(self._halt_file.write, reason), self._on_written)
                    self.status.event(events.ArmHalted(stamp=self._pose_stamp, reason=reason))
                    self.status.publish()
                    self.get_logger().error(f'halted: {reason}')
        self._tell_missed()
        self._keep_end()

    def _tell_missed(self) -> None:
        """Publish and log that the arm stops, as the next piece of its move came too late.

        A long move is sent in pieces, one after the other. The event is counted in
        ``stopped``. Nothing if no piece was late since the last call.
        """
        if self.supervisor.missed == self._missed:
            return
        self._missed = self.supervisor.missed
        reason = f'the next piece of its move came too late: {self.supervisor.why_missed}'
        self.counts['stopped'] += 1
        self.status.event(events.ArmStopped(stamp=self._pose_stamp, reason=reason))
        self.get_logger().warning(f'the arm stops: {reason}')

    def _keep_end(self) -> None:
        """Write down where the last command leads, for a bridge after this one, in the background.

        Nothing in a simulation, before the first command, or if it is written already.
        """
        end, following = self.supervisor.end, self.supervisor.next_end
        if not self._keeps_end or end is None or end is self._kept_end:
            return
        self._kept_end = end
        write = partial(self._command_file.write, end, time.time_ns(), following)
        self._disk.submit(write, self._on_end_written)

    def _on_end_written(self, result: object) -> None:
        """Log an error if `result` is the exception of writing the last command's file."""
        if isinstance(result, Exception):
            self.get_logger().error(
                f'{self._command_file.path}: where the arm was led last is not kept ({result})'
            )

    def _is_late(self, command: Drive | Renew | Stop) -> bool:
        """Whether a command was decided too long ago to be published (`LATE_WALL_S`).

        A move with a stamp has the limit of a renewal, since it begins at a time.
        """
        limit_s = LATE_WALL_S[type(command)]
        if isinstance(command, Drive) and command.begins_s:
            # It begins at a time, and not when it comes.
            limit_s = LATE_WALL_S[Renew]
        return self.steady_s() - command.wall_s > limit_s

    def _send(self, command: Drive | Renew | Stop) -> None:
        """Publish a command; if that fails, tell the supervisor and raise the exception again."""
        try:
            kind = {Stop: 'stop', Renew: 'renewal', Drive: 'move'}[type(command)]
            self._publish(command.admitted, kind, command.begins_s)
        except Exception:
            self._do(self.supervisor.not_sent(command, self.steady_s()))
            raise

    def _publish(self, admitted: Admitted, kind: str = 'move', begins_s: float = 0.0) -> None:
        """Publish a trajectory that the gate has admitted; nothing else goes to a controller.

        ``kind``: move, renewal or stop; ``begins_s``: its stamp, by the robot's clock, s; 0 for at
        once.
        """
        # A stop is a trajectory too: an empty one is refused by some versions of
        # joint_trajectory_controller, and the arm goes on.
        message = JointTrajectory(joint_names=list(self.chain.joint_names))
        if begins_s:
            # That of the robot's own clock, which its reports have: all pieces of a move are one
            # function of its time, and none is joined to where the arm is reported.
            message.header.stamp = stamp_of(begins_s)
        message.points = [
            JointTrajectoryPoint(
                positions=point.q.tolist(),
                velocities=point.velocity.tolist(),
                time_from_start=duration_of(point.time_s),
            )
            for point in admitted.waypoints
        ]
        assert self._controller is not None
        self._controller.send(message, kind)

    def _on_commanded(self, drive: Drive) -> None:
        """Count a move to a solution, and publish its event; log a probe longer than `PROBE_S`.

        A probe leads the arm to where it is reported. Moves that are not to a solution
        (`solution` < 0) are not counted. ``drive``: the move, which has been sent.
        """
        solution, duration_s = drive.solution, drive.admitted.waypoints[-1].time_s
        if solution == PROBE and duration_s > PROBE_S:
            self.get_logger().info(
                f'for {duration_s:.0f} s the arm is led to where it is reported, as it is not '
                'sure that it is there; where it is, it stands meanwhile'
            )
        if solution < 0:
            return
        self.counts['commanded'] += 1
        self.status.event(
            events.SolutionCommanded(
                stamp=self._pose_stamp,
                solution=solution,
                since_settled_wall_s=self.steady_s() - self._settled_wall,
            )
        )

    def _on_path(self, number: int, answer: PathAnswer | Exception) -> None:
        """Give the answer of a path check to the supervisor; an exception counts as 'no path'.

        ``number``: of the check, by which the supervisor knows an outdated answer.
        """
        if isinstance(answer, Exception):
            self.get_logger().error(f'the path could not be checked: {answer!r}')
            answer = PathAnswer(None, f'it could not be checked ({answer})')
        self._do(self.supervisor.path_found(number, answer, self.steady_s()))

    def _on_written(self, result: object) -> None:
        """Log an error if `result` is the exception of writing the halt file."""
        if isinstance(result, Exception):
            self.get_logger().error(f'{self._halt_file.path}: the halt is not kept ({result})')

    def _announce(self, settled: Settled) -> None:
        """Publish where the arm has settled: remaster/settled and an event.

        With a correction on, the message also has the wanted positions, named with `WANTED`:
        the settled ones less the change that the correction has made.
        """
        self._settled_wall = self.steady_s()
        self.counts['settled'] += 1
        names, q = list(self.chain.joint_names), settled.q
        if self._changes is not None:
            names += [f'{WANTED}{name}' for name in names]
            q = np.concatenate((q, q - self._changes[settled.solution]))
        message = JointState(name=names, position=q.tolist())
        message.header.stamp = stamp_of(settled.stamp_s)
        self._settled.publish(message)
        self.status.event(
            events.SolutionSettled(
                stamp=self._pose_stamp,
                solution=settled.solution,
                motion_s=settled.motion_s,
                settle_s=settled.settle_s,
            )
        )

    def _summary(self) -> Summary:
        """Summary for the status: counts, what blocks the arm, and the bridge's state.

        The level is error if halted, warn if blocked, else ok.
        """
        supervisor, now = self.supervisor, self.steady_s()
        blocked = supervisor.blocked(now)
        text = 'moving or measuring' if supervisor.busy else 'waiting for a pose'
        refused = supervisor.reports.refused
        values = {
            **self.counts,
            **{f'joints_refused_{reason}': count for reason, count in sorted(refused.items())},
            'moves_refused': supervisor.gate.refused,
            'moves_cut_short': supervisor.missed,
        }
        age_s = supervisor.report_age_s(now)
        state = events.BridgeState(
            halted=supervisor.halted,
            pose=self._pose_stamp,
            run=self._run,
            asks_for_collect=supervisor.asks_for_collect,
            joints_age_s=age_s if np.isfinite(age_s) else None,
            joints_trouble=supervisor.trouble,
            correction='' if self._correction is None else self._correction.sha256,
        )
        level = 'error' if supervisor.halted else 'warn' if blocked else 'ok'
        return Summary(level, blocked or text, values, state)

    def close(self) -> None:
        """Stop the arm, and wait for the controller's answer and for files to be written."""
        self._closing = True
        self._do(self.supervisor.planner_is('gone: the bridge stops', self.steady_s()))
        if self._controller is not None:
            self._controller.close()
        self._paths.close(0.5)
        self._disk.close()


def main(args: list[str] | None = None) -> int:
    """Run the node; return its exit status, see `running.run`."""
    # A path check must not keep a stop waiting for the interpreter: 1 ms instead of 5.
    sys.setswitchinterval(1e-3)
    make: Callable[[], RemasterNode] = RobotBridge
    return run(make, args)


if __name__ == '__main__':
    raise SystemExit(main())
