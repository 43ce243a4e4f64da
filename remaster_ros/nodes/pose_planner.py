# SPDX-License-Identifier: Apache-2.0
"""Node that plans poses in front of the sensors and publishes them one by one.

``/remaster/collect`` starts or resumes; ``/remaster/pause`` and ``/remaster/stop`` hold the arm.
``/remaster/verify`` and ``/remaster/check`` begin an inspection of the arm in place of a
collection. Until every sensor is registered, poses serve the three-point registration.

Decisions are made elsewhere: on the run in `collection.collection_run`, on the next visit in
`collection.tour_progress`, on repeated announcements in `collection.announcements`.

The plan and the visit under way are in the session folder before the arm moves; outcomes of
configurations are in the recorder's journal alone, and come in the recorder's state. A killed
planner resumes by itself if its run still lives: recorder and bridge hold its token (see
`LivingRun`).

Pause and stop have a thread of their own: neither planning nor the disk delays them. Their state
is published first and written to the journal afterwards.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from remaster_ros.collection import events
from remaster_ros.collection.announcements import Announcements, Lack
from remaster_ros.collection.collection_run import CollectionRun
from remaster_ros.collection.events import OptimizerState
from remaster_ros.collection.message_fields import JointOrder, wanted_of
from remaster_ros.collection.peers import PeerModels, Peers
from remaster_ros.collection.plan_confirmation import service_name
from remaster_ros.collection.tour_progress import TourProgress
from remaster_ros.errors import InputError, RemasterError
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.preflight import preflight
from remaster_ros.nodes.background import Background, PlanningThread
from remaster_ros.nodes.measure_services import MeasureCalls
from remaster_ros.nodes.messages import (
    transform_array,
)
from remaster_ros.nodes.parameters import declare
from remaster_ros.nodes.planner.added_measurements import AddedMeasurements
from remaster_ros.nodes.planner.inspections import KINDS, Inspection, Inspections
from remaster_ros.nodes.planner.living_run import LivingRun, new_token, silence_s
from remaster_ros.nodes.planner.parameters import Parameters
from remaster_ros.nodes.planner.plan_preview import PlanPreview
from remaster_ros.nodes.planner.pose_publisher import PosePublisher
from remaster_ros.nodes.planner.progress_lines import ProgressLines
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import (
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    NodeStatus,
    Summary,
    listen,
)
from remaster_ros.planning.collection_plan import session_time_s
from remaster_ros.planning.tour_order import REGISTRATION, PoseVisit, Tour
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.plan_journal import PlanJournal
from remaster_ros.types import FloatArray

RETRY_WALL_S = 1.0
"""Interval at which a failed write is repeated, s of wall time."""


class PosePlanner(RemasterNode):
    """Node that plans poses in front of the sensors and publishes them one by one."""

    def __init__(self) -> None:
        super().__init__('pose_planner')
        self.p = declare(self, Parameters)
        self.cell = read_cell(self.p.cell)
        self.chain = self.cell.chain()
        self._order = JointOrder(self.chain.joint_names)
        self._q: FloatArray | None = None
        causes = self.p.causes(self.chain.joint_names)
        self._tours = self.p.tour_planner(self.cell, self.chain, causes)
        settings = self.p.plan_settings(self.cell, causes)
        folder = Path(self.p.session)
        self.journal = PlanJournal(folder, settings, self.chain, self._tours.model)
        planning = PlanningThread(Background(self), JointUnits.of(self.chain))
        self.progress = TourProgress(self.journal, self._tours, planning)
        # Guards the run, and publications that are allowed only while it is running.
        self._lock = threading.RLock()
        self.run = CollectionRun(self.p.resume_within_s)
        self._additions = AddedMeasurements(self.p.discovery, folder, self.journal, self._tours)
        # `_announce` asks it before each visit.
        self._preview = PlanPreview(
            self.cell, self._tours, self.journal, self.progress, folder, Background(self)
        )
        if self.p.moving_s and self.progress.phase == REGISTRATION:
            # While nothing is collected yet, and while the sensors are registered.
            Background(self).submit(self._tours.prepare, lambda result: None)
        self._inspections = Inspections(self, folder, self.p, self.cell, self._tours)
        self._living: LivingRun | None = None
        self._tried_wall = 0.0
        self._resume()
        self._poses = PosePublisher(self, self.chain)
        self._peers = Peers(self.cell.sensors)
        self._announcements = Announcements(self._peers)
        self._joint_states: Subscription | None = self._listen_to_the_arm()
        self.create_subscription(JointState, 'remaster/settled', self._on_settled, RELIABLE)
        self.create_subscription(
            TransformStamped, 'remaster/registration', self._on_registration, LATCHED
        )
        self.create_service(Trigger, 'remaster/confirm', self._on_confirm)
        self._offered: set[str] = set()
        at_once = MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, 'remaster/collect', self._on_collect)
        for kind in KINDS:
            self.create_service(Trigger, f'remaster/{kind}', partial(self._on_inspection, kind))
        self.create_service(Trigger, 'remaster/pause', self._on_pause, callback_group=at_once)
        self.create_service(Trigger, 'remaster/stop', self._on_stop, callback_group=at_once)
        model = self.cell.model()
        self.status = NodeStatus(self, self._summary, Path(self.cell.robot.urdf).stem, model)
        self._models = PeerModels(self.get_fully_qualified_name(), model)
        self._cleared = self._described = False
        self._session_s = 0.0
        self._measure = MeasureCalls(self, self.cell)
        listen(self, self._on_record)
        ProgressLines(self, self.status.steady, self.progress.counts, lambda: self.run.state)
        self.create_timer(0.05, self._step, clock=self.status.steady)

    def _resume(self) -> None:
        """Restore the state that a planner before this one has left in the journal.

        Nothing if there is no plan; else with a warning. A run is resumed later, by `_resume_run`,
        and never if plans have to be confirmed.
        """
        journal = self.journal
        if journal.tour is None:
            return
        if journal.lost:
            self.get_logger().warning(journal.lost)
        # A confirmation does not outlive the planner.
        token = '' if self._preview.required else journal.run
        self.run.resume(journal.state, token, self.progress.describe())
        self.get_logger().warning(f'{journal.path}: going on; {self.progress.describe()}')

    def _resume_run(self) -> None:
        """Resume the run of a killed planner if it is certainly still under way.

        Called again until that is known, see `CollectionRun.take_up`. If it is not under way,
        the planner waits for /remaster/collect, and a warning says why.
        """
        token, peers = self.run.left, self._peers
        silent_s, progress = silence_s(token), self.progress.describe()
        with self._lock:
            # A pause or stop may have been requested meanwhile.
            decided = self.run.left == token and self.run.take_up(
                silent_s, peers.bridge, peers.recorder, progress
            )
            if decided:
                self._follow_run()
        if decided and self.run.state != 'running':
            self.get_logger().warning(self.run.why)

    def _follow_run(self) -> None:
        """Publish the run's state; begin or end its liveness file if the run's token has changed.

        To be called with the lock held.
        """
        # First, since a pause or stop must not wait for the disk.
        self.status.publish()
        living, token = self._living, self.run.token
        if living is not None and living.token != token:
            living.end()
            living = None
        if living is None and token:
            living = LivingRun(token)
        self._living = living

    def _end(self, state: str, why: str = '') -> None:
        """End the run under way with `state`, and publish that; `_step` writes it to the journal.

        Nothing if no run is running. ``state``: such as paused or failed; ``why``: shown to
        people.
        """
        with self._lock:
            if self.run.end(state, why, only_from='running'):
                self._follow_run()

    def _on_collect(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve a request to begin or resume the collection; see `_collect`."""
        return self._collect(response)

    def _on_inspection(
        self, kind: Inspection, request: Trigger.Request, response: Trigger.Response
    ) -> Any:
        """Begin or resume an inspection; if it is complete, answer with the verdict.

        Refused, with the reason in the response, while a run is running, in a session that holds
        something else, and as `Inspections.refusal` and `Inspections.tour` say.
        """
        tour, recorder = self.journal.tour, self._peers.recorder
        same_kind = tour is not None and tour.inspection == kind
        if same_kind and self.run.state == 'complete':
            response.success, response.message = self._inspections.answer()
        elif self.run.state == 'running':
            response.message = 'something else is under way' if not same_kind else 'under way'
        elif (tour is not None and not same_kind) or (
            tour is None and recorder is not None and recorder.observations
        ):
            response.message = (
                f'{self.p.session}: holds something else; start pose_planner and recorder with a '
                'new session folder'
            )
        else:
            response.message = self._inspections.refusal(kind, self._peers.bridge)
            try:
                plan, words = self._inspections.tour(kind) if not response.message else (None, '')
            except RemasterError as error:
                response.message = str(error)
            if not response.message:
                self._collect(response, None if same_kind else plan)
                response.message = words if response.success else response.message
        return response

    def _collect(
        self, response: Trigger.Response, inspection: Callable[[], Tour] | None = None
    ) -> Any:
        """Begin or resume a run, or refuse to; return the response, with success and a text.

        ``inspection``: plans an inspection instead of a collection; None goes on with what is
        planned. After a complete collection, measurements are added that separate causes, if any
        are open.
        """
        bridge, recorder = self._peers.bridge, self._peers.recorder
        further, plan = self._additions.next_plan(
            self.run.state, under_way=self.progress.measures_additions
        )
        has_joints = self._q is not None
        refusal = self.run.refusal(bridge, recorder, has_joints=has_joints, further=further)
        # An inspection is not planned yet and cannot be shown; `_announce` asks for confirmation.
        response.message = refusal or (
            self._preview.collect_refusal() if inspection is None else ''
        )
        if response.message:
            return response
        self.progress.inspection = inspection or self.progress.inspection
        if plan is not None:
            # The preflight is repeated.
            self.progress.additions, self._described, self._cleared = plan, False, False
        if self.run.state != 'running':
            if recorder is not None and recorder.changed_run:
                # A person has changed the setup: the references are measured first.
                self.journal.request_reference_round()
            # The arm may have been stopped, or moved by hand, since it last settled.
            self._listen_again()
        with self._lock:
            self.run.collect(new_token())
            self._follow_run()
        response.success, response.message = True, 'collecting'
        return response

    def _on_confirm(
        self, request: Trigger.Request, response: Trigger.Response, plan: str = ''
    ) -> Any:
        """Serve a request to confirm the plan on the page; see `PlanConfirmation.confirm`.

        ``plan``: the fingerprint to confirm, '' for that of the page.
        """
        response.success, response.message = self._preview.confirm(plan)
        if response.success and self.run.state != 'running':
            self.run.why = response.message
            self.status.publish()
        return response

    def _offer(self, plan: str) -> None:
        """Create a service that confirms this plan only; it remains, to refuse later calls.

        ``plan``: fingerprint; nothing for '' or if the service exists.
        """
        if plan and plan not in self._offered:
            self._offered.add(plan)
            path = f'remaster/confirm/{service_name(plan)}'
            self.create_service(Trigger, path, partial(self._on_confirm, plan=plan))

    def _on_pause(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve a request to pause the run, also one that waits to be resumed.

        It succeeds if the run is paused then or was before; else the response has the state.
        """
        with self._lock:
            response.success = self.run.pause()
            self._follow_run()
        response.message = 'paused' if response.success else f'not running, but {self.run.state}'
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Serve a request to stop: stop the arm, end the run, and retract the announced pose.

        It always succeeds.
        """
        with self._lock:
            # The command first: no later failure may keep the arm moving.
            self._poses.stop()
            self._announcements.retract()
            self.run.stop()
            self._follow_run()
        response.success, response.message = True, 'stopped'
        return response

    def _listen_to_the_arm(self) -> Subscription:
        """Subscribe to joint_states, and return the subscription."""
        return self.create_subscription(
            JointState, 'joint_states', self._on_joint_state, JOINT_STATES
        )

    def _listen_again(self) -> None:
        """Subscribe to the joint states until the next one of the arm arrives."""
        self._joint_states = self._joint_states or self._listen_to_the_arm()

    def _on_joint_state(self, message: JointState) -> None:
        """Set the arm's configuration before the first pose, then end the subscription.

        Messages of other joints are ignored. Later /remaster/settled sets the configuration.
        """
        if not self._order.concerns(message):
            return
        self._on_settled(message)
        if self._q is not None and self._joint_states is not None:
            self.destroy_subscription(self._joint_states)
            self._joint_states = None

    def _on_settled(self, message: JointState) -> None:
        """Set the arm's configuration from the bridge's report that the arm has settled, rad or m.

        If the bridge corrects, these are the joint positions wanted, before the correction. An
        invalid message, also one with a position that is no finite number, changes nothing but
        `run.why`, which says what is wrong.
        """
        try:
            # The nominal joint angles of the tool's pose, if the bridge corrects.
            wanted = wanted_of(message, self._order.names)
            q = self._order.positions(message) if wanted is None else wanted
        except InputError as error:
            self.run.why = str(error)
            return
        if np.all(np.isfinite(q)):
            self._q = q
        else:
            self.run.why = 'a reported joint position is no finite number'

    def _on_registration(self, message: TransformStamped) -> None:
        """Keep a sensor's registration, T_R_N (4, 4). Raises InputError as `transform_array`."""
        self.progress.T_R_N[message.child_frame_id] = transform_array(message)

    def _on_record(self, record: events.EventRecord) -> None:
        """Update the state by an event or state of another node.

        The run ends as paused if the arm is halted, if the bridge asks in this run for
        /remaster/collect, or if a change of the setup has to be checked by a person. If the
        optimizer reports that the precision of this plan is enough, no more poses to fit are
        announced.
        """
        now = time.monotonic()
        self._peers.take(record, now)
        self._models.take(record, now)
        match record.body:
            case events.ArmHalted(reason=why) | events.BridgeState(halted=why) if why:
                # A person looks at the arm and calls /remaster/collect.
                self._end('paused', why)
            case events.BridgeState(asks_for_collect=why, run=run) if why:
                # A late message may be of an earlier run.
                if run == self.run.token:
                    self._end('paused', why)
            case events.SetupChanged(stops=True, text=why):
                self._end('paused', why)
            case OptimizerState(enough=True, plan=plan) if plan and plan == self.journal.id:
                # The visit under way is finished and validation poses are measured, as usual.
                self.progress.enough = True
            case events.RecorderState() as recorder:
                self._on_recorder(recorder)

    def _on_recorder(self, recorder: events.RecorderState) -> None:
        """Update the progress by the recorder's state; evaluate a finished inspection.

        A change of the setup in this run ends the run as paused; new outcomes lead to `_step`.
        """
        if self.run.token and recorder.changed_run == self.run.token:
            # The change was found while no planner was running; collect begins another run.
            self._end('paused', recorder.changed)
        if self.progress.follow(recorder):
            self._step()
        tour, closed = self.journal.tour, recorder.exit_status == 'complete'
        if self.run.state == 'complete' and tour is not None and recorder.plan == self.journal.id:
            for kind in KINDS:
                if closed and tour.inspection == kind:
                    self._inspections.evaluate(kind)

    def _step(self) -> None:
        """Announce the next visit once every solution of the last one has its outcome.

        Timer callback, every 50 ms, and after a recorder's state that decides a visit. It also
        keeps the run alive, writes the state, resumes a run, draws the preview while none runs,
        and repeats an announcement that a node has missed. An error ends the run as failed.
        """
        living = self._living
        if living is not None:
            living.stay_alive()
        if self.run.left:
            self._resume_run()
        self._write_state()
        if self.journal.trouble and not self._is_written():
            return
        q, recorder, now = self._q, self._peers.recorder, time.monotonic()
        if self.run.state in ('idle', 'paused', 'stopped') and q is not None:
            self.run.why = self._preview.draw(q, self._peers) or self.run.why
            self._offer(self._preview.shown)
        if self.run.state != 'running' or q is None:
            return
        try:
            self.run.why = self._hindrance(now)
            if self.run.why or recorder is None:
                return
            self.progress.check_session(recorder, self.journal.path)
            if self.progress.open_pose is None:
                required = self._peers.required()
                visit = self.progress.next(q, required, recorder.registration)
                if visit is not None:
                    self._announcements.retract()
            elif (lack := self._announcements.lack()) is Lack.ANEW:
                visit = self.progress.rest(q)
            else:
                if lack is Lack.LATE:
                    self._repeat()
                return
        except RemasterError as error:
            self._end('failed', str(error))
            self.get_logger().error(str(error))
            return
        if self.progress.is_complete:
            self._end('complete', '' if self.progress.planned_any else self._additions.describe())
        if self.progress.standing:
            self.run.why = self.progress.standing
            self._listen_again()
        if visit is not None and not self.journal.trouble:
            self._announce(visit)

    def _hindrance(self, now: float) -> str:
        """Return why no pose can be announced now; '' if one can. ``now``: `time.monotonic`, s.

        In this order: no time, another planner, another arm's model in a peer, peers missing, and,
        once before the first motion, the findings of the preflight.
        """
        if self.clock_trouble:
            return self.clock_trouble
        if not self.status.alone(now):
            return 'listening whether there is another pose_planner'
        if trouble := self._models.trouble(now):
            return trouble
        if not self._announcements.matched(self._poses.subscribers, now):
            return 'waiting for robot_bridge and recorder'
        if not self._cleared:
            # Once, before the first motion. A resumed tour has passed a preflight before.
            seen_before = self.progress.resumed or bool(self.progress.T_R_N)
            facts = self._peers.facts(now, seen_before=seen_before)
            self._measure.call([s.name for s in facts.sensors if s.ready and s.read_age_s], now)
            findings = preflight(facts)
            self._cleared = not findings
            if findings:
                return f'preflight: {"; ".join(findings)}'
        return ''

    def _announce(self, visit: PoseVisit) -> None:
        """Publish a visit if its plan is confirmed, and the run is under way.

        If it is not confirmed, the run ends as paused, and the page is drawn again. Before the
        first visit of a collection the plan is described in an event.
        """
        tour = self.journal.tour
        if not self._preview.allows(tour):
            self._preview.withdraw()
            self._end('paused', self._preview.refusal())
            return
        if tour is not None and self.progress.phase != REGISTRATION and not self._described:
            self._described = True
            planned = self._additions.describe_tour(tour)
            if self._q is not None and not tour.begin_at and not tour.inspection:
                self._session_s = session_time_s(self._tours, tour, self._q)
                minutes = f'{self._session_s / 60.0:.1f} min'
                planned += f'; about {minutes} of robot time for the whole session'
            if self.p.moving_s and not tour.inspection:
                planned += (
                    '; measured while the arm moves: when complete, remaster import --moving '
                    f'{self.p.session}/bag --cell {self.p.cell} --proof {self.p.session}, then '
                    'remaster fit'
                )
            self.status.event(events.TourPlanned(planned))
        with self._lock:
            # If paused or stopped while the visit was planned, collect announces it.
            if self.run.state == 'running':
                last = self.progress.is_last_reference(visit)
                stamp = self._poses.announce(visit, self.journal.id, self.status, last=last)
                self._announcements.announced(stamp, time.monotonic())

    def _repeat(self) -> None:
        """Repeat the announcement of the visit under way, for a node that missed it.

        Nothing if no run is running.
        """
        with self._lock:
            if self.run.state == 'running':
                self._poses.repeat(self.status)
                self._announcements.announced(self._announcements.stamp, time.monotonic())

    def _write_state(self) -> None:
        """Write the state to the journal, which pause and stop leave to this thread."""
        with self._lock:
            state, token = self.run.state, self.run.token
        self.journal.record_state(state, token)

    def _is_written(self) -> bool:
        """Retry failed writes, at most once in `RETRY_WALL_S`; return whether all is written.

        False between two tries.
        """
        now = time.monotonic()
        if now - self._tried_wall < RETRY_WALL_S:
            return False
        self._tried_wall = now
        self.journal.write_out()
        self.status.publish()
        return not self.journal.trouble

    def _summary(self) -> Summary:
        """Return the state of the planner for the status, with what hinders it as the message.

        The level is error after a failed run, warn with a hindrance, else ok.
        """
        run, trouble = self.run, self.journal.trouble
        full = f'waiting for room on the disk: {trouble}' if trouble else ''
        values = {
            'robot': 'silent' if self._q is None else 'heard',
            'plan': self.journal.id,
            'references_done': self.progress.decided.references,
            # Whether the planner may still resume by itself.
            'resuming': 'yes' if run.left else 'no',
            **self._preview.values(),
            **self.progress.counts(),
            'verdict': self._inspections.verdict,
            # Of the whole session; '' before the collection is planned.
            'robot_time_s': f'{self._session_s:.0f}' if self._session_s else '',
            'dropped_solutions_no free path': self.progress.decided.outcomes.get(
                events.NO_FREE_PATH, 0
            ),
        }
        why = full or run.why or self._inspections.trouble
        level = 'error' if run.state == 'failed' else 'warn' if why else 'ok'
        shown = 'held' if full and run.state == 'running' else run.state
        return Summary(level, why or run.state, values, self.progress.state(shown, run.token))

    def close(self) -> None:
        """Publish that the planner has stopped, at which the bridge stops the arm.

        A run under way ends as stopped, which is written to the journal; the journal is released.
        """
        self._end('stopped')
        self._write_state()
        self._inspections.close()
        self.journal.close()


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    # Threads for the tour, for pause and stop, and for the status.
    return run(PosePlanner, args, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
