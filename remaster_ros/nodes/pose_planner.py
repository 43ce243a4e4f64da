# SPDX-License-Identifier: Apache-2.0
"""Plan poses in front of the sensors; publish them one by one, each with all its joint solutions.

``/remaster/collect`` starts or resumes; ``/remaster/pause`` and ``/remaster/stop`` hold the arm.
``/remaster/verify`` and ``/remaster/check`` begin visits by which the arm is judged, in place of a
collection.
Without a registration of every sensor the first poses serve the three-point registration.

What the planner does and in which run is decided in `collection.collection_run`, which pose is
next in `collection.tour_progress`, whether it is announced again in `collection.announcements`.

The plan and the pose under way are in the session folder before the arm moves; what became of
each configuration is in the recorder's journal there alone, which the recorder's state tells of. A
planner that was killed goes on by itself where it was, if the run still lives: recorder and bridge
hold its token (see `LivingRun`).

Pause and stop have a thread of their own: neither planning nor the disk keeps them waiting. Their
state goes out first; what the journal must remember is written afterwards.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
import time
import uuid
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from remaster_ros.collection import events
from remaster_ros.collection.announcements import PEERS, Announcements, Lack
from remaster_ros.collection.collection_run import CollectionRun
from remaster_ros.collection.events import OptimizerState, PoseAnnounced
from remaster_ros.collection.message_fields import CORRECTED, JointOrder, stamp_key, wanted_of
from remaster_ros.collection.pace import Pace, progress_text
from remaster_ros.collection.peers import PeerModels, Peers, RequiredSensors
from remaster_ros.collection.plan_confirmation import PlanConfirmation, fingerprint, service_name
from remaster_ros.collection.tour_progress import PlanMemory, TourProgress
from remaster_ros.errors import InputError, RemasterError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.limits import SLOWEST_M_S
from remaster_ros.motion.preflight import preflight
from remaster_ros.nodes.background import Background, PlanningThread
from remaster_ros.nodes.judging import KINDS, Judging, JudgingParameters, Kind
from remaster_ros.nodes.messages import (
    duration_of,
    transform_array,
    waypoints_message,
    write_place,
)
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.runtime_files import runtime_folder
from remaster_ros.nodes.status import (
    JOINT_STATES,
    LATCHED,
    LEASED,
    RELIABLE,
    NodeStatus,
    Summary,
    listen,
)
from remaster_ros.planning.collection_plan import look_ahead, session_time_s
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import MOST_FURTHER
from remaster_ros.planning.tour_order import REGISTRATION, PoseVisit, Tour
from remaster_ros.planning.tour_planner import REGISTRATION_CANDIDATES, TourPlanner
from remaster_ros.planning.travel_time import SPEED_SHARE, TravelTime
from remaster_ros.session.files import read_limited
from remaster_ros.session.plan_journal import PlanJournal, plan_page_path
from remaster_ros.session.reader import OBSERVATIONS_LIMIT, ROWS, read_session
from remaster_ros.session.workcell import Workcell, read_cell
from remaster_ros.types import FloatArray

# What is measured behind a complete collection: what separates causes from their look-alikes.
#
# /remaster/discover looks for causes; where it leaves look-alikes, the next /remaster/collect
# measures the configurations that tell them apart, at most `MOST_FURTHER` of them in a session.


DISCOVER = '/remaster/discover'


class FurtherMeasuring:
    """Decides what is measured further, by the optimizer's discovery; nothing for folder ''."""

    def __init__(
        self, discovery: str, session: Path, journal: PlanJournal, tours: TourPlanner
    ) -> None:
        self._discovery, self._session = discovery, session
        self._journal, self._tours = journal, tours

    def ask(self, state: str, *, under_way: bool) -> tuple[str | None, partial[Tour] | None]:
        """Return why nothing is measured further, '' where it is, and what plans it if it is new.

        With the planner's ``state``: behind a collection that is not complete nothing is measured,
        None. ``under_way``: whether something is being measured further already.
        """
        if state != 'complete':
            return '' if under_way else None, None
        if self._journal.tour is not None and self._journal.tour.judges:
            return 'it was no calibration; name a new session folder', None
        # Imported when it is needed, as it takes a while.
        from remaster_ros.reports.discovery_json import read_causes
        from remaster_ros.reports.fit_json import DISCOVERY_FILE

        path = Path(self._discovery) / DISCOVERY_FILE
        if not self._discovery or not path.exists():
            return f'{DISCOVER} looks for causes, and collect measures what they leave open', None
        try:
            causes = read_causes(path, observations_sha256=self._digest())
        except InputError as error:
            return str(error), None
        left = MOST_FURTHER - self._measured()
        if left <= 0:
            return f'{MOST_FURTHER} configurations were measured to separate causes already', None
        return '', partial(self._plan, causes, left)

    def _digest(self) -> str:
        rows = read_limited(self._session / ROWS, OBSERVATIONS_LIMIT, 'it is part of a session')
        return hashlib.sha256(rows).hexdigest()

    def _measured(self) -> int:
        """Return how many configurations were planned for this so far."""
        return sum(tour.to_fit for tour in self._journal.tours if tour.begin_at)

    def _plan(
        self, causes: tuple[FoundCause, ...], most: int, T_R_N: Mapping[str, FloatArray]
    ) -> Tour:
        before = self._journal.tour
        assert before is not None
        rows = read_session(self._session).measurements
        return self._tours.further(T_R_N, causes, rows, before, most)

    def planned(self, tour: Tour) -> str:
        """Return a tour of the collection with what is expected of it, in a line."""
        designed = self._tours.designed
        expected = '' if designed is None else designed.describe()
        if tour.begin_at:
            expected = self.describe()
        return '; '.join(filter(None, (tour.describe(), expected)))

    def describe(self) -> str:
        """Return what is measured further and what is not, in a line; '' before it is planned."""
        design = self._tours.separated
        if design is None:
            return ''
        words = [
            f'{pair.cause} and {pair.look_alike}: {pair.before:.1f} standard deviations apart, '
            f'{pair.after:.1f} expected'
            for pair in design.pairs
        ]
        words += [f'no poses of this cell separate {sentence}' for sentence in design.otherwise]
        return ('' if design.order else 'nothing to measure: ') + '; '.join(words)


# Parameters of the planner.


@dataclass(frozen=True)
class Parameters(JudgingParameters):
    """Parameters of the planner."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    optimization_candidates: int = parameter(
        60, 'candidate poses that the offsets are fitted on', low=1, high=10000
    )
    validation_candidates: int = parameter(
        60, 'candidate poses that the gain is proved on', low=0, high=10000
    )
    registration_candidates: int = parameter(
        REGISTRATION_CANDIDATES,
        'candidate poses for the three-point registration',
        low=3,
        high=1000,
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
    separate: str = parameter(
        '',
        'discovery.json: configurations that separate its causes from their look-alikes are '
        'added; empty for none',
    )
    discovery: str = parameter(
        'discovery',
        "folder of the optimizer's discovery: after a complete collection remaster/collect "
        'measures further what separates its causes from their look-alikes; empty for nothing',
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
        1.0,
        'distance kept from the joint limits; of a joint that slides 4.36 mm for each degree',
        unit='deg',
        low=0.0,
        high=45.0,
    )
    speed_share: float = parameter(
        SPEED_SHARE,
        'as of robot_bridge: what `poses.design: optimal` and `poses.order: fastest` of a cell '
        'file reckon with; commands nothing',
        low=0.01,
        high=1.0,
    )
    cartesian_speed_limit_m_s: float = parameter(
        0.25,
        'as of robot_bridge, likewise; 0 means no such limit',
        unit='m/s',
        low=SLOWEST_M_S,
        high=10.0,
        off=0.0,
    )

    def tour_planner(
        self, cell: Workcell, chain: SerialChain, causes: Sequence[FoundCause]
    ) -> TourPlanner:
        """Return what plans the tours of a cell with this arm; causes as of `causes`."""
        scene = cell.planning_scene(chain, np.deg2rad(self.limit_margin_deg))
        counts = {
            'optimization': self.optimization_candidates,
            'validation': self.validation_candidates,
            REGISTRATION: self.registration_candidates,
        }
        travel = TravelTime.of(
            scene.model,
            self.speed_share,
            self.cartesian_speed_limit_m_s or np.inf,
            cell.acceleration_limits(chain),
        )
        design = cell.design_settings()
        return TourPlanner(scene, counts, self.seed, self.reference_every, design, travel, causes)

    def causes(self, joint_names: Sequence[str]) -> tuple[FoundCause, ...]:
        """Return the causes that the plan is to separate; errors as of `read_causes`."""
        if not self.separate:
            return ()
        # Imported when it is needed, as it takes a while.
        from remaster_ros.reports.discovery_json import read_causes

        return read_causes(self.separate, joint_names)

    def plan_settings(self, cell: Workcell, causes: Sequence[FoundCause]) -> dict[str, Any]:
        """Return what the plan depends on."""
        design = cell.design_settings()
        speeds = {
            'speed_share': self.speed_share,
            'cartesian_speed_limit_m_s': self.cartesian_speed_limit_m_s,
        }
        return {
            'cell': cell.fingerprint(),
            'optimization_candidates': self.optimization_candidates,
            'validation_candidates': self.validation_candidates,
            'registration_candidates': self.registration_candidates,
            'seed': self.seed,
            'reference_every': self.reference_every,
            'limit_margin_deg': self.limit_margin_deg,
            # Other plans do not depend on them.
            **(speeds if design.optimal or design.fastest else {}),
            **({'separate': repr(causes)} if causes else {}),
        }


# Publish a pose with all its joint solutions to bridge and recorder.


class PosePublisher:
    """Publishes poses, and the stop that takes them back."""

    def __init__(self, node: RemasterNode, chain: SerialChain) -> None:
        self._node, self._chain = node, chain
        self._poses = node.create_publisher(PoseStamped, 'remaster/target_pose', LEASED)
        self._waypoints = node.create_publisher(
            JointTrajectory, 'remaster/joint_waypoints', LEASED
        )
        self._solutions = node.create_publisher(
            JointTrajectory, 'remaster/joint_solutions', LEASED
        )
        # The last announcement: its event, and its messages with their publishers.
        self._event: PoseAnnounced | None = None
        self._messages: list[tuple[Publisher, PoseStamped | JointTrajectory]] = []

    @property
    def subscribers(self) -> int:
        """How many nodes subscribe to the solutions, without those that only look on."""
        found = self._node.get_subscriptions_info_by_topic(self._solutions.topic_name)
        others = sum(info.node_name not in PEERS for info in found)
        return int(self._solutions.get_subscription_count()) - others

    def stop(self) -> None:
        """Take the pose back, on which the bridge stops the arm."""
        self._solutions.publish(JointTrajectory(joint_names=list(self._chain.joint_names)))

    def announce(self, stop: PoseVisit, plan: str, status: NodeStatus, *, last: bool) -> str:
        """Publish a pose with what is left of its solutions; return the announcement's stamp.

        ``plan``: the plan that poses and solutions are numbered by; ``last``: whether it is the
        last reference of a round.
        """
        pose = PoseStamped()
        pose.header.stamp = self._node.get_clock().now().to_msg()
        pose.header.frame_id = self._chain.base_link
        key = stamp_key(pose.header.stamp)
        self._event = PoseAnnounced(
            stamp=key,
            pose=stop.pose,
            split=stop.split,
            ids=stop.ids,
            unreached=stop.unreached,
            plan=plan,
            last=last,
        )
        write_place(stop.T_R_T, pose.pose.position, pose.pose.orientation)
        prefix = CORRECTED.get(stop.correction, '')
        names = [f'{prefix}{name}' for name in self._chain.joint_names]
        message = JointTrajectory(joint_names=names)
        message.header = pose.header
        message.points = [
            JointTrajectoryPoint(positions=q.tolist(), time_from_start=duration_of(i + 1.0))
            for i, q in enumerate(stop.solutions)
        ]
        # The solutions last: with those the bridge begins to move. Without a solution it would
        # take the pose back, which nothing asks for.
        waypoints = waypoints_message(stop, self._chain.joint_names, pose.header)
        self._messages = [
            (self._poses, pose),
            (self._waypoints, waypoints),
            (self._solutions, message),
        ] * bool(stop.ids)
        self.repeat(status)
        return key

    def repeat(self, status: NodeStatus) -> None:
        """Publish the last announcement (again), as it was."""
        assert self._event is not None
        # The event goes first: the recorder must have the pose before the arm gets there.
        status.event(self._event)
        for publisher, message in self._messages:
            publisher.publish(message)


# The token of a collection under way, and the sign of life of the planner that runs it.
#
# A planner that was killed may go on by itself only where it is certain that the same collection
# is still under way: the same boot of this computer, a short time by a clock that cannot be set,
# and recorder and bridge that hold the token in memory. Dates of files prove nothing of that.


ALIVE_S = 1.0
"""How often a planner renews its sign of life, s."""


def boot_id() -> str:
    """Return what this boot of this computer is called by its kernel."""
    return Path('/proc/sys/kernel/random/boot_id').read_text().strip()


def since_boot_s() -> float:
    """Return the time since boot, s; it goes on while the computer is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def new_token() -> str:
    """Return a token for a run that begins now."""
    return uuid.uuid4().hex[:12]


class LivingRun:
    """A run under way in this process; its sign of life is a file outside of every session."""

    def __init__(self, token: str) -> None:
        self.token = token
        self._renewed = float('-inf')
        self.stay_alive()

    def stay_alive(self) -> None:
        """Renew the sign of life, at most once a second; where that fails, no planner goes on."""
        now = since_boot_s()
        if now - self._renewed < ALIVE_S:
            return
        self._renewed = now
        path = _path(self.token)
        with contextlib.suppress(OSError):
            # It need not survive a power cut: another boot is another run.
            new = path.with_suffix('.new')
            new.write_text(f'{boot_id()} {now!r}\n')
            os.replace(new, path)

    def end(self) -> None:
        """End the run: no planner goes on with it."""
        with contextlib.suppress(OSError):
            _path(self.token).unlink()


def silence_s(token: str) -> float | None:
    """Return for how long the planner of a run has given no sign of life, s.

    None where it gave none in this boot of this computer, or the run was ended.
    """
    if not token.isalnum():
        return None
    try:
        boot, _, sign = _path(token).read_text().strip().partition(' ')
        passed_s = since_boot_s() - float(sign)
    except (OSError, ValueError):
        return None
    return passed_s if boot == boot_id() and passed_s >= 0.0 else None


def _path(token: str) -> Path:
    return runtime_folder() / f'run_{token}'


MEASURE_EVERY_WALL_S = 5.0
"""How often a single-shot sensor measures until its marker was seen, wall time."""


class MeasureCalls:
    """Have single-shot sensors show that they see their markers."""

    def __init__(self, node: Node, cell: Workcell) -> None:
        self._clients: dict[str, Client] = {
            name: node.create_client(Trigger, sensor.measure_service)
            for name, sensor in cell.sensors.items()
            if sensor.single_shot and sensor.measure_service
        }
        self._called_wall = dict.fromkeys(self._clients, float('-inf'))

    def call(self, names: Collection[str], now: float) -> None:
        """Call the measure services of these sensors, each now and then; wall time, s."""
        for name, client in self._clients.items():
            due = now - self._called_wall[name] >= MEASURE_EVERY_WALL_S
            if name in names and due and client.service_is_ready():
                self._called_wall[name] = now
                client.call_async(Trigger.Request())


LOOK_S = 1.0
EVERY_S = 20.0
"""A line comes no more often than this, wall time, and only when there is something new."""


class ProgressLines:
    """Logs the progress of a collection while it runs, and where it ends."""

    def __init__(
        self,
        node: Node,
        clock: Clock,
        counts: Callable[[], Mapping[str, Any]],
        state: Callable[[], str],
    ) -> None:
        self._log, self._counts, self._state = node.get_logger(), counts, state
        self._pace, self._last, self._last_s = Pace(), ('', 0), float('-inf')
        node.create_timer(LOOK_S, self._look, clock=clock)

    def _look(self) -> None:
        now, counts, state = time.monotonic(), self._counts(), self._state()
        done, of = counts['configurations_done'], counts['configurations']
        self._pace.update(done, now, running=state == 'running')
        if (state, done) == self._last or (state == 'running' and now - self._last_s < EVERY_S):
            return
        changed, self._last = state != self._last[0], (state, done)
        text = progress_text(counts, self._pace.left_s(of - done) if state == 'running' else None)
        if text and (changed or state == 'running'):
            self._last_s = now
            self._log.info(f'{state}: {text}')


# The plan that is next on a page, for a person to look at before the arm moves: `confirm: true`.
#
# The page is drawn beside the callbacks as soon as it is known where the arm stands, and again
# when another plan is next: after the registration, which the collection is planned from.


class PlanPreview(PlanConfirmation):
    """Draws the plan that is next beside the session's folder, until it is confirmed."""

    def __init__(
        self,
        cell: Workcell,
        tours: TourPlanner,
        memory: PlanMemory,
        progress: TourProgress,
        session: Path,
        background: Background,
    ) -> None:
        self.page = plan_page_path(session)
        super().__init__(cell.confirm, str(self.page))
        self._cell, self._tours = cell, tours
        self._memory, self._progress = memory, progress
        self._thread = PlanningThread(background, JointUnits.of(tours.model.chain))
        self._drawn: object = None

    def withdraw(self) -> None:
        """Have the page drawn anew before anything can be confirmed."""
        super().withdraw()
        self._drawn = None

    def values(self) -> dict[str, str]:
        """Return what people are shown of it."""
        if not self.required:
            return {}
        done = self.shown and self.shown == self.confirmed
        page = str(self.page) if self.shown else ''
        confirmed = 'yes' if done else 'no'
        return {'plan_page': page, 'plan_shown': self.shown, 'confirmed': confirmed}

    def asked(self) -> str:
        """Return the refusal of a person's request; what could not be shown is tried again."""
        refusal = self.refusal()
        if self.trouble:
            self.withdraw()
        return refusal

    def draw(self, q: FloatArray, peers: Peers) -> str:
        """Draw what is next, where the page has something else; return what a person is told.

        ``peers``: they tell which sensors must be registered before the collection.
        Returns '' while it is drawn, and where there is nothing new.
        """
        if not self.required:
            return ''
        try:
            what, tour = self._next(peers.required())
        except InputError as error:
            self.trouble = str(error)
            return ''
        if self.confirmed and what == self.confirmed:
            # Also where something else was drawn meanwhile.
            self.show(self.confirmed)
            self._drawn = what
        if what == self._drawn:
            return ''
        if self.shown:
            self.withdraw()
        T_R_N, stop = dict(self._progress.T_R_N), self._progress.open_pose
        # As it is now: the thread must not see it change.
        left = tour.fork() if tour is not None else None
        try:
            found = self._thread.ask(what, q, lambda: self._draw(what, left, stop, T_R_N, q))
            if found is None:
                return ''
            self.show(found[0])
        except RemasterError as error:
            self.trouble = str(error)
        self._drawn = what
        return self.refusal()

    def _next(self, required: RequiredSensors) -> tuple[str, Tour | None]:
        """Return what is next, as `TourProgress.next` has it, by a name of it; and its tour.

        That is the tour under way, by its fingerprint, or else one that is still to be planned.
        """
        T_R_N, tour = self._progress.T_R_N, self._memory.tour
        registered = self._progress.phase != REGISTRATION or required.are_among(T_R_N)
        if tour is not None and (REGISTRATION in tour.plans) != registered:
            return fingerprint(tour), tour
        if not registered:
            return REGISTRATION, None
        places = b''.join(name.encode() + T.tobytes() for name, T in sorted(T_R_N.items()))
        return f'collection {hash(places)}', None

    def _draw(
        self,
        what: str,
        tour: Tour | None,
        stop: PoseVisit | None,
        T_R_N: dict[str, FloatArray],
        q: FloatArray,
    ) -> str:
        """Write the page of what is next, and return the fingerprint of its tour."""
        # Only here: a planner without this page needs none of it.
        from remaster_ros.reports.plan_page import plan_page, write_plan_page
        from remaster_ros.reports.robot_scene import robot_scene

        planner, places = self._tours, T_R_N
        if tour is None:
            stop = None
            tour = planner.registration() if what == REGISTRATION else planner.collection(T_R_N)
        tours, registered = [tour], REGISTRATION not in tour.plans
        if not registered:
            # What is expected to follow; it is planned anew once the sensors are registered.
            tours.append(planner.collection(planner.rough_places))
        if not registered or not T_R_N:
            places = planner.rough_places
        plan = look_ahead(planner, places, tours, q, stop)
        name = fingerprint(tour)
        scene = robot_scene(self._cell, planner.scene).with_sensors(places)
        html = plan_page(
            plan, scene, Path(self._cell.file).stem, registered=registered, confirm=name
        )
        write_plan_page(self.page, html)
        return name


RETRY_WALL_S = 1.0
"""How often a full disk is tried again, wall time."""


class PosePlanner(RemasterNode):
    """See the module's text."""

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
        # Of the run, and of what may be published only while it is running.
        self._lock = threading.RLock()
        self.run = CollectionRun(self.p.resume_within_s)
        self._further = FurtherMeasuring(self.p.discovery, folder, self.journal, self._tours)
        # Every pose passes its gate in `_announce`.
        self._preview = PlanPreview(
            self.cell, self._tours, self.journal, self.progress, folder, Background(self)
        )
        self._judging = Judging(self, folder, self.p, self.cell, self._tours)
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
            self.create_service(Trigger, f'remaster/{kind}', partial(self._on_judge, kind))
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
        """Take up what a planner before this one has left."""
        journal = self.journal
        if journal.tour is None:
            return
        if journal.lost:
            self.get_logger().warning(journal.lost)
        # Plans that need a confirmation need it after every start.
        token = '' if self._preview.required else journal.run
        self.run.resume(journal.state, token, self.progress.describe())
        self.get_logger().warning(f'{journal.path}: going on; {self.progress.describe()}')

    def _take_up_run(self) -> None:
        """Go on with the run that a killed planner has left, if that certainly still lives."""
        left, peers = self.run.left, self._peers
        silent_s, progress = silence_s(left), self.progress.describe()
        with self._lock:
            # A pause or a stop may have come meanwhile.
            decided = self.run.left == left and self.run.take_up(
                silent_s, peers.bridge, peers.recorder, progress
            )
            if decided:
                self._follow_run()
        if decided and self.run.state != 'running':
            self.get_logger().warning(self.run.why)

    def _follow_run(self) -> None:
        """Publish the state of the run, with its sign of life; called with the lock held."""
        # First of all: a pause or a stop must not wait for the disk.
        self.status.publish()
        living, token = self._living, self.run.token
        if living is not None and living.token != token:
            living.end()
            living = None
        if living is None and token:
            living = LivingRun(token)
        self._living = living

    def _end(self, state: str, why: str = '') -> None:
        """End a run that is under way; `_step` writes that down."""
        with self._lock:
            if self.run.end(state, why, only_from='running'):
                self._follow_run()

    # Services

    def _on_collect(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        return self._collect(response)

    def _on_judge(self, kind: Kind, request: Trigger.Request, response: Trigger.Response) -> Any:
        """Begin, or go on with, visits by which the arm is judged; afterwards tell the verdict."""
        tour, recorder = self.journal.tour, self._peers.recorder
        own = tour is not None and tour.judges == kind
        if own and self.run.state == 'complete':
            response.success, response.message = self._judging.told()
        elif self.run.state == 'running':
            response.message = 'something else is under way' if not own else 'under way'
        elif (tour is not None and not own) or (
            tour is None and recorder is not None and recorder.observations
        ):
            response.message = (
                f'{self.p.session}: holds something else; start pose_planner and recorder with a '
                'new session folder'
            )
        else:
            response.message = self._judging.refusal(kind, self._peers.bridge)
            try:
                plan, words = self._judging.tour(kind) if not response.message else (None, '')
            except RemasterError as error:
                response.message = str(error)
            if not response.message:
                self._collect(response, None if own else plan)
                response.message = words if response.success else response.message
        return response

    def _collect(
        self, response: Trigger.Response, judging: Callable[[], Tour] | None = None
    ) -> Any:
        """Begin a run or go on; with `judging` that plans what is visited, once it is running."""
        bridge, recorder = self._peers.bridge, self._peers.recorder
        further, plan = self._further.ask(self.run.state, under_way=self.progress.goes_further)
        has_joints = self._q is not None
        refusal = self.run.refusal(bridge, recorder, has_joints=has_joints, further=further)
        # What is still to be planned cannot be shown; `_announce` has it confirmed.
        response.message = refusal or (self._preview.asked() if judging is None else '')
        if response.message:
            return response
        self.progress.judging = judging or self.progress.judging
        if plan is not None:
            # What was looked at before the first motion is looked at again.
            self.progress.further, self._described, self._cleared = plan, False, False
        if self.run.state != 'running':
            if recorder is not None and recorder.changed_run:
                # A person has looked: how things are from now on is measured first.
                self.journal.ask_round()
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
        response.success, response.message = self._preview.confirm(plan)
        if response.success and self.run.state != 'running':
            self.run.why = response.message
            self.status.publish()
        return response

    def _offer(self, plan: str) -> None:
        """Offer a service that confirms this plan and no other; it stays, to refuse later on."""
        if plan and plan not in self._offered:
            self._offered.add(plan)
            path = f'remaster/confirm/{service_name(plan)}'
            self.create_service(Trigger, path, partial(self._on_confirm, plan=plan))

    def _on_pause(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            response.success = self.run.pause()
            self._follow_run()
        response.message = 'paused' if response.success else f'not running, but {self.run.state}'
        return response

    def _on_stop(self, request: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            # The command first: nothing that fails behind it may keep the arm moving.
            self._poses.stop()
            self._announcements.retract()
            self.run.stop()
            self._follow_run()
        response.success, response.message = True, 'stopped'
        return response

    # What comes in

    def _listen_to_the_arm(self) -> Subscription:
        return self.create_subscription(
            JointState, 'joint_states', self._on_joint_state, JOINT_STATES
        )

    def _listen_again(self) -> None:
        self._joint_states = self._joint_states or self._listen_to_the_arm()

    def _on_joint_state(self, message: JointState) -> None:
        """Learn where the arm is before the first pose; after that by /remaster/settled."""
        if not self._order.concerns(message):
            return
        self._on_settled(message)
        if self._q is not None and self._joint_states is not None:
            self.destroy_subscription(self._joint_states)
            self._joint_states = None

    def _on_settled(self, message: JointState) -> None:
        try:
            # Where the nominal arm has its tool where the arm has it, if the bridge corrects.
            wanted = wanted_of(message, self._order.names)
            self._q = self._order.positions(message) if wanted is None else wanted
        except InputError as error:
            self.run.why = str(error)

    def _on_registration(self, message: TransformStamped) -> None:
        self.progress.T_R_N[message.child_frame_id] = transform_array(message)

    def _on_record(self, record: events.EventRecord) -> None:
        now = time.monotonic()
        self._peers.take(record, now)
        self._models.take(record, now)
        match record.body:
            case events.ArmHalted(reason=why) | events.BridgeState(halted=why) if why:
                # It goes on when a person has looked at the arm and calls /remaster/collect.
                self._end('paused', why)
            case events.BridgeState(asks_for_collect=why, run=run) if why:
                # An earlier run's may come late: a person has begun another one since.
                if run == self.run.token:
                    self._end('paused', why)
            case events.SetupChanged(stops=True, text=why):
                self._end('paused', why)
            case OptimizerState(enough=True, plan=plan) if plan and plan == self.journal.id:
                # The pose under way is finished, what is held out is measured: an ordinary end.
                self.progress.enough = True
            case events.RecorderState() as recorder:
                self._on_recorder(recorder)

    def _on_recorder(self, recorder: events.RecorderState) -> None:
        if self.run.token and recorder.changed_run == self.run.token:
            # Found while this planner was not there; collect begins another run.
            self._end('paused', recorder.changed)
        if self.progress.follow(recorder):
            self._step()
        tour, closed = self.journal.tour, recorder.exit_status == 'complete'
        if self.run.state == 'complete' and tour is not None and recorder.plan == self.journal.id:
            for kind in KINDS:
                if closed and tour.judges == kind:
                    self._judging.judge(kind)

    # The tour

    def _step(self) -> None:
        """Publish the next pose once every solution of the last one has its outcome."""
        living = self._living
        if living is not None:
            living.stay_alive()
        if self.run.left:
            self._take_up_run()
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
                stop = self.progress.next(q, required, recorder.registration)
                if stop is not None:
                    self._announcements.retract()
            elif (lack := self._announcements.lack()) is Lack.ANEW:
                stop = self.progress.rest(q)
            else:
                if lack is Lack.LATE:
                    self._repeat()
                return
        except RemasterError as error:
            self._end('failed', str(error))
            self.get_logger().error(str(error))
            return
        if self.progress.is_complete:
            self._end('complete', '' if self.progress.planned_any else self._further.describe())
        if self.progress.standing:
            self.run.why = self.progress.standing
            self._listen_again()
        if stop is not None and not self.journal.trouble:
            self._announce(stop)

    def _hindrance(self, now: float) -> str:
        """Return why no pose can be announced now; ''."""
        if self.clock_trouble:
            return self.clock_trouble
        if not self.status.alone(now):
            return 'listening whether there is another pose_planner'
        if trouble := self._models.trouble(now):
            return trouble
        if not self._announcements.matched(self._poses.subscribers, now):
            return 'waiting for robot_bridge and recorder'
        if not self._cleared:
            # Once, before the first motion. No pose was begun before a preflight was passed.
            seen_before = self.progress.resumed or bool(self.progress.T_R_N)
            facts = self._peers.facts(now, seen_before=seen_before)
            self._measure.call([s.name for s in facts.sensors if s.ready and s.read_age_s], now)
            findings = preflight(facts)
            self._cleared = not findings
            if findings:
                return f'preflight: {"; ".join(findings)}'
        return ''

    def _announce(self, stop: PoseVisit) -> None:
        tour = self.journal.tour
        if not self._preview.allows(tour):
            self._preview.withdraw()
            self._end('paused', self._preview.refusal())
            return
        if tour is not None and self.progress.phase != REGISTRATION and not self._described:
            self._described = True
            planned = self._further.planned(tour)
            if self._q is not None and not tour.begin_at and not tour.judges:
                self._session_s = session_time_s(self._tours, tour, self._q)
                minutes = f'{self._session_s / 60.0:.1f} min'
                planned += f'; about {minutes} of robot time for the whole session'
            self.status.event(events.TourPlanned(planned))
        with self._lock:
            # Paused or stopped while the pose was chosen and written: collect announces it.
            if self.run.state == 'running':
                last = self.progress.is_last_reference(stop)
                stamp = self._poses.announce(stop, self.journal.id, self.status, last=last)
                self._announcements.announced(stamp, time.monotonic())

    def _repeat(self) -> None:
        """Send the open pose's announcement again, for a node that lags."""
        with self._lock:
            if self.run.state == 'running':
                self._poses.repeat(self.status)
                self._announcements.announced(self._announcements.stamp, time.monotonic())

    def _write_state(self) -> None:
        """Write the state down; a stop or pause came in a thread that must not wait for it."""
        with self._lock:
            state, token = self.run.state, self.run.token
        self.journal.say_state(state, token)

    def _is_written(self) -> bool:
        """Whether the disk takes what it did not take before; looked at once a second."""
        now = time.monotonic()
        if now - self._tried_wall < RETRY_WALL_S:
            return False
        self._tried_wall = now
        self.journal.write_out()
        self.status.publish()
        return not self.journal.trouble

    def _summary(self) -> Summary:
        run, trouble = self.run, self.journal.trouble
        full = f'waiting for room on the disk: {trouble}' if trouble else ''
        values = {
            'robot': 'silent' if self._q is None else 'heard',
            'plan': self.journal.id,
            'references_done': self.progress.decided.references,
            # Whether it may still go on by itself.
            'resuming': 'yes' if run.left else 'no',
            **self._preview.values(),
            **self.progress.counts(),
            'verdict': self._judging.verdict,
            # Of the whole session; '' before its collection is planned.
            'robot_time_s': f'{self._session_s:.0f}' if self._session_s else '',
            'dropped_solutions_no free path': self.progress.decided.outcomes.get(
                events.NO_FREE_PATH, 0
            ),
        }
        why = full or run.why or self._judging.trouble
        level = 'error' if run.state == 'failed' else 'warn' if why else 'ok'
        shown = 'held' if full and run.state == 'running' else run.state
        return Summary(level, why or run.state, values, self.progress.state(shown, run.token))

    def close(self) -> None:
        """Publish that the planner has stopped, on which the bridge stops the arm."""
        self._end('stopped')
        self._write_state()
        self._judging.close()
        self.journal.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    # One for the tour, one for pause and stop, one for the status.
    return run(PosePlanner, args, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
