"""Plan poses in front of the sensors; publish them one by one, each with all its joint solutions.

``/remaster/collect`` starts or resumes; ``/remaster/pause`` and ``/remaster/stop`` hold the arm.
Without a registration of every sensor the first poses serve the three-point registration.

The plan, the pose under way and what became of each configuration are in the session folder
before the arm moves. A planner that was killed goes on by itself where it was, if the run still
lives: recorder and bridge hold its token (see `run_token`). Where bridge or recorder were killed,
it announces what is left of the pose again.

Pause and stop have a thread of their own: neither planning nor the disk keeps them waiting. Their
state goes out first; what the journal must remember is written afterwards.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from remaster_ros.collection.events import (
    ArmHalted,
    BridgeState,
    ConfigurationEnded,
    EventRecord,
    PlannerState,
    RecorderState,
    SetupChanged,
    SolutionFailed,
    TourPlanned,
)
from remaster_ros.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.nodes.messages import JointOrder, transform_array
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.pose_publisher import PosePublisher
from remaster_ros.nodes.preflight_monitor import PreflightMonitor
from remaster_ros.nodes.run_token import LivingRun, silence_s
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    NodeStatus,
    Summary,
    listen,
)
from remaster_ros.nodes.tour_planner import PlanningThread, TourPlanner
from remaster_ros.planning.tour_order import REFERENCE, REGISTRATION, PoseVisit
from remaster_ros.session.plan_journal import NO_FREE_PATH, PlanJournal
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import FloatArray

RETRY_WALL_S = 1.0
"""How often a full disk is tried again, wall time."""


@dataclass(frozen=True)
class Parameters:
    """Parameters of the planner."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    optimization_candidates: int = parameter(
        60, 'candidate poses that the offsets are fitted on', low=1, high=10000
    )
    validation_candidates: int = parameter(
        60, 'candidate poses that the gain is proved on', low=0, high=10000
    )
    registration_candidates: int = parameter(
        12, 'candidate poses for the three-point registration', low=3, high=1000
    )
    seed: int = parameter(0, 'seed of the Latin hypercube', low=0)
    reference_every: int = parameter(
        25,
        'how many configurations lie between two visits to the reference configurations, by which '
        'a moved sensor or base, a slipped marker or encoder and drift are seen; 0 for none',
        low=0,
        high=100000,
    )
    session: str = parameter(
        'session', "folder of the recorder's session, where the plan is kept (plan.jsonl)"
    )
    resume_within_s: float = parameter(
        30.0,
        'a planner killed while collecting that is started again within this time goes on by '
        'itself; later it waits for /remaster/collect',
        unit='s',
        low=0.0,
        high=3600.0,
    )
    limit_margin_deg: float = parameter(
        1.0, 'distance kept from the joint limits', unit='deg', low=0.0, high=45.0
    )


class PosePlanner(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('pose_planner')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        self.chain = self.cell.chain()
        self._order = JointOrder(self.chain.joint_names)
        self._q: FloatArray | None = None
        self.T_R_N: dict[str, FloatArray] = {}
        self.state, self.phase, self._why = 'idle', REGISTRATION, ''
        # Of `state` and of what may be published only while it is 'running'.
        self._lock = threading.RLock()
        self._run: LivingRun | None = None
        # The run of a planner before this one, until it is known whether it still lives.
        self._left = ''
        self._registered = self._described = self._resumed = False
        counts = {
            'optimization': self.p.optimization_candidates,
            'validation': self.p.validation_candidates,
            REGISTRATION: self.p.registration_candidates,
        }
        margin = np.deg2rad(self.p.limit_margin_deg)
        self._tours = TourPlanner(
            self.cell, self.chain, counts, self.p.seed, margin, self.p.reference_every
        )
        self._planning = PlanningThread()
        model = self._tours.model
        self.journal = PlanJournal(Path(self.p.session), self._settings(), self.chain, model)
        self._tried_wall = 0.0
        self._resume()
        self._poses = PosePublisher(self, self.chain)
        self._joint_states: Subscription | None = self._listen_to_the_arm()
        self.create_subscription(JointState, 'remaster/settled', self._on_settled, RELIABLE)
        self.create_subscription(
            TransformStamped, 'remaster/registration', self._on_registration, LATCHED
        )
        at_once = MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, 'remaster/collect', self._on_collect)
        self.create_service(Trigger, 'remaster/pause', self._on_pause, callback_group=at_once)
        self.create_service(Trigger, 'remaster/stop', self._on_stop, callback_group=at_once)
        self.status = NodeStatus(self, self._summary, Path(self.cell.robot.urdf).stem)
        self._preflight, self._cleared = PreflightMonitor(self, self.cell), False
        listen(self, self._on_record)
        self.create_timer(0.05, self._step, clock=self.status.steady)

    def _settings(self) -> dict[str, Any]:
        """Return what the plan depends on."""
        p = self.p
        return {
            'cell': self.cell.fingerprint(),
            'optimization_candidates': p.optimization_candidates,
            'validation_candidates': p.validation_candidates,
            'registration_candidates': p.registration_candidates,
            'seed': p.seed,
            'reference_every': p.reference_every,
            'limit_margin_deg': p.limit_margin_deg,
        }

    def _resume(self) -> None:
        """Take up what a planner before this one has left."""
        journal = self.journal
        if journal.tour is None:
            return
        self._resumed = journal.tour.visited > 0
        if REGISTRATION not in journal.tour.plans:
            self.phase = 'collection'
        if journal.lost:
            self.get_logger().warning(journal.lost)
        if journal.state == 'complete':
            self.state = 'complete'
        else:
            self._left = journal.run if journal.state == 'running' else ''
            self._why = self._unwanted(
                '' if journal.state == 'running' else f'it was {journal.state}'
            )
        self.get_logger().warning(f'{journal.path}: going on; {self._progress()}')

    def _unwanted(self, why: str) -> str:
        """Return that, and why, this planner does not go on by itself."""
        reason = f' ({why})' if why else ''
        return f'{self._progress()}; /remaster/collect goes on{reason}'

    def _take_up_run(self) -> None:
        """Go on with a run that a killed planner has left, if it is certain that it still lives.

        Somebody may stand beside an arm that has not moved for a while.
        """
        passed_s = silence_s(self._left)
        bridge, recorder = self._poses.bridge, self._poses.recorder
        why = ''
        if passed_s is None:
            why = 'its run was in another boot of this computer, or was ended'
        elif passed_s > self.p.resume_within_s:
            why = f'its run has been without a planner for {passed_s:.0f} s'
        elif bridge is None or recorder is None:
            self._why = 'waiting for robot_bridge and recorder to confirm the run'
            return
        else:
            other = [peer.sender for peer in (bridge, recorder) if peer.run != self._left]
            if other:
                why = f'{" and ".join(other)} did not take part in its run'
            elif bridge.halted:
                why = f'the arm is halted: {bridge.halted}'
            elif recorder.changed_run in (self._left, ''):
                why = recorder.changed
        with self._lock:
            left, self._left = self._left, ''
            if left and not why:
                self._run = LivingRun(left)
                self._set_state('running')
        if why:
            self._why = self._unwanted(why)
            self.get_logger().warning(self._why)
            self.status.publish()

    def _progress(self) -> str:
        tour = self.journal.tour
        poses = f'{tour.poses_begun} of {sum(tour.poses.values())}' if tour else 'none'
        done = self.journal.outcomes.total()
        return f'{poses} {self.phase} poses begun, {done} configurations done'

    # Services

    def _on_collect(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        if self._q is None:
            response.message = 'no joint_states yet: is the robot running?'
            return response
        if self.state in ('complete', 'failed'):
            response.message = f'the collection is {self.state}: {self._why or "start anew"}'
            return response
        bridge, recorder = self._poses.bridge, self._poses.recorder
        if bridge is not None and bridge.halted:
            halted = bridge.halted
            response.message = f'the arm is halted: {halted}; /remaster/clear_halt, then collect'
            return response
        if recorder is not None and recorder.exit_status == 'complete':
            response.message = "the recorder's session is complete; give it a new folder"
            return response
        if recorder is not None and recorder.changed_run == '':
            response.message = 'the recorder was started just now; try again in a second'
            return response
        if self.state != 'running' and recorder is not None and recorder.changed_run:
            # A person has looked: how things are from now on is measured first.
            self.journal.ask_round()
        if self.state != 'running' and self._joint_states is None:
            # The arm may have been stopped, or moved by hand, since it last settled.
            self._joint_states = self._listen_to_the_arm()
        with self._lock:
            self._left = ''
            if self.state != 'running':
                self._run = LivingRun()
            self._set_state('running')
        response.success = True
        response.message = 'collecting'
        return response

    def _on_pause(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            # One that would go on by itself is as good as running.
            left, self._left = self._left, ''
            if left or self.state == 'running':
                self._set_state('paused')
            response.success = self.state == 'paused'
        response.message = 'paused' if response.success else f'not running, but {self.state}'
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            self._left = ''
            # The command first: nothing that fails behind it may keep the arm moving.
            self._poses.stop()
            self._set_state('stopped')
        response.success, response.message = True, 'stopped'
        return response

    def _set_state(self, state: str, why: str = '', only_from: str = '') -> bool:
        """Say a new state; `_step` writes it down. Returns whether the old one was `only_from`."""
        with self._lock:
            if only_from and self.state != only_from:
                return False
            self.state, self._why = state, why
            if state != 'running' and self._run is not None:
                self._run.end()
                self._run = None
            self.status.publish()
            return True

    # What comes in

    def _listen_to_the_arm(self) -> Subscription:
        return self.create_subscription(
            JointState, 'joint_states', self._on_joint_state, JOINT_STATES
        )

    def _on_joint_state(self, message: JointState) -> None:
        """Learn where the arm is before the first pose; after that /remaster/settled says it."""
        self._on_settled(message)
        if self._q is not None and self._joint_states is not None:
            self.destroy_subscription(self._joint_states)
            self._joint_states = None

    def _on_settled(self, message: JointState) -> None:
        try:
            self._q = self._order.positions(message)
        except InputError as error:
            self._why = str(error)

    def _on_registration(self, message: TransformStamped) -> None:
        self.T_R_N[message.child_frame_id] = transform_array(message)

    def _on_record(self, record: EventRecord) -> None:
        self._preflight.take(record.body)
        self._poses.take(record)
        match record.body:
            case ArmHalted(reason=why) | BridgeState(halted=why) if why:
                # It goes on when somebody has looked at the arm and calls /remaster/collect.
                self._set_state('paused', why, only_from='running')
            case SetupChanged(stops=True, text=why):
                self._set_state('paused', why, only_from='running')
            case ConfigurationEnded() as end:
                self._on_end(end.stamp, end.solution, end.result, end.registered)
            case SolutionFailed() as end:
                self._on_end(end.stamp, end.solution, 'failed', False)
            case RecorderState() as recorder:
                self._on_recorder(recorder)

    def _on_end(self, stamp: str, number: int, result: str, registered: bool) -> None:
        """Take what became of a solution of an announcement."""
        ids = self._poses.ids(stamp)
        if ids is None or self.journal.stop is None or number >= len(ids):
            return
        if stamp != self._poses.stamp and result not in ('recorded', 'partial'):
            # It was announced again meanwhile, and will be visited again.
            return
        if ids[number] in self.journal.stop.ids:
            self._registered = registered
            self.journal.outcome(ids[number], result)
            self._step()

    def _on_recorder(self, recorder: RecorderState) -> None:
        run, stop = self._run, self.journal.stop
        if run is not None and recorder.changed_run == run.token:
            # Found while this planner was not there; collect begins another run.
            self._set_state('paused', recorder.changed, only_from='running')
        decided = recorder.decided
        if stop is None or decided is None or self.state in ('complete', 'failed'):
            return
        if recorder.plan == self.journal.id and decided.pose == stop.pose:
            # A configuration may have been recorded while this planner was not there.
            for solution in decided.solutions:
                if solution in stop.ids:
                    self.journal.outcome(solution, 'recorded')
                    self._poses.stamp = ''

    # The tour

    def _step(self) -> None:
        """Publish the next pose once every solution of the last one has its outcome."""
        run = self._run
        if run is not None:
            run.stay_alive()
        if self._left:
            self._take_up_run()
        self._write_state()
        if self.journal.trouble and not self._is_written():
            return
        if self.state != 'running' or self._q is None or not self._all_alive():
            return
        if not self._is_cleared():
            return
        try:
            self._check_session()
            stop = self.journal.stop
            if stop is not None and stop.ids:
                if self._poses.is_lost():
                    self._announce_rest(stop, self._q)
                return
            stop = self._next_stop(self._q)
        except RemasterError as error:
            self._set_state('failed', str(error), only_from='running')
            self.get_logger().error(str(error))
            return
        if stop is not None:
            self._poses.close()
            self.journal.open_stop(stop)
            if stop.ids and not self.journal.trouble:
                self._publish(stop)

    def _announce_rest(self, stop: PoseVisit, q: FloatArray) -> None:
        """Announce what is left of a stop, by ways that begin where the arm stands now."""
        tour = self.journal.tour
        assert tour is not None
        what = (tour, stop.split, stop.pose, stop.ids)
        found = self._planning.ask(what, q, lambda: tour.reroute(stop, q))
        if found is not None:
            self.journal.reroute(found[0])
            if found[0].ids and not self.journal.trouble:
                self._publish(found[0])

    def _propose(self, q: FloatArray) -> tuple[PoseVisit | None] | None:
        """Return the next stop in a tuple, None in it at the end; None while it is planned."""
        tour = self.journal.tour
        assert tour is not None
        self._why = ''
        standing = self._tours.model.trouble(q)
        if standing:
            # The bridge halts such an arm and offers a way out; after it the arm is elsewhere.
            self._why = f'the arm stands too near to something: {standing}'
            if self._joint_states is None:
                self._joint_states = self._listen_to_the_arm()
            return None
        found = self._planning.ask((tour, tour.visited), q, lambda: tour.propose(q))
        if found is None or found[0] is None:
            return found
        return (tour.take(found[0]),)

    def _write_state(self) -> None:
        """Write down what was said; a stop or pause came in a thread that must not wait for it."""
        with self._lock:
            state, run = self.state, '' if self._run is None else self._run.token
        self.journal.say_state(state, run)

    def _is_written(self) -> bool:
        """Whether the disk takes what it did not take before; looked at once a second."""
        now = time.monotonic()
        if now - self._tried_wall < RETRY_WALL_S:
            return False
        self._tried_wall = now
        self.journal.write_out()
        self.status.publish()
        return not self.journal.trouble

    def _check_session(self) -> None:
        """Refuse to add another plan's poses to a session."""
        recorder = self._poses.recorder
        if recorder is None or recorder.plan in ('', self.journal.id):
            return
        if recorder.observations:
            raise InputError(
                f'the session {recorder.session} holds observations of another plan than '
                f'{self.journal.path}; give the planner the same session folder as the recorder, '
                'or begin a new session'
            )

    def _all_alive(self) -> bool:
        """Whether clock, bridge and recorder are there for the next pose."""
        if self.clock_trouble:
            self._why = self.clock_trouble
            return False
        if not self.status.alone(time.monotonic()):
            self._why = 'listening whether there is another pose_planner'
            return False
        matched = self._poses.matched()
        self._why = '' if matched else 'waiting for robot_bridge and recorder'
        return matched

    def _is_cleared(self) -> bool:
        """Whether the preflight has been passed, once, before the first motion."""
        if not self._cleared:
            # No pose was begun before a preflight was passed.
            seen_before = self._resumed or bool(self.T_R_N)
            findings = self._preflight.findings(seen_before=seen_before)
            self._cleared = not findings
            self._why = f'preflight: {"; ".join(findings)}' if findings else ''
        return self._cleared

    def _next_stop(self, q: FloatArray) -> PoseVisit | None:
        if self.phase == REGISTRATION:
            return self._next_registration(q)
        if self.journal.tour is None or REGISTRATION in self.journal.tour.plans:
            T_R_N = dict(self.T_R_N)
            planned = self._planning.ask('plan', q, lambda: self._tours.collection(T_R_N))
            if planned is None:
                return None
            self.journal.begin(planned[0])
        proposed = self._propose(q)
        if proposed == (None,):
            self._set_state('complete', only_from='running')
        return None if proposed is None else proposed[0]

    def _next_registration(self, q: FloatArray) -> PoseVisit | None:
        """Visit poses until the recorder has registered every sensor."""
        missing = [name for name in self._preflight.required() if name not in self.T_R_N]
        if not missing or (self.T_R_N and self._preflight.any_sensor):
            self.phase, self._why = 'collection', ''
            return self._next_stop(q)
        if self._registered:
            # The recorder said so; its transforms are on their way.
            return None
        if self.journal.tour is None:
            planned = self._planning.ask('register', q, self._tours.registration)
            if planned is None:
                return None
            self.journal.begin(planned[0])
        proposed = self._propose(q)
        if proposed == (None,):
            assert self.journal.tour is not None
            assert self._poses.recorder is not None
            raise InsufficientDataError(
                f'no registration of {", ".join(missing)} after {self.journal.tour.visited} poses '
                f'({self._poses.recorder.registration}); the recorder counts why '
                'readings were rejected'
            )
        return None if proposed is None else proposed[0]

    def _publish(self, stop: PoseVisit) -> None:
        tour = self.journal.tour
        if tour is not None and self.phase != REGISTRATION and not self._described:
            self._described = True
            self.status.event(TourPlanned(tour.describe()))
        with self._lock:
            # Paused or stopped while the pose was chosen and written: collect announces it.
            if self.state == 'running':
                last = (
                    tour is not None
                    and stop.split == REFERENCE
                    and stop.index == tour.references - 1
                )
                self._poses.announce(stop, self.journal.id, self.status, last)

    def _summary(self) -> Summary:
        tour, outcomes, run = self.journal.tour, dict(self.journal.outcomes), self._run
        full = (
            f'waiting for room on the disk: {self.journal.trouble}' if self.journal.trouble else ''
        )
        dropped = tour.dropped if tour and self.phase != REGISTRATION else {}
        collecting = tour is not None and self.phase != REGISTRATION
        solutions = Counter(tour.dropped_solutions if tour and collecting else {})
        solutions['no free path'] = outcomes.get(NO_FREE_PATH, 0)
        values = {
            'phase': self.phase,
            'robot': 'silent' if self._q is None else 'heard',
            'poses_done': tour.poses_begun if tour else 0,
            'poses': sum(tour.poses.values()) if tour else 0,
            'configurations_done': sum(outcomes.values()),
            'configurations': sum(tour.configurations.values()) if tour else 0,
            'references': tour.references if tour else 0,
            'references_done': self.journal.references.total(),
            'plan': self.journal.id,
            # Whether it may still go on by itself.
            'resuming': 'yes' if self._left else 'no',
            **{f'outcome_{name}': count for name, count in sorted(outcomes.items())},
            **{f'dropped_{name}': count for name, count in sorted(dropped.items())},
            **{f'dropped_solutions_{name}': n for name, n in sorted(solutions.items())},
        }
        why = full or self._why
        level = 'error' if self.state == 'failed' else 'warn' if why else 'ok'
        state = PlannerState(
            state='held' if full and self.state == 'running' else self.state,
            run='' if run is None else run.token,
        )
        return Summary(level, why or self.state, values, state)

    def close(self) -> None:
        """Tell the bridge to stop: nobody plans any more."""
        self._set_state('stopped', only_from='running')
        self._write_state()
        self.journal.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # One for the tour, one for pause and stop, one for the status.
    return run(PosePlanner, args, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
