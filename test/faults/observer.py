# SPDX-License-Identifier: Apache-2.0
"""What a bench of real nodes observes: every command to the controller, and the messages about it.

Commands are judged as a controller takes them: cubics from where the arm is to the first point,
and from point to point; of a trajectory whose stamp has passed, what remains of it. Where the arm
is comes from the hidden World, which notes when each trajectory began, and not from joint_states,
which the fault under test may have spoiled.
"""

from __future__ import annotations

import copy
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
from remaster_ros.simulation.arm_motion import Motion, ServoPoint, from_now, spline
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
    stamp_s
        Its stamp, world time, s, which all pieces of a move share; 0 for at once.
    points
        Points of the message, also those that have passed: a stop and a probe have one.
    times_s, q, velocity
        Where the controller begins, and the points that remain: (n,), rad (n, k), rad/s (n, k).
    """

    wall_s: float
    stamp_s: float
    points: int
    times_s: np.ndarray
    q: np.ndarray
    velocity: np.ndarray

    @property
    def duration_s(self) -> float:
        """Robot time from its arrival to its end, s."""
        return float(self.times_s[-1])

    @property
    def travel_rad(self) -> float:
        """How far the joint goes that goes furthest, rad."""
        return float(np.max(np.abs(self.q[-1] - self.q[0])))

    @property
    def is_move(self) -> bool:
        """Whether it is a move, or a piece of one: no stop, and no probe."""
        return self.points > 1 and self.travel_rad > TOUCHED_RAD

    def extremes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return lowest and highest position and highest speed of the cubics, each (k,)."""
        places, speeds = [self.q[:1]], [np.zeros_like(self.q[:1])]
        for (t0, q0, v0), (t1, q1, v1) in pairwise(zip(self.times_s, self.q, self.velocity)):
            c = spline(q0, v0, q1, v1, t1 - t0)
            s = np.linspace(0.0, t1 - t0, 41)
            places.append(s[:, None] ** np.arange(4) @ c)
            speeds.append(np.abs(s[:, None] ** np.arange(3) @ (c[1:] * np.arange(1, 4)[:, None])))
        q = np.concatenate(places)
        return q.min(0), q.max(0), np.concatenate(speeds).max(0)


@dataclass(frozen=True)
class TakenUp:
    """A trajectory that the arm has taken up.

    Attributes
    ----------
    start_s
        When, world time, s.
    waypoints
        What remained of it then, at times from `start_s`.
    before
        Position and velocity of the arm then, rad, rad/s, (k,) each.
    after
        The motion with it.
    """

    start_s: float
    waypoints: list[ServoPoint]
    before: tuple[np.ndarray, np.ndarray]
    after: Motion


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

        from remaster_ros.nodes.robot_bridge import COMMANDS, SOLUTIONS
        from remaster_ros.nodes.status import RELIABLE, listen

        self.world, self.chain, self.speed_share = world, world.chain, speed_share
        self._messages: list = []
        self._commands: list[Command] = []
        still = Motion(START_S, world.start_q)
        self._motions, self._read_to = [TakenUp(START_S, [], still.at(START_S), still)], 0
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
        self._targets = np.zeros((0, len(self.chain)))
        node.create_subscription(JointTrajectory, SOLUTIONS, self._announced, RELIABLE)

    def _announced(self, message) -> None:
        columns = [list(message.joint_names).index(name) for name in self.chain.joint_names]
        self._targets = np.array([np.array(point.positions)[columns] for point in message.points])

    def left_s(self, command: Command) -> float:
        """Return the least robot time from a command's arrival to the end of its move, s.

        Of the solutions announced last the move is to the one that lies in its direction; no
        joint is faster than the bridge lets it be.
        """
        way, ways = command.q[-1] - command.q[0], self._targets - command.q[0]
        lengths = np.linalg.norm(way) * np.linalg.norm(ways, axis=1)
        if not np.any(lengths > 0.0):
            return 0.0
        along = np.where(lengths > 0.0, ways @ way / np.maximum(lengths, 1e-12), -1.0)
        fastest = self.speed_share * self.chain.velocity_limits
        return float(np.max(np.abs(ways[np.argmax(along)]) / fastest))

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

    def _read_motions(self) -> None:
        """Follow the trajectories that the arm has taken up since the last call."""
        with (self.world.folder / MOTION_FILE).open() as file:
            file.seek(self._read_to)
            while (line := file.readline()).endswith('\n'):
                self._read_to = file.tell()
                start_s, plain, now = json.loads(line)
                waypoints = from_plain(plain, list[ServoPoint])
                reference = None if now is None else (np.array(now[0]), np.array(now[1]))
                motion = copy.copy(self._motions[-1].after)
                before = motion.at(start_s)
                motion.follow(start_s, waypoints, reference)
                self._motions.append(TakenUp(start_s, waypoints, before, motion))

    def _begun(
        self, came_s: float, stamp_s: float, points: list[ServoPoint]
    ) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
        """Return when the arm took a command up, world time, s; its place and speed then.

        It came here at world time `came_s`, which may stand between two readings of a wall clock.
        One that the arm has dropped was taken up when it came.
        """
        self._read_motions()
        nearest_s, begun = SAME_WALL_S * self.world.rate, None
        last = self._motions[0]
        for motion in self._motions[1:]:
            if motion.start_s <= came_s:
                last = motion
            remaining, _ = from_now(motion.start_s, stamp_s or None, points)
            since_s = abs(motion.start_s - came_s)
            off = np.max(np.abs(motion.waypoints[-1].q - points[-1].q))
            is_same = len(motion.waypoints) == len(remaining) and off < SAME_RAD
            if is_same and since_s < nearest_s:
                nearest_s, begun = since_s, (motion.start_s, motion.before)
        return begun or (came_s, last.after.at(came_s))

    def _command(self, wall_s: float, came_s: float, message) -> Command:
        columns = [list(message.joint_names).index(name) for name in self.chain.joint_names]
        stamp_s = _seconds(message.header.stamp)
        points = [
            ServoPoint(
                _seconds(point.time_from_start),
                np.array(point.positions)[columns],
                np.array(point.velocities)[columns],
            )
            for point in message.points
        ]
        begun_s, start = self._begun(came_s, stamp_s, points)
        remaining, reference = from_now(begun_s, stamp_s or None, points)
        q, velocity = reference or start
        return Command(
            wall_s,
            stamp_s,
            len(points),
            np.array([0.0, *(point.time_s for point in remaining)]),
            np.array([q, *(point.q for point in remaining)]),
            np.array([velocity, *(point.velocity for point in remaining)]),
        )

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


def _seconds(stamp) -> float:
    """Return a Time or Duration message in s."""
    return stamp.sec + 1e-9 * stamp.nanosec


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
