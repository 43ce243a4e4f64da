"""The whole loop in one process and in stepped time, to spoil one part of it at a time.

The rules of the bridge, the pairing and the plausibility are the product's own; the arm is the
fake one, and so are its faults. What stands in for planner and recorder says what they would say,
unless the fault under test keeps it from doing so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remaster_ros.core import transforms
from remaster_ros.core.motion import MotionLimits
from remaster_ros.core.pairing import PairedReading, Pairing, Rejection, SensorRules
from remaster_ros.core.plausibility import Plausibility
from remaster_ros.core.presence import Presence
from remaster_ros.core.settling import SettleRules
from remaster_ros.core.tour import nearest_solution
from remaster_ros.core.types import MarkerReading
from remaster_ros.core.visiting import (
    PROBE,
    Drive,
    Failed,
    Halted,
    Settled,
    Stop,
    Visitor,
    VisitRules,
)
from remaster_ros.fakes import faults
from remaster_ros.fakes.robot import FakeArm, TrajectoryPoint
from remaster_ros.fakes.setup import make_world
from remaster_ros.fakes.world import World
from remaster_ros.storage.cell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
STEP_S = 0.05
NODES = ('pose_planner', 'robot_bridge', 'recorder', 'optitrack_markers', 'laser_tracker_markers')
SENSOR_OF = {'optitrack_markers': 'mocap', 'laser_tracker_markers': 'tracker'}
RULES = VisitRules(settle=SettleRules(settle_s=1.0), arrive_timeout_s=6.0, answer_timeout_s=30.0)
SENSORS = (
    SensorRules('mocap', 'sir', dwell_s=0.5, min_samples=5, timeout_s=3.0),
    SensorRules('tracker', 'smr', single_shot=True, timeout_s=8.0),
)
TURNS = np.array([[0.1, 0.0, 0.0, -0.1, 0, 0, 0.2], [-0.1, 0.05, 0, 0.1, 0.1, 0, 0], [0.0] * 7])


class SteppedWorld(World):
    """A World whose time the test sets."""

    time_s = 100.0

    def now(self) -> float:
        return self.time_s


@dataclass
class Node:
    """A node under test: what kind of fault it has while `faulty`."""

    name: str = ''
    kind: str = ''
    faulty: bool = False


class Bench:
    """One run over three configurations.

    Attributes
    ----------
    reasons
        Everything that was said about it, each once, in its order.
    recorded
        Solution -> sensor -> the accepted reading.
    """

    def __init__(self, folder: Path, seed: int = 1, require: str = 'all') -> None:
        made = make_world(folder / 'world', CELL, seed, 1.0)
        self.world = SteppedWorld.open(made.folder)
        made.close()
        self.rng = np.random.default_rng(seed)
        self.arm = FakeArm(self.world, np.random.default_rng(seed + 1))
        self.limits = MotionLimits.of(CHAIN, 0.1)
        self.node, self.require = Node(), require
        self.visitor = Visitor(self.limits, RULES)
        self.presence = Presence(SENSOR_OF.values(), 3.0)
        markers = {name: np.array(place) for name, place in CELL.markers.items()}
        self.plausibility = Plausibility(CHAIN, markers)
        self.state, self.said = 'running', dict.fromkeys(NODES, -np.inf)
        self.solutions = self.world.start_q + TURNS
        self.open = set(range(len(TURNS)))
        self.planned, self.sent = False, self.solutions
        self.pairing: Pairing | None = None
        self.taking, self.settled_s = -1, 0.0
        self.late: list[tuple[float, Callable[[], object]]] = []
        self.last_reading: dict[str, np.ndarray] = {}
        self.reasons: list[str] = []
        self.recorded: dict[int, dict[str, PairedReading]] = {}
        self.gave_up: set[int] = set()
        self.commands: list[np.ndarray] = []

    # Time

    @property
    def t(self) -> float:
        return self.world.time_s

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        """Go on; returns whether `until` came true."""
        end = self.t + seconds
        while self.t < end:
            self.step()
            if until():
                return True
        return False

    def step(self) -> None:
        self.world.time_s += STEP_S
        due = [what for when, what in self.late if when <= self.t]
        self.late = [(when, what) for when, what in self.late if when > self.t]
        for what in due:
            what()
        self._speak()
        state = self.arm.joint_state()
        if state is not None:
            self._report(*state)
        self._sense()
        if self._alive('robot_bridge'):
            self.do(self.visitor.tick(self.t))
            blocked = self.visitor.blocked(self.t)
            # Before the first configuration everybody is only just coming up.
            if blocked and self.recorded and self.state == 'running':
                self.note(blocked)

    def is_faulty(self, name: str, *kinds: str) -> bool:
        return self.node.faulty and self.node.name == name and self.node.kind in kinds

    def _alive(self, name: str) -> bool:
        node = self.node
        if not node.faulty or node.name != name:
            return True
        if node.kind == 'intermittent':
            return not faults.is_out(4.0, self.t)
        return node.kind not in ('off', 'stuck', 'restarted')

    def _due(self, name: str) -> bool:
        every_s = 2.0 if self.is_faulty(name, 'slow') else 0.5
        if not self._alive(name) or self.t - self.said[name] < every_s:
            return False
        self.said[name] = self.t
        return True

    def _send(self, name: str, what: Callable[[], object]) -> None:
        """Deliver a word of a node, late where that is its fault."""
        if self.is_faulty(name, 'delayed'):
            self.late.append((self.t + 1.5, what))
        else:
            what()

    # Planner and recorder

    def _speak(self) -> None:
        bridge = self._alive('robot_bridge')
        if self._due('pose_planner') and bridge:
            state = self.state
            self._send('pose_planner', lambda: self.do(self.visitor.planner_says(state, self.t)))
            if not self.planned:
                self.planned = True
                self.plan(self.solutions)
        for node, sensor in SENSOR_OF.items():
            if self._due(node):
                self._send(node, lambda s=sensor: self.presence.says(s, True, '', self.t))
        if self._due('recorder') and bridge:
            absent = {
                name: why
                for name, why in self.presence.absent(self.t).items()
                if self.require in ('all', name)
            }
            word = '; '.join(f'{name}: {why}' for name, why in absent.items())
            if word:
                self.note(f'waiting for {word}')
            self._send('recorder', lambda: self.do(self.visitor.recorder_says(word, self.t)))

    def plan(self, solutions: np.ndarray) -> None:
        def deliver() -> None:
            self.sent = solutions
            self.do(self.visitor.plan(solutions, self.t))

        self._send('pose_planner', deliver)

    def announce_again(self) -> None:
        """What is left of the pose, as the planner does when bridge or recorder has lost it."""
        self.plan(self.solutions[sorted(self.open)])

    def _which(self, solution: int) -> int:
        """The number in the whole pose of a solution that was announced."""
        return int(np.argmin(np.max(np.abs(self.solutions - self.sent[solution]), axis=1)))

    def _report(self, stamp: float, names: list[str], q: np.ndarray, v: np.ndarray) -> None:
        missing = [name for name in CHAIN.joint_names if name not in names]
        if self._alive('robot_bridge'):
            if missing:
                self.do(self.visitor.unreadable(f'joint_states lacks {missing[0]}', self.t))
            else:
                q = q[[names.index(name) for name in CHAIN.joint_names]]
                self.do(self.visitor.report(stamp, q, self.t))
        if self.pairing is not None and not missing and self._alive('recorder'):
            self.pairing.add_joint_state(stamp, q)
            self.pairing.give_up(stamp, self.presence.absent(self.t))

    def _sense(self) -> None:
        """Readings of both sensors, as their nodes would publish them."""
        for node, name in SENSOR_OF.items():
            # Only while somebody listens: what a sensor sees is dear to compute.
            waits_s = self.t - self.settled_s
            if self.pairing is None or (name == 'tracker' and waits_s <= 1.0):
                continue
            if self.is_faulty(node, 'slow') and round(self.t / STEP_S) % 10:
                continue
            if not self._alive(node) or not self.world.line_of_sight(name, self.t):
                continue
            place = self.world.marker_in_sensor(name, self.t) + self.rng.normal(0, 3e-5, 3)
            if self.is_faulty(node, 'wrong', 'garbage', 'stray', 'frozen'):
                place = self._spoil(node, name, place)
            else:
                self.last_reading[name] = place
            reading = MarkerReading(self.t, place)
            self._send(node, lambda n=name, r=reading: self._read(n, r))
        pairing = self.pairing
        if pairing is not None and pairing.complete and self._alive('recorder'):
            self._finish(pairing)

    def _spoil(self, node: str, name: str, place: np.ndarray) -> np.ndarray:
        kind = self.node.kind
        if kind == 'garbage':
            return place * np.nan
        if kind == 'wrong':
            return place + np.array([0.2, 0, 0])
        # A stray that stands where the marker was last seen, or that reading again and again.
        stands = self.last_reading[name]
        return stands + (self.rng.normal(0, 3e-5, 3) if kind == 'stray' else 0.0)

    def _read(self, name: str, reading: MarkerReading) -> None:
        if not np.all(np.isfinite(reading.position)):
            self.note(f'{name}: readings that are not finite are dropped')
        elif self.pairing is not None and self._alive('recorder'):
            self.pairing.add_reading(name, reading)

    def _finish(self, pairing: Pairing) -> None:
        pairing.finish()
        good = {}
        for name, item in pairing.decided.items():
            T_R_N = self.world.truth.sensors[name].T_R_N
            item = (
                self.plausibility.judge(item, T_R_N) if isinstance(item, PairedReading) else item
            )
            if isinstance(item, Rejection):
                self.note(f'{name}: {item.reason}: {item.detail}')
            else:
                good[name] = item
        solution, self.pairing = self.taking, None
        which = self._which(solution)
        assert which not in self.recorded, 'recorded twice'
        self.recorded[which] = good
        self.open.discard(which)
        self.answer(solution)

    def answer(self, solution: int) -> None:
        if self.is_faulty('recorder', 'wrong'):
            solution = 7
        wait_s = {'slow': 5.0, 'delayed': 40.0}.get(self.node.kind, 0.0)
        if self.node.name == 'recorder' and self.node.faulty and wait_s:
            self.late.append(
                (self.t + wait_s, lambda: self.do(self.visitor.answered(solution, self.t)))
            )
        elif not self.is_faulty('recorder', 'garbage'):
            self.do(self.visitor.answered(solution, self.t))

    # What the bridge does

    def do(self, actions: list) -> None:
        for action in actions:
            match action:
                case Drive(solution, waypoints):
                    assert solution == PROBE or not self.visitor.blocked(self.t)
                    self.command(waypoints)
                case Stop(waypoint, reason):
                    self.note(reason)
                    self.command((waypoint,))
                case Settled(solution, stamp_s, q):
                    if self._alive('recorder'):
                        self._take(solution, stamp_s, q)
                case Failed(solution, reason):
                    self.note(reason)
                    if 'outside its limits' not in reason:
                        which = self._which(solution)
                        self.gave_up |= {which} - set(self.recorded)
                        self.open.discard(which)
                case Halted(reason):
                    self.note(reason)
                    self.state = 'paused'

    def _take(self, solution: int, stamp_s: float, q: np.ndarray) -> None:
        if nearest_solution(self.solutions, q) is None:
            self.note('settled at no joint solution of the announced pose')
            return
        self.taking, self.settled_s = solution, self.t
        self.pairing = Pairing(stamp_s, q, SENSORS, require=self.require)

    def command(self, waypoints: tuple) -> None:
        points = [TrajectoryPoint(p.time_s, list(p.q), list(p.velocity)) for p in waypoints]
        for point in waypoints:
            self.commands.append(point.q)
        self.arm.command(CHAIN.joint_names, points)

    def note(self, reason: str) -> None:
        if reason not in self.reasons:
            self.reasons.append(reason)

    # What must hold whatever happens

    def done(self) -> bool:
        return not self.open and self.pairing is None

    def inject(self, **numbers: float) -> None:
        faults.inject(self.world.folder, {'robot': numbers})

    def speed(self) -> float:
        return self.world.joint_speed(self.t)

    def check(self) -> None:
        """No wrong observation, no command outside the limits."""
        for q in self.commands:
            assert self.limits.outside(q) == ''
        truth = self.world.truth
        for readings in self.recorded.values():
            for name, reading in readings.items():
                sensor = truth.sensors[name]
                marker_R = CHAIN.positions(reading.q, sensor.marker, truth.joint_offsets)
                expected = transforms.apply(transforms.inverse(sensor.T_R_N), marker_R)
                assert np.linalg.norm(reading.position - expected) < 1e-3, name

    def close(self) -> None:
        self.world.close()
