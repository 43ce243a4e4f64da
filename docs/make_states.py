# SPDX-License-Identifier: Apache-2.0
"""Write the states of the bridge into docs/safety.md, from the tables that it keeps to."""

from __future__ import annotations

from pathlib import Path

from remaster_ros.motion.states import ARM, Arm, Event, Then

PAGE = Path(__file__).parent / 'safety.md'
BEGIN, END = '<!-- states: written by make docs -->', '<!-- end of states -->'
LEAVES = {
    'CheckPath': 'check',
    'Drive': '**a move**',
    'Renew': '**its next piece**',
    'Stop': '**a stop**',
    'Settled': 'settled',
    'Failed': 'failed',
    'Halted': 'told',
}
"""What leaves the supervisor, as the page calls it; in bold what is published to a controller."""


def drawing() -> str:
    """Return the ways between the states of an arm that nothing halts, as a diagram."""
    ways = {
        (state, then.state): None
        for state, rows in ARM.items()
        for then in rows.values()
        if then.state is not state and not {state, then.state} & {Arm.HALTS, Arm.HALTED}
    }
    lines = [f'    {state} --> {then}' for state, then in ways]
    return '\n'.join(['```mermaid', 'stateDiagram-v2', f'    [*] --> {Arm.STANDS}', *lines, '```'])


def table() -> str:
    """Return each event with the states in which it can happen, and what follows there."""
    lines = ['| event | state → next state: what leaves the bridge |', '|---|---|']
    for event in Event:
        states: dict[str, list[Arm]] = {}
        for state, rows in ARM.items():
            if event in rows:
                states.setdefault(_outcome(state, rows[event]), []).append(state)
        if states:
            cells = (f'{", ".join(from_)} {outcome}' for outcome, from_ in states.items())
            lines.append(f'| {event} | {"; ".join(cells)} |')
    return '\n'.join(lines)


def states() -> str:
    """Return the part of the page."""
    return '\n\n'.join((drawing(), table()))


def page(text: str) -> str:
    """Return the page with the part written anew."""
    before, rest = text.split(BEGIN)
    return f'{before}{BEGIN}\n\n{states()}\n\n{END}{rest.split(END)[1]}'


def _outcome(state: Arm, then: Then) -> str:
    out = ', '.join(LEAVES[action.__name__] for action in then.actions)
    where = 'stay' if then.state is state else f'→ {then.state}'
    return f'{where}: {out}' if out else where


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
