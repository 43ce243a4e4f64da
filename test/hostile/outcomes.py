# SPDX-License-Identifier: Apache-2.0
"""What became of the injections into a bridge: what was wrong, and tables of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from hostile.judge import Judgement, Rules, percentiles

AFTER_KILL_S = 2.0
"""An arm stands so long after its bridge was killed, s."""
STALLED_S = 0.15
"""The test's own process did not run for so long: joint states came late by it, s."""


@dataclass
class Outcome:
    """What became of one injection.

    Attributes
    ----------
    kind, expected, note
        Of the injection.
    judgements
        One for each command of the bridge.
    alone
        Commands after a long wait that no person had ended.
    late_commands
        Commands after the arm or the bridge had stopped for good.
    halted
        Reason of a halt that was shown; ''.
    moved
        The arm was on its way when the injection began.
    settled
        Where the bridge was to go on: it did, and the arm arrived.
    latencies
        From a request to stop to the stop, s.
    after_kill_s
        How long the arm went on after its bridge was killed.
    ended
        The bridge's process has ended, and was not killed.
    arm_share
        Largest joint speed of the arm itself over what is allowed.
    gap_s
        Longest time in which the test's own process published nothing.
    """

    kind: str
    expected: str
    note: str = ''
    judgements: list[Judgement] = field(default_factory=list)
    alone: int = 0
    late_commands: int = 0
    halted: str = ''
    moved: bool = True
    settled: bool = True
    latencies: list[float] = field(default_factory=list)
    arm_share: float = 0.0
    after_kill_s: float = 0.0
    ended: bool = False
    gap_s: float = 0.0

    def wrong(self, rules: Rules) -> list[str]:
        """Return everything that must not be, in words."""
        out = [f'{j.kind}: {text}' for j in self.judgements for text in j.wrong(rules)]
        if self.alone:
            out.append(f'{self.alone} commands without a person after a wait')
        if self.late_commands:
            out.append(f'{self.late_commands} commands to an arm that has been stopped')
        if self.ended:
            out.append('the node has ended')
        if self.after_kill_s > AFTER_KILL_S + self.gap_s:
            out.append(f'{self.after_kill_s:.2f} s of motion after the bridge was killed')
        if not self.moved:
            return [*out, 'the arm did not move before anything was wrong']
        if self.expected == 'halt' and not self.halted:
            out.append('not halted')
        # Where the test itself was late, joint states were: a halt is right then.
        if self.expected == 'go on' and self.gap_s < STALLED_S:
            if self.halted:
                out.append(f'halted without reason: {self.halted}')
            elif not self.settled:
                out.append('did not go on')
            if any(np.isinf(self.latencies)):
                out.append('a stop was not sent')
        return out


def table(outcomes: Sequence[Outcome], rules: Rules) -> str:
    """Return a Markdown table by kind."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.kind].append(outcome)
    header = (
        'injection', 'expected', 'runs', 'commands', 'joint speed, of what is allowed',
        'arm itself', 'm/s', 'surface m/s', 'rad/s²', 'outside, deg', 'stop off path, deg',
        'back, deg', 'beyond, deg', 'commands to a stopped arm', 'without a person', 'not halted',
        'halted without reason', 'did not go on', 'runs with anything wrong',
    )  # fmt: skip
    lines = ['| ' + ' | '.join(header) + ' |', '|' + '---|' * len(header)]
    rows = [(kind, groups[kind]) for kind in sorted(groups)] + [('all', list(outcomes))]
    for kind, group in rows:
        cells = _row(group, rules)
        expected = group[0].expected if kind != 'all' else ''
        lines.append('| ' + ' | '.join([kind, expected, *cells]) + ' |')
    return '\n'.join(lines)


def _row(outcomes: Sequence[Outcome], rules: Rules) -> list[str]:
    judged = [j for o in outcomes for j in o.judgements]

    def worst(name: str, degrees: bool = False, form: str = '.2f') -> str:
        value = max((getattr(j, name) for j in judged), default=0.0)
        return format(np.rad2deg(value) if degrees else value, form)

    def count(text: str) -> str:
        return str(sum(any(w.startswith(text) for w in o.wrong(rules)) for o in outcomes))

    return [
        str(len(outcomes)),
        str(len(judged)),
        worst('speed_ratio'),
        f'{max((o.arm_share for o in outcomes), default=0.0):.2f}',
        worst('cartesian_m_s', form='.3f'),
        worst('surface_m_s', form='.3f'),
        worst('acceleration', form='.1f'),
        *(worst(f'{name}_rad', True) for name in ('outside', 'off_path', 'back', 'beyond')),
        str(sum(o.late_commands for o in outcomes)),
        str(sum(o.alone for o in outcomes)),
        count('not halted'),
        count('halted without'),
        count('did not go on'),
        str(sum(bool(o.wrong(rules)) for o in outcomes)),
    ]


def report(outcomes: Sequence[Outcome], rules: Rules) -> str:
    """Return the table, latencies, and what was wrong, a line each."""
    latencies = [t for o in outcomes for t in o.latencies]
    found = [t for t in latencies if np.isfinite(t)]
    prompt = [t for o in outcomes if o.gap_s < 0.02 for t in o.latencies if np.isfinite(t)]
    lines = [
        table(outcomes, rules),
        f'from a request to the stop: {percentiles(found)}; '
        f'not sent: {len(latencies) - len(found)}',
        f'of these where the test itself stalled less than 20 ms: {percentiles(prompt)}',
        f'the test itself stalled beyond {STALLED_S} s in '
        f'{sum(o.gap_s >= STALLED_S for o in outcomes)} injections',
    ]
    for number, outcome in enumerate(outcomes):
        wrong = outcome.wrong(rules)
        if wrong:
            stalled = f', test stalled {outcome.gap_s:.2f} s' if outcome.gap_s > 0.05 else ''
            lines.append(f'{number}: {outcome.kind} {outcome.note}{stalled}: {"; ".join(wrong)}')
    return '\n'.join(lines)
