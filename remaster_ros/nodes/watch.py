# SPDX-License-Identifier: Apache-2.0
"""Serve the live page: what the nodes publish, and the services that a person may call there.

The page is `reports.live_view` and `reports.live_server`; this is their ROS shell. It commands
nothing itself: its buttons call the services that everybody has, whose nodes decide. A halt
cannot be cleared here.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped
from rclpy.exceptions import InvalidHandle
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from remaster_ros.collection.events import EventRecord
from remaster_ros.collection.message_fields import JointOrder, solutions_of
from remaster_ros.collection.plan_confirmation import service_name
from remaster_ros.errors import RemasterError
from remaster_ros.nodes.background import Background
from remaster_ros.nodes.messages import read_place, transform_array, waypoints_by_solution
from remaster_ros.nodes.opening_file import opening_file, page_name
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.rviz_markers import RvizMarkers
from remaster_ros.nodes.status import (
    LATCHED,
    LEVELS,
    PRECISION_TOPIC,
    RELIABLE,
    TOPIC,
    NodeStatus,
    Summary,
    listen,
)
from remaster_ros.reports.fit_json import FIT_FILE, REPORT_FILE, read_fit
from remaster_ros.reports.live_connections import Place
from remaster_ros.reports.live_server import COMMANDS, CONFIRM, Done, LiveServer
from remaster_ros.reports.live_view import FitFacts, LiveView, PlanPage
from remaster_ros.reports.plan_page import read_plan_page
from remaster_ros.reports.robot_scene import robot_scene
from remaster_ros.reports.scene_view import scene_to_dict
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import FloatArray

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
EVERY_S = 0.2
IDLE_EVERY_S = 1.0
"""How often the view is renewed while somebody looks, and while nobody does."""
NICENESS = 5
"""The page gives way to what moves the arm."""
OTHER_PLAN = 'another plan is next; look again'


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the live page."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    fit: str = parameter('fit', "the optimizer's folder: what a fit has brought is read there")
    address: str = parameter(
        '127.0.0.1',
        'IP address to listen on; one that other computers reach needs certificate and key',
    )
    port: int = parameter(
        0,
        'port to listen on; 0 for any free one, another one with every start: no other program '
        'can wait there for the page',
        low=0,
        high=65535,
    )
    names: str = parameter('', 'names of this computer by which browsers may ask, with commas')
    certificate: str = parameter('', 'PEM file of the certificate for https; empty for http')
    key: str = parameter('', 'PEM file of its key')
    publish_tf: bool = parameter(
        True, 'publish where the sensors stand to /tf_static, where tf2_msgs is installed'
    )


class Watch(RemasterNode):
    """Node that serves the live page, whose buttons call the services of other nodes."""

    # It moves nothing, and no node depends on it.
    outlives_faults = True

    def __init__(self) -> None:
        super().__init__('watch')
        self.p = declare(self, Parameters)
        cell = read_cell(self.p.cell)
        self.chain = cell.chain()
        self._order = JointOrder(self.chain.joint_names)
        markers = {
            name: {marker: np.array(cell.markers[marker]) for marker in sensor.markers}
            for name, sensor in cell.sensors.items()
        }
        self.view = LiveView(self.chain, markers)
        self._waypoints, self._stds = JointTrajectory(), JointState()
        self._means: JointState | None = None
        self._background = Background(self)
        self._published_s = float('-inf')
        self._q: FloatArray | None = None
        # A plan is confirmed by a service of its own, of which there is none yet.
        self._callers = {n: self._caller(n) for n in COMMANDS if n != CONFIRM}
        self._plan = ''
        self._subscribe({name: sensor.topics for name, sensor in cell.sensors.items()})
        scene = robot_scene(cell, cell.planning_scene(self.chain))
        on_tool = [name for name, sensor in cell.sensors.items() if sensor.mounted_on]
        self._rviz = RvizMarkers(self, scene, publish_tf=self.p.publish_tf, on_tool=on_tool)
        self.page = self._open_page(msgspec.json.encode(scene_to_dict(scene)))
        self.status = NodeStatus(self, self._summary)
        self.create_timer(EVERY_S, self._show, clock=self.status.steady)

    def _open_page(self, scene: bytes) -> LiveServer:
        """Start the server of the live page, and print its address for this user alone.

        On a terminal the address with the token, else the path of a file that leads there. Raises
        InputError as `LiveServer` and `runtime_folder`.
        """
        names = tuple(name.strip() for name in self.p.names.split(',') if name.strip())
        place = Place(self.p.address, self.p.port, names, self.p.certificate, self.p.key)
        name = page_name(self.context.get_domain_id(), self.get_fully_qualified_name())
        # New with every start: an open page sends the old one to whoever has the port then.
        page = LiveServer(place, secrets.token_urlsafe(32), scene, self._send)
        file = opening_file(name, page.url)
        # Not by the logger: that publishes, and the token is for this user alone.
        print(f'live page: {page.url if sys.stdout.isatty() else f"open {file}"}', flush=True)
        return page

    def _subscribe(self, sensors: Mapping[str, Mapping[str, str]]) -> None:
        """Subscribe to all topics that the page shows, and the markers of `sensors`.

        ``sensors``: sensor -> marker -> topic. Invalid messages are dropped silently.
        """

        def take(kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
            self.create_subscription(kind, topic, _tolerant(callback), qos)

        take(JointState, 'joint_states', self._on_joint_state, NEWEST)
        take(PoseStamped, 'remaster/target_pose', self._on_target, RELIABLE)
        take(JointTrajectory, 'remaster/joint_waypoints', self._on_waypoints, RELIABLE)
        take(JointTrajectory, 'remaster/joint_solutions', self._on_solutions, RELIABLE)
        take(TransformStamped, 'remaster/registration', self._on_registration, LATCHED)
        take(JointState, 'remaster/joint_offsets', self._on_means, LATCHED)
        take(JointState, 'remaster/joint_offsets_std', self._on_stds, LATCHED)
        take(DiagnosticArray, TOPIC, self._on_status, RELIABLE)
        take(
            String,
            PRECISION_TOPIC,
            lambda message: self.view.take_precision(message.data),
            LATCHED,
        )
        for name, topics in sensors.items():
            for marker, topic in topics.items():
                take(PointStamped, topic, partial(self._on_point, name, marker), NEWEST)
        listen(self, self._on_record)

    # What comes in

    def _on_record(self, record: EventRecord) -> None:
        """Show a record of another node."""
        self.view.take(record.body, time.monotonic())

    def _on_status(self, array: DiagnosticArray) -> None:
        """Show each diagnostic status; then look for a new plan. An unknown level is an error."""
        words = {level: word for word, level in LEVELS.items()}
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            level, now = words.get(status.level, 'error'), time.monotonic()
            self.view.take_summary(status.name, level, status.message, values, now)

        self._look_for_plan()

    def _look_for_plan(self) -> None:
        """Read the page of the next plan, and make a client of its confirmation service.

        The client of the plan before is destroyed; nothing if the plan is the same. The page is
        read in the background.
        """
        plan, page = self.view.plan_to_show()
        if plan == self._plan:
            return
        if self._plan:
            self.destroy_client(self._callers.pop(f'{CONFIRM}/{self._plan}'))
        self._plan = plan
        if plan:
            self._callers[f'{CONFIRM}/{plan}'] = self._caller(f'{CONFIRM}/{service_name(plan)}')
            read = partial(read_plan_page, Path(page), plan)
            self._background.submit(read, partial(self._on_plan_page, plan))

    def _on_plan_page(self, plan: str, found: bytes | Exception) -> None:
        """Show the page of a plan, or the error with which it could not be read."""
        if isinstance(found, Exception):
            self.view.take_plan_page(PlanPage(plan, trouble=str(found)))
        else:
            self.view.take_plan_page(PlanPage(plan, self.page.show_plan(found)))

    def _on_joint_state(self, message: JointState) -> None:
        """Keep the positions of the arm's joints for the page; ignore reports of other joints."""
        if self._order.concerns(message):
            self._q = self._order.positions(message)
            self.view.take_joints(self._q)

    def _on_point(self, sensor: str, marker: str, message: PointStamped) -> None:
        """Use a sensor's reading of a marker, m, for the residuals on the page."""
        position = np.array([message.point.x, message.point.y, message.point.z])
        self.view.residuals.reading(sensor, marker, position)

    def _on_target(self, message: PoseStamped) -> None:
        """Show a target pose."""
        self.view.take_target(read_place(message.pose.position, message.pose.orientation))

    def _on_waypoints(self, message: JointTrajectory) -> None:
        """Keep the waypoints, for the solutions with the same stamp."""
        self._waypoints = message

    def _on_solutions(self, message: JointTrajectory) -> None:
        """Show the path from the arm's position through all solutions of the pose.

        With the waypoints of the same stamp between them; without a position it begins at the
        first solution. Raises InputError as `solutions_of`.
        """
        names, waypoints = self.chain.joint_names, self._waypoints
        targets = solutions_of(message, names)
        belongs = waypoints.header.stamp == message.header.stamp
        between = waypoints_by_solution(waypoints, names) if belongs else {}
        way = [] if self._q is None else [self._q[None]]
        for index, target in enumerate(targets):
            way += [between.get(index, np.empty((0, len(names)))), target[None]]
        self.view.take_way(np.concatenate(way) if way else targets)

    def _on_registration(self, message: TransformStamped) -> None:
        """Show a sensor's registration, on the page and in RViz."""
        self.view.take_registration(message.child_frame_id, transform_array(message))
        self._rviz.place_sensors(self.view.registration)

    def _on_means(self, message: JointState) -> None:
        """Keep the offsets of a fit; show them once their standard deviations are there."""
        self._means = message
        self._take_offsets()

    def _on_stds(self, message: JointState) -> None:
        """Keep the standard deviations of the offsets; show both once the offsets are there."""
        self._stds = message
        self._take_offsets()

    def _take_offsets(self) -> None:
        """Show the offsets of a fit when both of its messages (same stamp) are there.

        Further facts on the fit are read from its fit.json, in the background.
        """
        means, stds = self._means, self._stds
        if means is None or means.header.stamp != stds.header.stamp:
            return
        by_name = [dict(zip(m.name, m.position, strict=False)) for m in (means, stds)]
        self.view.take_offsets(*by_name)
        self._background.submit(
            partial(fit_facts, Path(self.p.fit), by_name[0]), self._on_fit_facts
        )

    def _on_fit_facts(self, facts: Any) -> None:
        """Show further facts of a fit, and use its markers for the live residuals.

        ``facts``: the `FitFacts` read in the background, or the exception that ended the
        reading, which changes nothing.
        """
        if not isinstance(facts, Exception):
            self.view.take_fit(facts)

    # What goes out

    def _caller(self, name: str) -> Any:
        """Return a client of the service remaster/`name`."""
        return self.create_client(Trigger, f'remaster/{name}')

    def _send(self, name: str, done: Done) -> None:
        """Call a service of the page; then call `done` with its success and message.

        Called in the thread of the page, which does not wait. `done` is called at once,
        without success, if `name` is no service of the page now, or no node offers it.
        """
        client = self._callers.get(name)
        if client is None:
            done(False, OTHER_PLAN)
            return
        if not client.service_is_ready():
            done(False, f'nobody offers {client.srv_name}')
            return

        def answered(future: Any) -> None:
            try:
                answer = future.result()
            except Exception as error:
                done(False, f'{client.srv_name}: {error}')
                return
            done(answer.success, answer.message)

        try:
            client.call_async(Trigger.Request()).add_done_callback(answered)
        except InvalidHandle:
            done(False, OTHER_PLAN)

    def _show(self) -> None:
        """Publish the view to page and RViz every `EVERY_S`; `IDLE_EVERY_S` if nobody looks."""
        now = time.monotonic()
        confirming = self._callers.get(f'{CONFIRM}/{self._plan}')
        self.view.plan_offered = confirming is not None and confirming.service_is_ready()
        watched = self.page.watched or self._rviz.wanted
        if now - self._published_s >= (EVERY_S if watched else IDLE_EVERY_S) - 0.01:
            self._published_s = now
            view = self.view.view(now)
            self.page.publish(view)
            if self._rviz.wanted:
                self._rviz.publish(view['scene'])

    def _summary(self) -> Summary:
        """Summary for the status: whether somebody looks at the page, and where it is served."""
        state = 'watched' if self.page.watched else 'serving'
        return Summary('ok', state, {'address': self.p.address, 'port': self.page.port})

    def close(self) -> None:
        """End the server and the background thread."""
        self.page.close()
        self._background.close(1.0)


def _tolerant(callback: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that drops messages for which `callback` raises; nothing is logged.

    That is for RemasterError, ValueError and msgspec's errors, since other nodes log these
    messages; other exceptions are raised.
    """

    def receive(message: Any) -> None:
        with contextlib.suppress(RemasterError, ValueError, msgspec.MsgspecError):
            callback(message)

    return receive


def fit_facts(folder: Path, offsets: Mapping[str, float]) -> FitFacts:
    """Return the further facts of a fit for the page, from the fit.json of the optimizer.

    They are texts by label (mean errors, files), the joints that are not identifiable, and the
    markers' positions. All are empty if there is no valid fit.json on this computer, or it is
    of another fit. ``folder``: of the optimizer; ``offsets``: as published, joint -> rad or m,
    by which the fit is recognised (`numpy.isclose`).
    """
    try:
        fit = read_fit(folder / FIT_FILE)
    except RemasterError:
        return FitFacts()
    of_file = {row.joint: row.mean_and_std[0] for row in fit.joint_offsets}
    if not all(np.isclose(offsets.get(name, np.nan), mean) for name, mean in of_file.items()):
        return FitFacts()
    facts = {}
    for split, words in (('validation', 'held-out poses'), ('optimization', 'fitted poses')):
        # As measured: the theoretical error is what the posterior predicts.
        errors = (getattr(fit.accuracy, split) or {}).get('post_registration')
        if errors:
            before, after = (errors[when]['mean_mm'] for when in ('before', 'after'))
            facts[f'mean error, {words}'] = f'{before:.3f} mm → {after:.3f} mm'
    report = folder / REPORT_FILE
    facts['files'] = str((report if report.exists() else folder).resolve())
    return FitFacts(
        facts,
        frozenset(row.joint for row in fit.joint_offsets if not row.identifiable),
        {name: np.array(marker.position_m) for name, marker in fit.markers.items()},
    )


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal ends it or it cannot start; return its exit status."""
    os.nice(NICENESS)
    make: Callable[[], RemasterNode] = Watch
    return run(make, args)


if __name__ == '__main__':
    raise SystemExit(main())
