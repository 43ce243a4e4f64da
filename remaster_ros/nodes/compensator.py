# SPDX-License-Identifier: Apache-2.0
"""Correct what other planners send to an arm's controller, and tell them where the arm is.

A planner (MoveIt, say) that plans for the nominal arm sends its trajectories to this node in place
of the controller, and reads this node's joint_states in place of the arm's. What is sent on comes
from the motion gate (`motion.motion_gate.ForeignGate`). Nothing is known here of what stands in
the way: that is the planner's.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection.message_fields import JointOrder, refuse_repeated, seconds
from remaster_ros.errors import InputError
from remaster_ros.kinematics.same_arm import axes_apart, difference
from remaster_ros.motion.actions import SupervisorRules
from remaster_ros.motion.following import ON_PATH_RAD, allowed_lag_s
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.led_last import LedLast
from remaster_ros.motion.limits import ACCELERATION, MotionLimits
from remaster_ros.motion.motion_gate import (
    START_RAD,
    Admitted,
    ForeignGate,
    MotionRefusedError,
)
from remaster_ros.motion.motion_under_way import STOPPED_S
from remaster_ros.motion.settling import SettleRules
from remaster_ros.nodes.arm_states import JOINTS, ArmStates
from remaster_ros.nodes.background import Background
from remaster_ros.nodes.controller_link import control_messages
from remaster_ros.nodes.messages import duration_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.rivals import OnlyPublisher
from remaster_ros.nodes.robot_bridge import DESCRIPTION, DESCRIPTION_QOS, NEWEST_STATES
from remaster_ros.nodes.running import RemasterNode, fault_of_this_program, run
from remaster_ros.nodes.status import LEASED, RELIABLE
from remaster_ros.session.bridge_files import LastCommandFile
from remaster_ros.types import FloatArray

NOW_S = 0.1
"""A trajectory whose stamp is so near to now begins at once, s: it was stamped when it was sent.
One for another time would begin where nobody has looked."""
NEARER = 0.5
"""A description holds the correction if its axes are turned from those of the corrected arm by
less than this share of what they are from the nominal one's: its form may leave out a part."""
FARTHEST_RAD = 200.0 * np.pi
"""A joint is reported no further from zero, rad: a hundred turns."""
WATCH_S = 0.1
"""How often it is looked at whether it may begin, s of wall time."""
HOLD_S = 3.0
"""A second publisher of the arm's joints counts for so long after it was noticed last, s."""
LAST_ANSWER_WALL_S = 0.5
"""A node that ends waits so long for the answer to a cancelling, s."""
WARM_S = 60.0
"""A temperature holds for so long, s: arms warm up over tens of minutes."""
SAME_WORDS_S = 1.0
"""The same refusal is said once in so much time, s: some programs send ten times a second."""


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the compensator."""

    compensation: str = parameter(
        '',
        'compensation.json by which everything is corrected; must be given; read at the start '
        'and by ~/enable',
    )
    controller: str = parameter(
        'joint_trajectory_controller',
        'name of the controller: its topic …/joint_trajectory and its action '
        '…/follow_joint_trajectory',
    )
    tolerance_mm: float = parameter(
        0.02,
        'how far the tool may leave the wanted path between two points',
        unit='mm',
        low=0.001,
        high=10.0,
    )
    max_change_deg: float = parameter(
        2.0,
        'largest change of a joint; what has a joint off by more is refused',
        unit='deg',
        low=0.0,
        high=10.0,
    )
    acceleration_limit_rad_s2: float = parameter(
        ACCELERATION,
        'largest acceleration of each joint: a trajectory that would pass it is slowed down; give '
        "that of the planner's joint limits",
        unit='rad/s^2',
        low=0.01,
        high=1000.0,
    )
    temperature_topic: str = parameter(
        '',
        "sensor_msgs/Temperature of the arm, degrees Celsius; empty: that of the file's "
        'measurements',
    )


@dataclass(eq=False)
class _Goal:
    """A client's action goal, the goal sent to the controller for it, and whether it has ended."""

    handle: Any
    sent: Any = None
    cancelled: bool = False
    over: bool = False


class CompensatorNode(RemasterNode):
    """Node that corrects other planners' trajectories, and publishes true joint angles."""

    # Without it nobody stops what it has passed on: it does so itself, and stays.
    outlives_faults = True

    def __init__(self) -> None:
        super().__init__('compensator')
        self.p = declare(self, Parameters)
        if not self.p.compensation:
            raise InputError(
                'compensator: parameter compensation is empty; give the apply/compensation.json '
                'that fit, discover or report has written'
            )
        # It loads SciPy's interpolation, which other nodes need not.
        from remaster_ros.compensation import foreign_motion

        self._motion = foreign_motion
        self._correction = self._read()
        self._chain = self._correction.compensator.model.chain
        self._names = self._chain.joint_names
        self._true = foreign_motion.TrueAngles(self._correction.compensator)
        self._present = foreign_motion.ArmReports()
        self._order = JointOrder(self._names)
        self._states = ArmStates(self, self._names, HOLD_S)
        # Whether it corrects; None before the arm was seen to stand.
        self._on: bool | None = None
        self._description: str | None = None
        self._described = ''
        self._temperature_c: float | None = None
        self._warm_wall_s = -np.inf
        self._end_s = -np.inf
        # Why nothing is passed on before a person calls ~/enable: this program has failed; ''.
        self._halted = ''
        self._said: dict[str, float] = {}
        self._told = ''
        # What is worked out beside the callbacks, and numbers of what was wanted and is still.
        self._work, self._disk = Background(self), Background(self)
        self._numbers = itertools.count()
        self._wanted = -1
        # What was passed on last, and when (s of the node's clock).
        self._passed: Any = None
        self._begun_s = -np.inf
        names = self.get_fully_qualified_name()
        self._command_file = LastCommandFile(names, self._names)
        # A simulated arm begins anew with each world: nothing holds from the one before.
        self._keeps_end = not self.get_parameter('use_sim_time').value
        last = self._command_file.read(time.time_ns()) if self._keeps_end else None
        self._led = LedLast(
            self._names,
            JointUnits.of(self._chain),
            SettleRules().arrive_tolerance,
            None if last is None else last.end,
            self.resolve_topic_name('~/enable'),
        )
        self._goals: list[_Goal] = []
        controller = self.p.controller
        self._commands_topic = self.resolve_topic_name(f'{controller}/joint_trajectory')
        self._only = OnlyPublisher(self, self._commands_topic, JointTrajectory)
        self._commands = self.create_publisher(JointTrajectory, self._commands_topic, LEASED)
        self._angles = self.create_publisher(JointState, '~/joint_states', RELIABLE)
        self._state = self.create_publisher(String, '~/state', DESCRIPTION_QOS)
        self.create_subscription(String, DESCRIPTION, self._on_description, DESCRIPTION_QOS)
        self.create_subscription(JointState, JOINTS, self._on_joint_state, NEWEST_STATES)
        self.create_subscription(
            JointTrajectory, '~/joint_trajectory', self._on_trajectory, RELIABLE
        )
        if self.p.temperature_topic:
            self.create_subscription(
                Temperature, self.p.temperature_topic, self._on_temperature, RELIABLE
            )
        self.create_service(Trigger, '~/enable', partial(self._switch, True))
        self.create_service(Trigger, '~/disable', partial(self._switch, False))
        self._client: ActionClient | None = None
        try:
            self._offer_action(f'{controller}/follow_joint_trajectory')
        except InputError:
            self.get_logger().warning(
                'control_msgs is not installed (apt install ros-jazzy-control-msgs): there is the '
                'topic ~/joint_trajectory alone, and MoveIt sends by the action'
            )
        for remark in self._correction.remarks if not self.p.temperature_topic else []:
            self.get_logger().warning(remark)
        # Of wall time: a simulated one may not have come.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_S, self._look, clock=self._steady)

    def _read(self) -> Any:
        """Read the correction in use from the file of the parameter `compensation`.

        Raises InputError: no such file or not a valid one, a joint slides, or the correction
        would change a joint by over `max_change_deg` somewhere in its range.
        """
        from remaster_ros.compensation.in_use import CorrectionInUse

        return CorrectionInUse(self.p.compensation, most_deg=self.p.max_change_deg)

    def on_fault(self, error: Exception) -> None:
        """Halt after a fault of this program: cancel goals, refuse trajectories until ~/enable.

        If the arm moves, a braking trajectory is published on the controller's topic. The
        fault is logged as in `RemasterNode.on_fault`. While the node is being constructed, the
        fault is only logged.
        """
        super().on_fault(error)
        if not hasattr(self, '_steady'):
            # It is being made: nothing has been passed on.
            return
        self._halted = f'{fault_of_this_program(error)}; look at the arm, then call ~/enable'
        self._end_s = -np.inf
        for goal in list(self._goals):
            goal.cancelled = True
            if goal.sent is not None:
                goal.sent.cancel_goal_async()
        self._wanted = -1
        self._note_held()
        present = self._present
        moves = present.is_known and present.is_fresh(time.monotonic()) and not present.stands
        if moves and self._on is not None:
            stop = self._gate.brake(present.q, present.velocity)
            self._commands.publish(self._message(stop))

    # Whether it may pass anything on

    def _on_description(self, message: String) -> None:
        """Store the published robot description, and why it does not fit the correction, if so.

        The reason is that of `_described_trouble`, '' if it fits.
        """
        self._description = message.data
        self._described = self._described_trouble()

    def _described_trouble(self) -> str:
        """Sentence on why the robot description does not go with the correction; '' if it does.

        Reasons: none was published; it contains this correction already (its axes are far
        nearer to those of the corrected arm than to the nominal ones, `NEARER`); or it is of
        another URDF than the one that the correction was measured with.
        """
        topic = self.resolve_topic_name(DESCRIPTION)
        if self._description is None:
            return (
                f'nobody publishes {topic}: start robot_state_publisher with the URDF that the '
                'planner has'
            )
        why = difference(self._chain, self._description)
        true_arm = self._correction.true_arm
        distances = [axes_apart(arm, self._description) for arm in (true_arm, self._chain)]
        if why and distances[0] < NEARER * distances[1]:
            return (
                f'{topic} holds this correction already: give robot_state_publisher and the '
                'planner the nominal description, or end the compensator'
            )
        return why and (
            f'{self._correction.path} is of another URDF than {topic}: {why}; give the one that '
            'was measured with this arm'
        )

    def _trouble(self) -> str:
        """Return why trajectories are refused at present; '' if they are not.

        In this order: a halt; a controller that is itself a compensator; no fresh joint states
        (`ArmReports.is_fresh`); a temperature older than `WARM_S`; a clock without time; a
        robot description that does not fit the correction; another publisher of the arm's
        joints, or of commands; an arm that is not where it was led to (`_misled`).
        """
        topic = self.resolve_topic_name(JOINTS)
        if self._halted:
            return self._halted
        if self._description is None:
            self._described = self._described_trouble()
        chained = f'{self._commands_topic.rpartition("/")[0]}/joint_states'
        if self.count_publishers(chained):
            return (
                f'{self.p.controller} is a compensator itself ({chained} has a publisher): '
                'corrected twice; end one of them'
            )
        if not (self._present.is_known and self._present.is_fresh(time.monotonic())):
            other_joints = f' ({self._states.others})' if self._states.others else ''
            return f'{topic} does not come{other_joints}'
        if self.p.temperature_topic and time.monotonic() - self._warm_wall_s > WARM_S:
            topic = self.resolve_topic_name(self.p.temperature_topic)
            return f'{topic} has not come for {WARM_S:.0f} s'
        return (
            self.clock_trouble
            or self._described
            or self._states.rival()
            or self._only.trouble()
            or self._misled()
        )

    def _misled(self) -> str:
        """Sentence that the arm is not reported where it was led to; '' if it is.

        Until `STOPPED_S` after the end of the last trajectory passed on, the reported joints
        have to be within `ON_PATH_RAD` of where that trajectory is now or was within the
        allowed lag. Later, or if none was passed on, `LedLast.elsewhere` decides.
        """
        q, since_s = self._present.q, self.now_s() - self._begun_s
        passed = self._passed
        if passed is not None and passed.admitted.waypoints and since_s < passed.end_s + STOPPED_S:
            samples = passed.samples(since_s - allowed_lag_s(SupervisorRules(), 1.0), since_s)
            if np.abs(samples - q).max(axis=1).min() <= ON_PATH_RAD:
                return ''
            return 'the arm is not reported on the way of the trajectory that was passed on'
        return self._led.elsewhere(q)

    def _moves(self) -> str:
        """Return why the arm does not count as standing; '' if it stands.

        Reasons: no fresh joint states, motion within the last `following.STANDING_S`
        (`ArmReports.stands`), or a trajectory passed on that has not ended.
        """
        if not self._present.is_fresh(time.monotonic()):
            return f'{self.resolve_topic_name(JOINTS)} does not come'
        if not self._present.stands:
            return 'the arm moves: wait until it stands'
        left_s = self._end_s - self.now_s()
        return f'a trajectory is under way for {left_s:.1f} s more' if left_s > 0.0 else ''

    def _look(self) -> None:
        """Switch the correction on once the arm stands without trouble; publish the state.

        Timer callback, every `WATCH_S`. It switches on by itself only if nobody has switched
        it before. Goals end as aborted if the controller's action server has gone.
        """
        trouble = self._trouble()
        if self._on is None and not (trouble or self._moves()):
            self._turn(True)
        self._tell(trouble)
        if self._goals and self._client is not None and not self._client.server_is_ready():
            for goal in list(self._goals):
                why = f'{self._controllers}: the controller has gone'
                self._end(goal, GoalStatus.STATUS_ABORTED, self._refused(why))

    def _switch(self, on: bool, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve a request to switch the correction on (its file is read anew) or off.

        Refused, with the reason in the response, while the arm moves or is not reported. On is
        also refused if the arm is not where it was led to and this has not been confirmed by a
        second call (`LedLast.confirm`), or if the file is invalid, of other joints, or
        contradicts the robot description; the correction before remains then. Switching on
        ends a halt.
        """
        why = self._moves()
        if on and not why and self._led.elsewhere(self._present.q):
            why = self._led.confirm(self._present.q)
        if on and not why:
            try:
                correction = self._read()
                if correction.compensator.joint_names != self._names:
                    raise InputError(
                        f'{correction.path}: has other joints now; start the compensator again'
                    )
                self._correction, before = correction, self._correction
                self._chain = correction.compensator.model.chain
                if why := self._described_trouble():
                    self._correction = before
                    self._chain = before.compensator.model.chain
                self._described = self._described_trouble()
            except InputError as error:
                why = str(error)
        response.success = not why
        if on and not why:
            self._halted = ''
        response.message = why or self._turn(on)
        self._tell(self._trouble())
        return response

    def _turn(self, on: bool) -> str:
        """Switch the correction on or off; log and return a sentence with its file and state.

        The motion gate, and the object that computes true joint angles, are replaced by new
        ones for this correction. A trajectory that is still being corrected will not be passed
        on.
        """
        self._on, self._wanted = on, -1
        self._true = self._motion.TrueAngles(self._correction.compensator)
        self._in_use = used = self._correction if on else self._correction.off()
        limits = MotionLimits.of(self._chain, 1.0, used.shifts, self.p.acceleration_limit_rad_s2)
        self._gate = ForeignGate(limits)
        checksum = self._correction.sha256[:8]
        text = f'{self._correction.path}, checksum {checksum}: ' + (
            'everything is corrected by it, as it is now'
            if on
            else 'not in use; nothing is corrected'
        )
        self.get_logger().info(text)
        return text

    def _tell(self, trouble: str) -> None:
        """Publish ~/state (JSON, latched) if it has changed, and log the reason in it, if any.

        The state has ``correction`` (on or off), ``sha256`` of its file, and ``why``
        trajectories are refused ('' if they are not). ``trouble``: as returned by `_trouble`.
        """
        state = {
            'correction': 'on' if self._on else 'off',
            'sha256': self._correction.sha256,
            'why': trouble or ('' if self._on is not None else self._moves()),
        }
        text = json.dumps(state)
        if text != self._told:
            self._told = text
            self._state.publish(String(data=text))
            if state['why']:
                self._say(f'nothing is passed on: {state["why"]}')

    def _say(self, words: str) -> None:
        """Log an error; one that repeats the last one only if `SAME_WORDS_S` have passed."""
        now = time.monotonic()
        if now - self._said.get(words, -np.inf) >= SAME_WORDS_S:
            self._said = {words: now}
            self.get_logger().error(words)

    # Where the arm is

    def _on_temperature(self, message: Temperature) -> None:
        """Keep a temperature, °C, and when it came; ignore one that is not finite."""
        if np.isfinite(message.temperature):
            self._temperature_c, self._warm_wall_s = message.temperature, time.monotonic()

    @property
    def _warm(self) -> float | None:
        """Temperature to correct with, °C; None if the correction needs none or none has come."""
        return self._temperature_c if self._correction.compensator.model.grows else None

    def _on_joint_state(self, message: JointState, info: Any) -> None:
        """Publish received joint states, with the arm's true angles if the correction is on.

        With the correction off the angles are published as reported. Joint states of the arm
        are not published before the correction is first switched on or off, nor if a position
        is not finite or beyond `FARTHEST_RAD`, which is logged. Messages that name no joint of
        the arm are published unchanged.
        """
        if not self._order.concerns(message):
            # A gripper's: the planner wants to know of it too.
            self._states.note(message, info)
            self._angles.publish(message)
            return
        try:
            q = self._states.take(message, info)
        except InputError as error:
            self._say(str(error))
            return
        if q is None or not np.all(np.abs(q) <= FARTHEST_RAD):
            self._say(
                f'{self.resolve_topic_name(JOINTS)}: a position is no number, or of no joint'
            )
            return
        stamp_s = seconds(message.header.stamp)
        self._present.take(stamp_s, q, time.monotonic())
        if self._on is None:
            return
        if self._on:
            true = self._true.at(q, self._warm, time.monotonic())
            at = {name: i for i, name in enumerate(message.name)}
            for name, value in zip(self._names, true, strict=True):
                message.position[at[name]] = float(value)
        self._angles.publish(message)

    # What is passed on

    def _submit(
        self,
        message: JointTrajectory,
        pass_on: Callable[[JointTrajectory], None],
        refuse: Callable[[str], None],
    ) -> None:
        """Correct a planner's trajectory in the background; then pass it on, or refuse it.

        ``pass_on``: called with the corrected message; ``refuse``: called with the reason. The
        trajectory is refused at once if `_trouble` has a reason, if the correction was never
        switched on or off, or if its stamp is neither 0 nor within `NOW_S` of now. A newer
        trajectory replaces one that is still being corrected. A trajectory without points, by
        which the controller holds the arm, is passed on at once.
        """
        number = self._wanted = next(self._numbers)
        try:
            why = self._trouble()
            if not why and self._on is None:
                why = self._moves() or 'the compensator has just been started'
            if why:
                raise InputError(why)
            stamp_s = seconds(message.header.stamp)
            ahead_s = stamp_s - self.now_s()
            if stamp_s and abs(ahead_s) > NOW_S:
                raise InputError(f'its stamp is {ahead_s:+.2f} s from now: give none, for at once')
        except InputError as error:
            refuse(str(error))
            return
        arm = self._present.snapshot()
        planner_q = arm.q + self._true.added if self._on else None
        work = partial(
            self._work_out, message, arm, self._gate, self._in_use, self._warm, planner_q
        )

        def take(found: Any) -> None:
            why = self._outdated(number, arm, found)
            if isinstance(found, InputError):
                refuse(str(found))
            elif isinstance(found, Exception):
                refuse(str(fault_of_this_program(found)))
                self.on_fault(found)
            elif why:
                refuse(why)
            else:
                passed, sent = found
                if not arm.stands:
                    # It has gone on meanwhile.
                    q, velocity = self._present.q, self._present.velocity
                    passed = replace(passed, start=q, velocity=velocity)
                for note in passed.notes:
                    self.get_logger().info(note)
                pass_on(sent)
                self._note_led(passed)

        if message.points:
            self._work.submit(work, take)
            return
        try:
            found: Any = work()
        except InputError as error:
            found = error
        take(found)

    def _work_out(
        self,
        message: JointTrajectory,
        arm: Any,
        gate: ForeignGate,
        in_use: Any,
        warm: float | None,
        planner_q: FloatArray | None,
    ) -> tuple[Any, JointTrajectory]:
        """Return the corrected trajectory (`SentTrajectory`) and its message.

        ``arm``: the arm's last reports, a snapshot; ``gate``: admits the corrected motion;
        ``in_use``: the correction; ``warm``: temperature, °C, or None; ``planner_q``: the
        arm's angles as published to the planner, rad, (k,), None with the correction off. Uses
        no state that callbacks change. Raises InputError if the trajectory is refused.
        """
        wanted = self._motion.Trajectory(*_points(message, self._names))
        passed = self._motion.corrected_for_controller(
            wanted, arm, gate, in_use, 1e-3 * self.p.tolerance_mm, warm, planner_q
        )
        return passed, self._message(passed.admitted)

    def _outdated(self, number: int, arm: Any, found: Any) -> str:
        """Return why a corrected trajectory is no longer to be passed on; '' if it is to be.

        Reasons: a newer trajectory has come; `_trouble` has a reason now; the arm stood and
        has moved by more than `START_RAD` since; the arm moves, and the motion gate refuses
        the trajectory from where the arm is now. ``number``: of the trajectory; ``arm``:
        snapshot of the arm's reports that `_work_out` used; ``found``: result of `_work_out`,
        or its exception.
        """
        if number != self._wanted:
            return 'another trajectory has come since'
        if why := self._trouble():
            return why
        if arm.stands:
            moved = np.abs(self._present.q - arm.q).max() > START_RAD
            return 'the arm has moved since it came' if moved else ''
        if isinstance(found, Exception):
            return ''
        admitted = found[0].admitted
        try:
            self._gate.admit(
                admitted.waypoints,
                self._present.q,
                self._present.velocity,
                is_straight=admitted.is_straight,
            )
        except MotionRefusedError as error:
            return str(error)
        return ''

    def _note_led(self, passed: Any) -> None:
        """Keep a trajectory that was passed on, its begin and end time, and its last position.

        ``passed``: `SentTrajectory`. An empty one leads nowhere: the controller holds the arm
        (`_note_held`).
        """
        self._true.lead(passed)
        if not passed.admitted.waypoints:
            self._note_held()
            return
        self._passed, self._begun_s = passed, self.now_s()
        self._end_s = self._begun_s + passed.end_s
        self._keep(passed.admitted.waypoints[-1].q)

    def _note_held(self) -> None:
        """Note that the controller holds the arm somewhere along the trajectory passed on last.

        All places of the trajectory within the allowed lag before and after now are kept as
        possible. No trajectory counts as under way any more.
        """
        passed, since_s = self._passed, self.now_s() - self._begun_s
        if passed is not None and passed.admitted.waypoints and since_s < passed.end_s:
            lag_s = allowed_lag_s(SupervisorRules(), 1.0)
            self._keep(*passed.samples(since_s - lag_s, since_s + lag_s))
        self._passed, self._end_s = None, self.now_s()

    def _keep(self, *samples: FloatArray) -> None:
        """Keep the positions that the arm is led to; write the last one to the command file.

        ``samples``: configurations at which the arm may come to rest, rad, (k,) each. The file
        is written in the background, and not in a simulation.
        """
        self._led.lead_to(*samples)
        if self._keeps_end:
            write = partial(self._command_file.write, samples[-1], time.time_ns())
            self._disk.submit(write, self._on_written)

    def _on_written(self, result: object) -> None:
        """Log an error if `result` is the exception of writing the command file."""
        if isinstance(result, Exception):
            self._say(f'{self._command_file.path}: where the arm was led is not kept ({result})')

    def _message(self, admitted: Admitted) -> JointTrajectory:
        """Return an admitted trajectory as a message; nothing else is ever sent.

        Its stamp is 0, for at once; points have no velocities if the trajectory is straight.
        """
        message = JointTrajectory(joint_names=list(self._names))
        message.points = [
            JointTrajectoryPoint(
                positions=point.q.tolist(),
                velocities=[] if admitted.is_straight else point.velocity.tolist(),
                time_from_start=duration_of(point.time_s),
            )
            for point in admitted.waypoints
        ]
        return message

    def _on_trajectory(self, message: JointTrajectory) -> None:
        """Correct a trajectory and publish it to the controller; refused without a subscriber.

        A refusal is logged.
        """

        def refuse(why: str) -> None:
            self._say(f'trajectory refused: {why}')

        if not self._commands.get_subscription_count():
            refuse(f'no controller listens to {self._commands_topic}')
            return
        self._submit(message, self._commands.publish, refuse)

    # The same by the action

    def _offer_action(self, controllers: str) -> None:
        """Create the action server ~/follow_joint_trajectory and a client of the controller.

        ``controllers``: name of the controller's action. Raises InputError if control_msgs is
        not installed.
        """
        self._action, _ = control_messages()
        self._controllers = self.resolve_topic_name(controllers)
        self._client = ActionClient(self, self._action, self._controllers)
        # It is executed when the controller has a result: rclpy would poll one that waits.
        self._server = ActionServer(
            self,
            self._action,
            '~/follow_joint_trajectory',
            lambda handle: self._action.Result(),
            handle_accepted_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )

    def _on_goal(self, handle: Any) -> None:
        """Correct the trajectory of a goal and send it to the controller, or refuse the goal.

        Refused, with a line in the log: a multi_dof_trajectory, no such action of the controller,
        and all that `_submit` refuses. The goal ends as cancelled then if the client cancelled it,
        else aborted.
        """
        goal = _Goal(handle)
        request = handle.request

        def refuse(why: str) -> None:
            self._say(f'goal refused: {why}')
            status = GoalStatus.STATUS_CANCELED if goal.cancelled else GoalStatus.STATUS_ABORTED
            self._end(goal, status, self._refused(why))

        def pass_on(sent: JointTrajectory) -> None:
            assert self._client is not None
            request.trajectory = sent
            answer = self._client.send_goal_async(request, partial(self._on_feedback, goal))
            answer.add_done_callback(partial(self._on_answer, goal))

        assert self._client is not None
        self._goals.append(goal)
        if request.multi_dof_trajectory.points:
            refuse('it has a multi_dof_trajectory, which is not corrected')
        elif not self._client.server_is_ready():
            refuse(f'no controller has the action {self._controllers}')
        else:
            self._submit(request.trajectory, pass_on, refuse)

    def _refused(self, why: str) -> Any:
        """Return a FollowJointTrajectory result with the error INVALID_GOAL and the reason."""
        return self._action.Result(error_code=self._action.Result.INVALID_GOAL, error_string=why)

    def _on_answer(self, goal: _Goal, future: Future) -> None:
        """Process whether the controller has accepted a goal; abort the client's goal if not.

        A refused goal that is the newest counts as never sent: the arm is where it was led to
        before. An accepted goal that the client has cancelled meanwhile is cancelled at the
        controller. Nothing happens if there was no answer.
        """
        if future.cancelled() or future.result() is None:
            return
        if not future.result().accepted:
            why = f'{self._controllers}: the controller refuses it; its log has why'
            self._say(f'goal refused: {why}')
            if goal is self._goals[-1]:
                # Nothing has led the arm.
                self._led.take_back()
                self._passed, self._end_s = None, self.now_s()
            self._end(goal, GoalStatus.STATUS_ABORTED, self._refused(why))
            return
        goal.sent = future.result()
        goal.sent.get_result_async().add_done_callback(partial(self._on_result, goal))
        if goal.cancelled:
            goal.sent.cancel_goal_async()

    def _on_feedback(self, goal: _Goal, message: Any) -> None:
        """Pass on feedback of the controller, with true joint angles if the correction is on.

        Nothing for a goal that is over. The angles are desired and actual positions, changed in
        place.
        """
        feedback = message.feedback
        if goal.over or not goal.handle.is_active:
            return
        if self._on:
            added = dict(zip(self._names, self._true.added, strict=True))
            for point in (feedback.desired, feedback.actual):
                point.positions = [
                    position + added[name]
                    for name, position in zip(feedback.joint_names, point.positions)
                    if name in added
                ]
        goal.handle.publish_feedback(feedback)

    def _on_cancel(self, handle: Any) -> CancelResponse:
        """Cancel a goal at the controller, or its correction in the background; return ACCEPT.

        ACCEPT also if the controller has ended it, and the result is on its way. REJECT if
        this node has no such goal any more.
        """
        for goal in self._goals:
            if goal.handle.goal_id == handle.goal_id:
                goal.cancelled = True
                if goal.sent is not None:
                    goal.sent.cancel_goal_async()
                elif goal is self._goals[-1]:
                    # What is still worked out for it is not passed on.
                    self._wanted = -1
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def _on_result(self, goal: _Goal, future: Future) -> None:
        """End the client's goal with the status and result of the controller.

        If it was the newest goal, no trajectory is under way any more, and if it failed, it is
        noted where the controller holds the arm. Nothing happens if there is no result.
        """
        if not future.cancelled() and future.result() is not None:
            if goal is self._goals[-1]:
                succeeded = future.result().status == GoalStatus.STATUS_SUCCEEDED
                if not succeeded:
                    self._note_held()
                self._end_s = self.now_s()
            self._end(goal, future.result().status, future.result().result)

    def _end(self, goal: _Goal, status: int, result: Any) -> None:
        """Tell the client how its goal has ended, and forget the goal; again does nothing.

        ``status``: of `GoalStatus`; one that is neither succeeded nor cancelled by this client is
        told as aborted.
        """
        if goal.over:
            return
        goal.over = True
        if goal in self._goals:
            self._goals.remove(goal)

        def ended(handle: Any) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                handle.succeed()
            elif status == GoalStatus.STATUS_CANCELED and handle.is_cancel_requested:
                handle.canceled()
            else:
                # Replaced by another goal, too, which is no cancelling of this client's.
                handle.abort()
            return result

        goal.handle.execute(ended)

    def close(self) -> None:
        """Cancel the goals under way, so that the controller holds the arm, and end the threads.

        Waits at most `LAST_ANSWER_WALL_S` for the controller's answers.
        """
        self._work.close(0.5)
        self._disk.close()
        awaited = [goal.sent.cancel_goal_async() for goal in self._goals if goal.sent is not None]
        executor, end = self.executor, time.monotonic() + LAST_ANSWER_WALL_S
        while executor is not None and not all(future.done() for future in awaited):
            if time.monotonic() > end or not self.context.ok():
                return
            executor.spin_once(timeout_sec=0.01)


def _points(
    message: JointTrajectory, names: tuple[str, ...]
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return times (n,), s, positions and velocities (n, k), joints in the order of `names`.

    Velocities are None if no point has any, or there are no points (n = 0). Raises InputError:
    other joints than the arm's, a joint named twice, a point without a position for each
    joint, or with velocities of some joints only, or velocities at some points only.
    """
    given = tuple(message.joint_names)
    none = np.zeros((0, len(names)))
    if not message.points:
        return np.zeros(0), none, None
    refuse_repeated(names, given, 'the trajectory')
    if set(given) != set(names):
        raise InputError(
            f"its joints are {', '.join(given) or 'none'}, the arm's {', '.join(names)}: give all "
            'of these and no others'
        )
    columns = [given.index(name) for name in names]
    counts = {len(point.velocities) for point in message.points}
    if {len(point.positions) for point in message.points} != {len(names)} or counts - {
        0,
        len(names),
    }:
        raise InputError('a point has not a position, or a velocity, for each joint')
    if len(counts) > 1:
        raise InputError('some points have velocities and others have not: give all or none')
    times = np.array([seconds(point.time_from_start) for point in message.points])
    positions = np.array([point.positions for point in message.points])[:, columns]
    if counts == {0}:
        return times, positions, None
    return times, positions, np.array([point.velocities for point in message.points])[:, columns]


def main(args: list[str] | None = None) -> int:
    """Run the node; return its exit status, see `running.run`."""
    # What is worked out must not keep a cancelling waiting for the interpreter: 1 ms instead of 5.
    sys.setswitchinterval(1e-3)
    make: Callable[[], RemasterNode] = CompensatorNode
    return run(make, args)


if __name__ == '__main__':
    raise SystemExit(main())
