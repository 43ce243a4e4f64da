# SPDX-License-Identifier: Apache-2.0
"""The situations in which the first bridge was found to command what must not be commanded.

Each begins in the middle of a long move of a bridge process of its own, with the same figures
every time.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hostile.bench import Bench
from hostile.judge import GRACE_S, Body, Judge, Rules, after
from hostile.lines import RELIABLE
from hostile.outcomes import Outcome
from hostile.scene import HOME, begin, bench_of, demo_body
from sensor_msgs.msg import JointState

START = HOME + np.array([-1.2, 0.1, 0.2, -0.2, 0.3, 0.0, -0.4])
END = HOME + np.array([1.2, -0.1, -0.2, 0.2, -0.3, 0.0, 0.4])
"""The way between them takes some 4 s at 0.3 of the joint speeds; joint 1 is the fastest."""
ON_THE_WAY_S = 1.8
HALT_WITHIN_S = 4.0
LEFT_S = 0.8
"""So much is left of what the controller has when a situation begins."""
AS_SHIPPED = {'reaction_s': 2.0, 'stall_s': 1.0}
"""With less patience the first bridge repeats its command before late reports arrive."""


@dataclass
class Situation:
    """What was commanded in one situation.

    Attributes
    ----------
    name
        In words.
    outcome
        As of a random injection.
    after
        Numbers of the judgements that arrived after it had begun.
    """

    name: str
    outcome: Outcome
    after: list[int]

    def cells(self, rules: Rules) -> list[str]:
        """Return a row of the table: of the fastest command after it began, then the worst."""
        judged = [self.outcome.judgements[i] for i in self.after]
        fastest = max(judged, key=lambda j: j.urdf_share, default=None)

        def worst(name: str, scale: float = 1.0, form: str = '.0f') -> str:
            return format(scale * max((getattr(j, name) for j in judged), default=0.0), form)

        degree = float(np.rad2deg(1.0))
        return [
            self.name,
            f'{degree * fastest.way_rad:.1f}' if fastest else 'none',
            f'{100 * fastest.urdf_share:.0f}' if fastest else 'none',
            worst('outside_rad', degree, '.1f'),
            worst('back_rad', degree, '.1f'),
            worst('cartesian_m_s', form='.2f'),
            str(len(judged)),
            self.outcome.halted or 'no',
            '; '.join(self.outcome.wrong(rules)) or 'nothing',
        ]


def emergency_silent(bench: Bench) -> float:
    """Emergency stop, and the driver is silent."""
    now = time.monotonic()
    bench.arm.stop_by_brakes(now)
    bench.disturb(silent=True)
    time.sleep(2.0)
    return now


def emergency_while_the_process_is_paused(bench: Bench) -> float:
    """SIGSTOP, the emergency stop meanwhile, SIGCONT."""
    bench.signal(signal.SIGSTOP)
    time.sleep(0.2)
    now = time.monotonic()
    bench.arm.stop_by_brakes(now)
    time.sleep(0.9)
    bench.signal(signal.SIGCONT)
    time.sleep(2.0)
    return now


def late_then_pause(bench: Bench) -> None:
    """The lines have been late from the start; here the pause comes."""
    bench.plan_state('paused')
    time.sleep(1.0)
    bench.plan_state('running')
    time.sleep(0.5)


def one_message_wrapped_then_pause(bench: Bench) -> None:
    """One message has joint 1 off by a turn."""
    done = time.monotonic() + 5.0
    reported = []

    def turned(q: np.ndarray) -> np.ndarray:
        reported.append(time.monotonic())
        return q + 2 * np.pi * (np.arange(len(q)) == 0)

    bench.once(turned)
    while not reported and time.monotonic() < done:
        time.sleep(5e-4)
    # The message is on its way before the pause, and the next one is not there yet.
    time.sleep(0.002)
    bench.plan_state('paused')
    time.sleep(0.5)
    bench.plan_state('running')
    time.sleep(0.5)


def foreign_then_nan(bench: Bench) -> None:
    """A second publisher of garbage, then one that is no number from the robot itself."""
    rng = np.random.default_rng(7)
    publisher = bench.intruder.create_publisher(JointState, '/joint_states', RELIABLE)
    bench.until(lambda: publisher.get_subscription_count() > 0, 3.0)
    for i in range(60):
        q = rng.uniform(-50.0, 50.0, len(HOME)) if i < 59 else np.full(len(HOME), np.nan)
        publisher.publish(bench.state_message(q, np.zeros_like(q)))
        if i < 58:
            time.sleep(0.01)
    time.sleep(1.0)
    bench.intruder.destroy_publisher(publisher)


def situations() -> list[tuple[str, float, Callable[[Bench], float | None], str]]:
    """Return name, lateness of joint_states from the start (s), what is done, what is expected."""
    return [
        ('emergency stop pressed and driver silent', 0.0, emergency_silent, 'halt'),
        (
            'bridge process paused (SIGSTOP), emergency stop meanwhile',
            0.0,
            emergency_while_the_process_is_paused,
            'halt',
        ),
        *((f'joint_states {late:g} s late, then pause', late, late_then_pause, 'any')
          for late in (0.5, 1.0, 2.0)),
        (
            'one joint_states message off by 2π, then pause',
            0.0,
            one_message_wrapped_then_pause,
            'any',
        ),
        ('a second publisher on joint_states, then NaN', 0.0, foreign_then_nan, 'halt'),
    ]  # fmt: skip


def known_situations(
    folder: Path, rules: Rules, domain: int, wanted: str = ''
) -> Iterator[Situation]:
    """Run each situation (or those whose name contains `wanted`) with a bridge of its own."""
    body = demo_body()
    for number, (name, late_s, act, expected) in enumerate(situations()):
        if wanted in name:
            bench = bench_of(
                domain, folder / f'known_{number}', np.random.default_rng(1), rules, **AS_SHIPPED
            )
            try:
                yield _run(bench, body, rules, name, late_s, act, expected)
            finally:
                bench.close()


def _run(
    bench: Bench,
    body: Body,
    rules: Rules,
    name: str,
    late_s: float,
    act: Callable[[Bench], float | None],
    expected: str,
) -> Situation:
    bench.reset_arm(START)
    bench.disturb(delay_s=late_s)
    bench.start()
    bench.until(lambda: bench.seen.summaries, 30.0)
    time.sleep(3.0)
    bench.gap()
    outcome = Outcome(name, expected)
    moved = begin(bench, [END])
    # With late reports a bridge may well refuse to move at all.
    outcome.moved = moved or late_s > 0.0
    time.sleep(ON_THE_WAY_S)
    # A controller without stamps rests between steps.
    bench.until(lambda: bench.arm.ends_in(time.monotonic()) > LEFT_S, 5.0)
    since = time.monotonic()
    silent_from = act(bench)
    if expected == 'halt':
        bench.until(lambda: bench.seen.halted(since), HALT_WITHIN_S)
    outcome.halted = bench.seen.halted()
    silent_from = silent_from or (bench.seen.halt_time(0.0) if outcome.halted else None)
    bench.peace()
    # No word of a node ends a halt.
    bench.plan_state('paused')
    time.sleep(0.3)
    bench.plan_state('running')
    time.sleep(1.0)
    judge = Judge(body, rules)
    commands = bench.commands_since(0.0)
    outcome.judgements = [judge.judge(c, bench.was_running(c.arrival_s)) for c in commands]
    if silent_from is not None:
        outcome.late_commands = len(after(commands, silent_from + GRACE_S, np.inf))
    outcome.gap_s = bench.gap()
    return Situation(name, outcome, [i for i, c in enumerate(commands) if c.arrival_s > since])
