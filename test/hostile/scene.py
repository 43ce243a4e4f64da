# SPDX-License-Identifier: Apache-2.0
"""The demo cell as the hostile tests take it: its arm, and moves without obstacles."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from hostile.bench import Bench
from hostile.judge import Body, Rules
from hostile.process import environment

from remaster_ros.motion.spline import Spline
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import FloatArray

HOME = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0])
SPREAD = np.array([1.2, 0.35, 0.6, 0.5, 1.0, 0.5, 1.2])
FAST = {
    'settle_s': 0.3,
    'heartbeat_s': 1.0,
    'reaction_s': 0.8,
    'stall_s': 0.5,
    'resume_alone_s': 3.0,
}
"""Parameters of a bridge whose decisions come soon, so that a campaign gets through many."""


def demo_body() -> Body:
    """Return the arm and tool of the demo cell."""
    cell = read_cell('demo')
    points = np.array(list(cell.markers.values()), float)
    return Body(cell.urdf_text, points, cell.robot.tip_link, cell.link_radius_m)


def target(
    body: Body, start: FloatArray, rng: np.random.Generator, least_rad: float = 0.8
) -> FloatArray:
    """Draw a configuration, rad, (k,), to which the straight way from `start` is clear."""
    for _ in range(2000):
        q = HOME + SPREAD * rng.uniform(-1.0, 1.0, len(HOME))
        way = start + np.linspace(0.0, 1.0, 12)[:, None] * (q - start)
        # So far that the move lasts: something is to happen on the way.
        if np.max(np.abs(q - start)) >= least_rad and all(map(body.clear, way)):
            return q
    return HOME.copy()


def bench_of(
    domain: int,
    folder: Path,
    rng: np.random.Generator,
    rules: Rules,
    **options: object,
) -> Bench:
    """Return a bench of the demo cell; options are `Bench`'s and the bridge's parameters."""
    known = {'rate', 'clock_s', 'stamp_noise_s', 'exact', 'open_loop', 'keeps_stamps'}
    parameters = {'cell': 'demo', 'speed_share': rules.speed_share, **FAST}
    parameters['emergency_stop_topic'] = 'none'
    parameters |= {key: value for key, value in options.items() if key not in known}
    if np.isfinite(rules.cartesian_m_s):
        parameters['cartesian_speed_limit_m_s'] = rules.cartesian_m_s
    names = read_cell('demo').chain().joint_names
    folder.mkdir(parents=True, exist_ok=True)
    return Bench(
        environment(domain, folder / 'ros_home'),
        names,
        HOME,
        rng,
        parameters,
        folder / 'bridge.log',
        **{key: value for key, value in options.items() if key in known},  # type: ignore[arg-type]
    )


def curve_to(
    body: Body, start: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Draw a curve that is clear: its end, rad, (k,), and begin and places with their shares."""
    for _ in range(500):
        count = int(rng.integers(4, 7))
        steps = rng.uniform(0.15, 0.5) * SPREAD * rng.uniform(-1.0, 1.0, (count, len(HOME)))
        places = np.vstack([start, start + np.cumsum(steps, axis=0)])
        shares = np.append(0.0, np.cumsum(rng.uniform(0.7, 1.3, count)))
        shares /= shares[-1]
        way = Spline.through(places, shares).at(np.linspace(0.0, 1.0, 40))
        inside = np.all((way > 0.9 * body.lower) & (way < 0.9 * body.upper))
        is_near_home = np.all(np.abs(way - HOME) <= 1.2 * SPREAD)
        if inside and is_near_home and all(map(body.clear, way)):
            return places[-1], (places[:-1], shares[:-1])
    raise ValueError(f'no curve is clear from {start}')


def begin(
    bench: Bench,
    solutions: Sequence[FloatArray],
    timeout_s: float = 15.0,
    curve: tuple[FloatArray, FloatArray] | None = None,
) -> bool:
    """Let the planner run and send a pose; returns whether the arm moves in time."""
    if bench.planner != 'running':
        bench.plan_state('running')
    since = time.monotonic()
    bench.send(solutions, curve)

    def waited():
        # A slow probe comes first where it is not sure that the arm is where it is reported.
        ends = [command.end_s for command in bench.commands_since(since)]
        return time.monotonic() > max([since, *ends]) + timeout_s

    bench.until(lambda: moving(bench, since) or bench.seen.halted(since + 0.2) or waited(), np.inf)
    return moving(bench, since)


def moving(bench: Bench, since_s: float) -> bool:
    """Whether the arm is on its way by a command that arrived since then."""
    return bool(bench.commands_since(since_s)) and bench.arm.speed() > 0.1


ANSWER_S = 0.5
"""A stop that has not come after so long was not sent, s."""


@dataclass
class Scene:
    """One injection under way.

    Attributes
    ----------
    bench, body, rng
        Where it happens.
    solutions
        What the planner has sent, rad, (k,) each.
    left_s
        How long the arm is still to move when the injection begins, s.
    silent_from
        From when on nothing may be commanded any more; None if that depends on the halt.
    expected
        Of the bridge, where that depends on the moment; else '', and it is that of the kind.
    alone
        Commands after a wait that only a person may end.
    latencies
        Times from a request to stop to the stop's arrival, s; infinite where none came.
    note
        The figures of this injection, in words.
    after_kill_s
        How long the arm went on after its bridge was killed, s.
    """

    bench: Bench
    body: Body
    rng: np.random.Generator
    solutions: list[FloatArray]
    left_s: float
    silent_from: float | None = None
    latencies: list[float] = field(default_factory=list)
    note: str = ''
    expected: str = ''
    alone: int = 0
    after_kill_s: float = 0.0

    def wait(self, low_s: float, high_s: float) -> float:
        """Let a random time pass; returns it, s."""
        duration = float(self.rng.uniform(low_s, high_s))
        time.sleep(duration)
        return duration

    def pause(self) -> None:
        """Ask for a stop, and measure how long that takes if the arm moves."""
        bench = self.bench
        moving = bench.on_its_way()
        asked = bench.plan_state('paused')
        answered = bench.until(lambda: bench.commands_since(asked), ANSWER_S)
        if moving:
            first = bench.commands_since(asked)[0].arrival_s if answered else np.inf
            self.latencies.append(first - asked)

    def maybe_pause(self, within_s: float) -> None:
        """Ask for a stop in two of three cases, at a random moment."""
        self.wait(0.0, within_s)
        if self.rng.random() < 0.67:
            self.bench.plan_state('paused')
            self.wait(0.05, 0.4)
            self.bench.plan_state('running')

    def another_goal(self) -> FloatArray:
        """Draw another goal from where the arm is now, rad, (k,)."""
        return target(self.body, self.bench.arm.q, self.rng)

    def turn(self) -> FloatArray:
        """Return a full turn of one random joint, rad, (k,)."""
        out = np.zeros(len(self.bench.names))
        out[self.rng.integers(len(out))] = self.rng.choice([-1, 1]) * 2 * np.pi
        return out
