# SPDX-License-Identifier: Apache-2.0
"""Many injections at random moments, several in the life of one bridge.

Expected of an injection is `halt`, `go on` (a control, or something that must not disturb) or
`any` (both are right; what is commanded is judged as always).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import Queue, get_context
from pathlib import Path

import numpy as np
from hostile.bench import Bench
from hostile.injections import (
    a_little_late,
    another_robots_joints,
    bridge_killed,
    clock_set_back,
    command_doubled,
    commands_late,
    commands_lost,
    control,
    doubled_states,
    early_stamps,
    emergency,
    emergency_driver_silent,
    emergency_in_a_wait,
    emergency_released,
    emergency_topic,
    emergency_topic_blinks,
    emergency_while_braking,
    emergency_while_measuring,
    emergency_while_paused,
    foreign_commands,
    foreign_garbage,
    foreign_states,
    frozen_states,
    gripper_beside,
    hostile_values,
    killed_while_halted,
    late_from_the_start,
    late_states,
    limit_raised,
    long_wait,
    lost_states,
    named_twice,
    nan_once,
    nan_states,
    pauses,
    planner_silent,
    pose_taken_back,
    process_killed,
    process_paused,
    process_paused_emergency,
    recorder_silent,
    reordered_states,
    restart,
    sensor_missing,
    short_silence,
    silence,
    somewhat_late,
    stopped_stamps,
    stopped_while_it_rests,
    wrapped,
    wrapped_once,
)
from hostile.judge import GRACE_S, Body, Judge, Rules, after
from hostile.lines import EMERGENCY
from hostile.outcomes import Outcome
from hostile.scene import HOME, Scene, begin, bench_of, curve_to, demo_body, target

from remaster_ros.collection.events import SolutionFailed
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class Injection:
    """A kind: what is done, what the bridge has to do, and how often it is drawn.

    ``topic`` says whether the robot must, or must not, report its safety circuit.
    """

    act: Callable[[Scene], None]
    expected: str
    weight: float = 1.0
    topic: bool | None = None

    @property
    def name(self) -> str:
        """Its name in tables."""
        return self.act.__name__.replace('_', ' ')


INJECTIONS = (
    *(Injection(act, 'go on') for act in (control, planner_silent, recorder_silent)),
    *(Injection(act, 'go on') for act in (sensor_missing, lost_states, short_silence)),
    *(Injection(act, 'go on') for act in (a_little_late, command_doubled, pose_taken_back)),
    Injection(pauses, 'go on', 3.0),
    # Where the move before it was long, a person goes on after it.
    *(Injection(act, 'any', 0.5) for act in (process_killed, bridge_killed)),
    Injection(hostile_values, 'any'),
    *(Injection(act, 'halt', 1.5) for act in (emergency, emergency_driver_silent)),
    *(Injection(act, 'halt') for act in (emergency_released, emergency_while_measuring)),
    *(Injection(act, 'halt') for act in (emergency_while_paused, process_paused_emergency)),
    Injection(killed_while_halted, 'halt', 0.5),
    *(Injection(act, 'halt') for act in (late_states, silence, wrapped, nan_states)),
    *(Injection(act, 'halt') for act in (frozen_states, stopped_stamps)),
    *(Injection(act, 'halt') for act in (foreign_states, foreign_garbage, foreign_commands)),
    *(Injection(act, 'halt') for act in (named_twice, another_robots_joints)),
    *(Injection(act, 'go on') for act in (gripper_beside, limit_raised)),
    Injection(late_from_the_start, 'any', 0.5),
    *(Injection(act, 'any') for act in (process_paused, somewhat_late, early_stamps)),
    *(Injection(act, 'any') for act in (clock_set_back, doubled_states, reordered_states)),
    *(Injection(act, 'any') for act in (wrapped_once, nan_once, commands_late, commands_lost)),
)
WITH_TOPIC = (
    Injection(emergency_topic, 'halt', 1.5, topic=True),
    Injection(emergency_topic_blinks, 'halt', topic=True),
    Injection(long_wait, 'go on', topic=True),
)
"""Where the bridge has an emergency_stop_topic."""
WITHOUT_TOPIC = (
    Injection(emergency_in_a_wait, 'any', 2.0, topic=False),
    Injection(stopped_while_it_rests, 'any', 2.0, topic=False),
    Injection(emergency_while_braking, 'halt', 3.0, topic=False),
)
"""And where it has none."""


HALT_WITHIN_S = 4.0
"""A halt not shown so long after the injection was not made, s: see `hostile.scene.FAST`."""

BEGUN_S = 4.0
"""A bridge has been up for so long before a collection is begun, s: it may hear the planner 2 s
late here, and takes a run of which it hears within `interlocks.KNOWN_S` of that for an old one."""
CURVE_S = 4.0
"""Something happens within so much of a curve, of which each takes longer, s."""
ANEW = 0.8
"""How often a bridge is started again after a halt, in place of a slow probe of half a minute."""


class Campaign:
    """Random injections into one bridge after the other.

    Parameters
    ----------
    seed
        Of all randomness.
    domain
        DDS domain.
    folder
        Logs and the bridges' ROS_HOME.
    body, rules
        What the judge takes for the truth.
    injections
        Kinds to draw from; all of them by default.
    per_process
        Injections in the life of a bridge (it is also restarted where an injection kills it).
    curves
        Whether the arm moves on curves, by a controller that keeps stamps.
    """

    def __init__(
        self,
        seed: int,
        domain: int,
        folder: Path,
        body: Body,
        rules: Rules,
        injections: Iterable[Injection] = (),
        per_process: int = 20,
        curves: bool = False,
    ) -> None:
        self.seed, self.domain, self.folder = seed, domain, folder
        self.body, self.rules = body, rules
        self.injections, self.per_process = tuple(injections), per_process
        self.curves = curves
        self.rng = np.random.default_rng(seed)
        self.outcomes: list[Outcome] = []
        self._bench: Bench | None = None
        self._has_topic = True
        self._life = 0

    # Running

    def run(self, count: int, deadline_s: float = np.inf) -> list[Outcome]:
        """Make so many injections, or as many as fit into the time; returns their outcomes."""
        try:
            for kind in self._draw(count):
                if time.monotonic() > deadline_s:
                    break
                topic = self._has_topic if kind.topic is None else kind.topic
                if self._bench is not None and topic != self._has_topic:
                    self._bench.close()
                    self._bench = None
                if self._bench is None:
                    self._bench = self._open(topic)
                outcome = self._inject(self._bench, kind)
                self.outcomes.append(outcome)
                lost = not outcome.moved or not self._recover(self._bench)
                if lost or len(self.outcomes) % self.per_process == 0:
                    self._bench.close()
                    self._bench = None
        finally:
            if self._bench is not None:
                self._bench.close()
                self._bench = None
        return self.outcomes

    def _draw(self, count: int) -> Iterable[Injection]:
        """Every kind in turn while that is fair, the rest by weight."""
        kinds = self.injections or INJECTIONS + WITH_TOPIC + WITHOUT_TOPIC
        weights = np.array([kind.weight for kind in kinds])
        shares = weights / weights.sum() * count
        fixed_kinds = [kind for kind, share in zip(kinds, shares) for _ in range(int(share))]
        extra_indices = self.rng.choice(
            len(kinds), count - len(fixed_kinds), p=weights / weights.sum()
        )
        drawn = [*fixed_kinds, *(kinds[i] for i in extra_indices)]
        self.rng.shuffle(drawn)  # type: ignore[arg-type]
        # Another bridge is started for the other half.
        return sorted(drawn, key=lambda kind: kind.topic is False)

    def _open(self, topic: bool) -> Bench:
        rng = self.rng
        self._life += 1
        self._has_topic = topic
        bench = bench_of(
            self.domain,
            self.folder / f'life_{self.seed}_{self._life}',
            # Its own: its threads draw at times that nothing repeats.
            np.random.default_rng(rng.integers(2**32)),
            self.rules,
            rate=float(rng.choice([50.0, 100.0, 250.0])),
            # By the stamps of another clock no curve is gone.
            clock_s=float(rng.choice([0.0, 0.0, 37.2, -12.5])) * (not self.curves),
            stamp_noise_s=float(rng.choice([0.0, 0.0, 2e-4])),
            exact=bool(rng.random() < 0.3),
            open_loop=bool(rng.random() < 0.3),
            # A controller that keeps the stamps of trajectories, or one that begins at once.
            keeps_stamps=(kept := bool(self.curves or rng.random() < 0.5)),
            trajectory_stamps='kept' if kept else 'ignored',
            **({'emergency_stop_topic': EMERGENCY} if topic else {}),
        )
        bench.emergency_shown = False if topic else None
        bench.start()
        bench.until(lambda: bench.seen.summaries, 30.0)
        return bench

    def _inject(self, bench: Bench, kind: Injection) -> Outcome:
        rng, judge = self.rng, Judge(self.body, self.rules)
        outcome = Outcome(kind.name, kind.expected)
        began = time.monotonic()
        begun = [began]
        bench.gap()
        bench.up_for(BEGUN_S)
        goals, outcome.moved = self._begin(bench)
        if not outcome.moved and self._recover(bench):
            # What the last injection left behind may halt the bridge after everything was made
            # right again, and a bridge that has just been started may ask for another
            # /remaster/collect. A person does both.
            bench.up_for(BEGUN_S)
            begun.append(time.monotonic())
            goals, outcome.moved = self._begin(bench)
        settled = len(bench.seen.settled)
        newest = bench.commands_since(began)
        remaining_s = max(newest[-1].end_s - time.monotonic(), 0.0) if newest else 0.0
        scene = Scene(bench, self.body, rng, goals, remaining_s)
        if outcome.moved:
            scene.left_s -= scene.wait(0.0, CURVE_S if self.curves else 0.55 * remaining_s)
            self._act(kind, scene, outcome, settled)
        else:
            # Why not, in the bridge's own words.
            failed = [
                event.reason
                for t, event in bench.seen.events
                if t > began and isinstance(event, SolutionFailed)
            ]
            scene.note = '; '.join(
                [*failed[-2:], *(text for _, text, _ in bench.seen.summaries[-1:])]
            )
        arm = bench.arm
        options = [f'{1 / bench.period_s:.0f} Hz', *(('exact',) if arm.exact else ())]
        options += ['open loop'] if arm.open_loop else []
        outcome.note = f'({", ".join(options)}) {scene.note}'.strip()
        outcome.latencies = scene.latencies
        outcome.gap_s = bench.gap()
        outcome.arm_share = bench.arm.fastest(began, self.rules.speed_share * self.body.velocity)
        for since, until in pairwise([*begun, np.inf]):
            # Of what was commanded before, a new beginning knows nothing.
            judge.forget()
            outcome.judgements += [
                judge.judge(command, bench.was_running(command.arrival_s))
                for command in after(bench.commands_since(began), since, until)
            ]
        return outcome

    def _begin(self, bench: Bench) -> tuple[list[FloatArray], bool]:
        """Send the arm to a random goal; the solutions that were sent, and whether it moves."""
        if not self.curves:
            goals = [target(self.body, bench.arm.q, self.rng)]
            return goals, begin(bench, goals)
        goal, curve = curve_to(self.body, bench.arm.q, self.rng)
        return [goal], begin(bench, [goal], curve=curve)

    def _act(self, kind: Injection, scene: Scene, outcome: Outcome, settled: int) -> None:
        bench, since = scene.bench, time.monotonic()
        kind.act(scene)
        outcome.expected, outcome.alone = scene.expected or kind.expected, scene.alone
        outcome.after_kill_s = scene.after_kill_s
        ended = bench.process is None or bench.process.poll() is not None
        outcome.ended = ended
        shown_from = since if scene.note != 'restarted' else time.monotonic() - 0.5
        if outcome.expected == 'halt':
            bench.until(lambda: bench.seen.halted(shown_from), HALT_WITHIN_S)
        elif outcome.expected == 'go on':
            bench.until(
                lambda: bench.seen.halted(since) or len(bench.seen.settled) > settled, 12.0
            )
            outcome.settled = len(bench.seen.settled) > settled
        else:
            time.sleep(1.0)
        outcome.halted = bench.seen.halted(shown_from)
        if outcome.expected == 'halt' and not outcome.halted and bench.seen.summaries:
            _, text, values = bench.seen.summaries[-1]
            scene.note += f'; {bench.planner}; {text}; {values}'
        silent_from = scene.silent_from
        if outcome.halted:
            silent_from = silent_from or bench.seen.halt_time(shown_from)
            # No message of a node ends a halt.
            bench.plan_state('paused')
            time.sleep(0.15)
            bench.plan_state('running')
            time.sleep(0.5)
        if silent_from is not None:
            late = after(bench.commands_since(since), silent_from + GRACE_S, np.inf)
            outcome.late_commands = len(late)

    def _recover(self, bench: Bench) -> bool:
        """Make everything right again, as a person would; returns whether it could be."""
        bench.peace()
        bench.answers = True
        bench.plan_state('stopped')
        bench.send([])
        time.sleep(0.4)
        q = bench.arm.q
        low, high = self.body.lower, self.body.upper
        if bool(np.any((q < low) | (q > high))) or not self.body.clear(q):
            bench.kill()
            bench.reset_arm(HOME)
            restart(bench)
        if not bench.until(lambda: bench.arm.speed() < 1e-3, 10.0):
            return False
        if bench.seen.halted():
            if bench.clear_halt() is False:
                return False
            if self.rng.random() < ANEW:
                # Led to where it is by hand, and the bridge begun anew.
                bench.kill()
                bench.reset_arm(bench.arm.q)
                restart(bench)
            # Only a collection that is begun after that goes on.
            bench.plan_state('stopped')
            time.sleep(0.1)
        bench.arm.history.clear()
        return bench.process is not None and bench.process.poll() is None


_domain = 0


def _take_domain(domains: Queue[int]) -> None:
    global _domain
    _domain = domains.get()


def _chunk(work: tuple[int, int, Path, Rules, float, bool]) -> tuple[list[Outcome], str]:
    seed, count, folder, rules, deadline_s, curves = work
    campaign = Campaign(seed, _domain, folder, demo_body(), rules, curves=curves)
    try:
        return campaign.run(count, deadline_s), ''
    except Exception as error:  # A bridge that never starts must not end the others' work.
        return campaign.outcomes, f'seed {seed}: {type(error).__name__}: {error}'


def in_parallel(
    seed: int,
    count: int,
    folder: Path,
    rules: Rules,
    domains: Iterable[int],
    deadline_s: float = np.inf,
    chunk: int = 20,
    curves: bool = False,
) -> Iterator[tuple[list[Outcome], str]]:
    """Make `count` injections with one process per DDS domain; yields outcomes as they come.

    Each chunk is a `Campaign` of its own with a seed from `seed`. The second value tells what
    broke the test itself; '' if nothing.
    """
    domains = list(domains)
    context = get_context('spawn')
    queue = context.Queue()
    for domain in domains:
        queue.put(domain)
    sizes = [min(chunk, count - first) for first in range(0, count, chunk)]
    seeds = np.random.SeedSequence(seed).generate_state(len(sizes))
    work = [(int(s), n, folder, rules, deadline_s, curves) for s, n in zip(seeds, sizes)]
    with context.Pool(len(domains), _take_domain, (queue,)) as pool:
        yield from pool.imap_unordered(_chunk, work)
