# SPDX-License-Identifier: Apache-2.0
"""What a bench of real nodes observes: every command to the controller, and the messages about it.

Commands are judged as a controller takes them: cubics from where the arm is to the first point,
and from point to point. Where the arm is comes from the hidden World, which notes when each
trajectory began, and not from joint_states, which the fault under test may have spoiled.
"""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from remaster_ros.collection.events import (
    STATES,
    ArmHalted,
    ArmStopped,
    ConfigurationEnded,
    Event,
    SolutionFailed,
)
from remaster_ros.session.yaml_records import from_plain
from remaster_ros.simulation.arm_motion import Motion, ServoPoint, spline
from remaster_ros.simulation.world import MOTION_FILE, START_S

TOUCHED_RAD = 1e-4
"""The probe before the first move goes a micrometre; no other command does."""
SPEED_TOLERANCE = 1.02
"""The servo of the fake arm overshoots a little: it is not quite as fast as its reference."""
SAME_RAD = 0.03
"""So near are a command and what the fake arm makes of it, also where it goes elsewhere, rad."""
SAME_WALL_S = 3.0
"""A command comes to the bench so much earlier or later at most than to the fake arm, s."""
UNNAMED = '_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_'
"""Of a participant that has just been found the graph has no name yet."""
CONSEQUENCES = ('planner is ', 'the halt was cleared', 'looking for another', 'no controller')
"""Messages of a bridge that follow from the operator or from a restart, and not from the fault."""
STARTING_S = 4.0
"""A node that is up for less is still looking for the others, s."""


@dataclass(frozen=True)
class Command:
    """A trajectory as the controller gets it.

    Attributes
    ----------
    wall_s
        When, s.
    times_s, q, velocity
        Of its points, the first being the arm at that moment: (n,), rad (n, k), rad/s (n, k).
    """

    wall_s: float
    times_s: np.ndarray
    q: np.ndarray
    velocity: np.ndarray

    @property
    def points(self) -> int:
        """Points of the message: a stop has one."""
        return len(self.times_s) - 1

    @property
    def duration_s(self) -> float:
        """Robot time, s."""
        return float(self.times_s[-1])

    @property
    def travel_rad(self) -> float:
        """How far the joint goes that goes furthest, rad."""
        return float(np.max(np.abs(self.q[-1] - self.q[0])))

    @property
    def is_move(self) -> bool:
        """Whether it is a way to somewhere: no stop, and no probe."""
        return self.points > 1 and self.travel_rad > TOUCHED_RAD

    def extremes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lowest and highest position and highest speed of the cubics, each (k,)."""
        places, speeds = [], []
        for (t0, q0, v0), (t1, q1, v1) in pairwise(zip(self.times_s, self.q, self.velocity)):
            c = spline(q0, v0, q1, v1, t1 - t0)
            s = np.linspace(0.0, t1 - t0, 41)
            places.append(s[:, None] ** np.arange(4) @ c)
            speeds.append(np.abs(s[:, None] ** np.arange(3) @ (c[1:] * np.arange(1, 4)[:, None])))
        q = np.concatenate(places)
        return q.min(0), q.max(0), np.concatenate(speeds).max(0)


class Observer:
    """Follow commands and words of one ROS domain.

    Parameters
    ----------
    node
        The bench's own node, spun in another thread.
    world
        The hidden World, for where the arm really is.
    speed_share
        What the bridge may use of the arm's speed.
    """

    def __init__(self, node, world, speed_share: float) -> None:
        from trajectory_msgs.msg import JointTrajectory

        from remaster_ros.nodes.robot_bridge import COMMANDS
        from remaster_ros.nodes.status import RELIABLE, listen

        self.world, self.chain, self.speed_share = world, world.chain, speed_share
        self._messages: list = []
        self._commands: list[Command] = []
        self.events: list[tuple[float, Event]] = []
        self.summaries: list[tuple[float, str, str, dict[str, str]]] = []
        self.latest: dict[str, tuple[float, str, dict[str, str]]] = {}
        listen(node, self._record, self._summary)
        node.create_subscription(
            JointTrajectory,
            COMMANDS,
            lambda message: self._messages.append((time.monotonic(), world.now(), message)),
            RELIABLE,
        )

    def _record(self, record) -> None:
        if not isinstance(record.body, STATES):
            self.events.append((time.monotonic(), record.body))

    def _summary(self, node: str, message: str, values: dict[str, str]) -> None:
        now = time.monotonic()
        self.latest[node] = now, message, values
        self.summaries.append((now, node, message, values))

    @property
    def commands(self) -> list[Command]:
        """Every command so far."""
        while len(self._commands) < len(self._messages):
            self._commands.append(self._command(*self._messages[len(self._commands)]))
        return self._commands

    def _start(self, came_s: float, points: int, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return where the arm was, and how fast, when a command to `end` began.

        It came here at world time `came_s`, which may stand between two readings of a wall clock.
        """
        while (text := (self.world.folder / MOTION_FILE).read_text())[-1:] not in ('', '\n'):
            time.sleep(0.01)  # The arm is writing the last line.
        lines = text.splitlines()
        motion = Motion(START_S, self.world.start_q)
        nearest_s, begun = SAME_WALL_S * self.world.rate, None
        for start_s, plain in map(json.loads, lines):
            waypoints = from_plain(plain, list[ServoPoint])
            since_s, off = abs(start_s - came_s), np.max(np.abs(waypoints[-1].q - end))
            if len(waypoints) == points and off < SAME_RAD and since_s < nearest_s:
                nearest_s, begun = since_s, motion.at(start_s)
            motion.follow(start_s, waypoints)
        # One that the arm has dropped began when it came.
        return begun or motion.at(came_s)

    def _command(self, wall_s: float, came_s: float, message) -> Command:
        columns = [list(message.joint_names).index(name) for name in self.chain.joint_names]
        end = np.array(message.points[-1].positions)[columns]
        q, velocity = self._start(came_s, len(message.points), end)
        times, places, speeds = [0.0], [q], [velocity]
        for point in message.points:
            times.append(point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec)
            places.append(np.array(point.positions)[columns])
            speeds.append(np.array(point.velocities)[columns])
        return Command(wall_s, *map(np.array, (times, places, speeds)))

    # What was commanded

    def since(self, wall_s: float, until_s: float = np.inf) -> list[Command]:
        """Return the commands of a stretch of wall time."""
        return [c for c in self.commands if wall_s < c.wall_s <= until_s]

    def share(self, command: Command) -> float:
        """Return the highest speed of a command as a share of the arm's limits."""
        return float(np.max(command.extremes()[2] / self.chain.velocity_limits))

    def judge(self, commands: list[Command]) -> None:
        """Assert that nothing was commanded outside the limits, or too fast."""
        for command in commands:
            low, high, _ = command.extremes()
            assert np.all(low >= self.chain.lower), (np.rad2deg(low), 'below the limits')
            assert np.all(high <= self.chain.upper), (np.rad2deg(high), 'above the limits')
            share = self.share(command)
            assert share <= SPEED_TOLERANCE * self.speed_share, f'{share:.3f} of the speed'

    # What was said

    def says(self, node: str, key: str) -> str:
        """Return a value of a node's last summary."""
        return self.latest.get(node, (0.0, '', {}))[2].get(key, '')

    def find(self, kind: type, since_s: float = 0.0) -> list[tuple[float, Event]]:
        """Return the events of a kind since a wall time, with theirs."""
        return [
            (wall_s, event)
            for wall_s, event in list(self.events)
            if wall_s > since_s and isinstance(event, kind)
        ]

    def reasons(self, since_s: float, until_s: float = np.inf) -> list[str]:
        """Return the messages about a fault, each once, bridge first, without numbers."""
        found = {}
        for wall_s, event in list(self.events):
            if not since_s < wall_s <= until_s:
                continue
            if isinstance(event, ArmStopped | ArmHalted | SolutionFailed):
                found.setdefault(event.reason, 0)
            elif isinstance(event, ConfigurationEnded):
                for part in event.reason.split('; '):
                    # What is absent or was not waited for is said elsewhere, and is no refusal.
                    if ': ' in part and event.result in ('partial', 'rejected'):
                        found.setdefault(part, 1)
        for wall_s, node, message, values in list(self.summaries):
            if not since_s < wall_s <= until_s or node not in ('robot_bridge', 'pose_planner'):
                continue
            if node == 'pose_planner' and values.get('state') != 'failed':
                continue
            up_s = float(values.get('uptime_s', 'inf'))
            idle = message in ('moving or measuring', 'waiting for a pose')
            if not idle and up_s > STARTING_S:
                found.setdefault(message, 0)
        for text in [text for text in found if UNNAMED in text]:
            named = text.split(': ')[0]
            if any(other.startswith(named) and UNNAMED not in other for other in found):
                # It has been told again, with the name.
                del found[text]
        wanted = {plain(text): rank for text, rank in found.items() if not _follows(text)}
        return sorted(wanted, key=lambda text: (wanted[text], text))


def _follows(text: str) -> bool:
    # A pause that finds the robot astray halts, and that is of the fault.
    return text.startswith(CONSEQUENCES) and ';' not in text


def plain(text: str) -> str:
    """Return a reason without what depends on the moment."""
    text = re.sub(r' \((halted|process) [^)]*\)', '', text).replace('|', '/')
    text = re.sub(r'\d+(\.\d+){3}:\d+', 'ADDRESS', text)
    text = re.sub(r'joint(s?)[ _]\d', r'joint\1 …', text)
    text = re.sub(r'((?:other_)?joint …)(, \1)+', r'\1', text)
    text = text.replace(UNNAMED, '…')
    text = re.sub(r'-?\d+\.\d+|\b(inf|nan)\b|\d+(?= mm| usable| readings| s old)', '…', text)
    text = re.sub(r'at the last \d+', 'at the last …', text)
    return re.sub(r'solutions? \d+', 'a solution', text)
