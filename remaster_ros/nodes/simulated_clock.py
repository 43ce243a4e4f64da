# SPDX-License-Identifier: Apache-2.0
"""Nodes in a simulation that waits for them.

The watchdogs of a node measure silence in wall time, since a clock that is published may stand
still. A simulation on a busy machine stands still on purpose, until its nodes have kept up, and
nothing is missed meanwhile. In such a one, and there alone, watchdogs follow the simulated clock.
"""

from __future__ import annotations

import os
import threading
import time

from builtin_interfaces.msg import Time
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from remaster_ros.collection.message_fields import seconds
from remaster_ros.errors import InputError
from remaster_ros.nodes.running import RemasterNode

TAKEN = 'remaster/joint_states_taken'
TAKEN_EVERY_S = 0.1
"""Reports are confirmed no more often than this, s of their stamps, or where these stand of wall
time."""
LEADS = 'leads'
"""Behind the process id of who leads the arm: no report is left out there, and time waits for
each."""
SILENT_WALL_S = 5.0
"""A clock that is not published for so long has ended, and watchdogs follow the wall's, s.

One that is published and stands waits for somebody, however long.
"""
OWN_PAUSE_WALL_S = 0.5
"""A process that has not looked at its time for longer than this was paused or kept busy, s, and
has heard nothing meanwhile. Watchdogs look twenty times a second."""
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""As rclpy subscribes to the clock."""


class SteadyTime:
    """The time of a node's watchdogs, s: the wall clock's, monotonic.

    In a simulation that waits for its nodes it is the simulated clock's divided by its rate, which
    never runs faster than the wall's; and the wall's where the simulated clock has ended.

    ``rate``: `simulated_clock_rate`; 0 for the wall clock.
    Raises InputError: a rate without ``use_sim_time``.
    """

    def __init__(self, node: RemasterNode, rate: float) -> None:
        self._node, self._rate = node, rate
        if rate and not node.get_parameter('use_sim_time').value:
            raise InputError(
                f'{node.get_name()}: simulated_clock_rate is {rate:g}, but use_sim_time is not '
                'set; beside a real arm leave it out'
            )
        self._lock = threading.Lock()
        # Of the last look, but `_heard_wall`: when the simulated clock came.
        self._wall = self._value = self._heard_wall = time.monotonic()
        self._simulated = 0.0
        # Between value and simulated clock.
        self._offset = 0.0
        if rate:
            # Beside rclpy's own subscription, which tells nothing of a time that comes again.
            node.create_subscription(Clock, '/clock', self._on_clock, CLOCK_QOS, raw=True)

    def _on_clock(self, message: bytes) -> None:
        """Note the wall time at which a clock message came; its content is not read."""
        self._heard_wall = time.monotonic()

    def __call__(self) -> float:
        """Return the time now, s."""
        wall = time.monotonic()
        if not self._rate:
            return wall
        with self._lock:
            if wall - self._wall > OWN_PAUSE_WALL_S:
                self._heard_wall += wall - self._wall
            simulated = self._node.now_s() / self._rate
            ended = wall - self._heard_wall > SILENT_WALL_S
            most = self._value + wall - self._wall
            if simulated != self._simulated:
                if ended or not self._simulated or simulated < self._simulated:
                    # It begins, again or anew: it goes on from here.
                    self._offset = self._value - simulated
                self._simulated = simulated
                self._value = max(self._value, min(simulated + self._offset, most))
            elif ended:
                self._value = most
            self._wall = wall
            return self._value


class ReportsTaken:
    """Publishes, in a simulation, up to which stamp a node has processed its messages.

    ``simulated``: nothing is published if 0 (or False), as for a `simulated_clock_rate` of 0;
    ``leads``: whether the node leads the arm.
    """

    def __init__(self, node: RemasterNode, simulated: float, *, leads: bool = False) -> None:
        self._every_s = 0.0 if leads else TAKEN_EVERY_S
        self._name = f'{os.getpid()} {LEADS}' if leads else str(os.getpid())
        self._publisher = node.create_publisher(Header, TAKEN, 10) if simulated else None
        # Stamps of what was confirmed and of what was taken last, and when that was confirmed.
        self._confirmed_s = self._taken_s = -TAKEN_EVERY_S
        self._confirmed_wall = 0.0

    def take(self, stamp: Time) -> None:
        """Publish, on `TAKEN`, that all messages up to a stamp have been processed.

        At most every `TAKEN_EVERY_S` of stamps; by a node that leads the arm, at every new
        stamp. If the stamp is that of the last call, published again once `TAKEN_EVERY_S` of
        wall time have passed. Nothing without a simulation.
        """
        if self._publisher is None:
            return
        stamp_s, wall = seconds(stamp), time.monotonic()
        # A robot that sends one report again and again has published something all the same.
        is_same = stamp_s == self._taken_s
        again = is_same and wall - self._confirmed_wall >= TAKEN_EVERY_S
        self._taken_s = stamp_s
        is_soon = is_same or abs(stamp_s - self._confirmed_s) < self._every_s
        if is_soon and not again:
            return
        self._confirmed_s, self._confirmed_wall = stamp_s, wall
        self._publisher.publish(Header(stamp=stamp, frame_id=self._name))
