# SPDX-License-Identifier: Apache-2.0
"""Write the states of the bridge into docs/safety.md, from the tables that it keeps to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
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
    """Return what an arm does when nothing halts it, as a diagram."""
    ways: dict[tuple[Arm, Arm], list[str]] = {}
    for state, rows in ARM.items():
        for event, then in rows.items():
            if then.state is not state and not {state, then.state} & {Arm.HALTS, Arm.HALTED}:
                ways.setdefault((state, then.state), []).append(event)
    lines = [
        f'    {state} --> {then}: {" / ".join(events)}' for (state, then), events in ways.items()
    ]
    return '\n'.join(['```mermaid', 'stateDiagram-v2', f'    [*] --> {Arm.STANDS}', *lines, '```'])


def table(events: Sequence[StrEnum], cells: Mapping[StrEnum, Mapping[StrEnum, str]]) -> str:
    """Return what follows from each event (rows) in each state (columns)."""
    lines = [
        f'| | {" | ".join(cells)} |',
        '|---|' + '---|' * len(cells),
        *(
            f'| {event} | {" | ".join(rows.get(event, "") for rows in cells.values())} |'
            for event in events
        ),
    ]
    return '\n'.join(lines)


def states() -> str:
    """Return the part of the page."""
    arm = {
        state: {event: _cell(state, then) for event, then in rows.items()}
        for state, rows in ARM.items()
    }
    words = [event for event in Event if any(event in rows for rows in ARM.values())]
    return '\n\n'.join((drawing(), table(words, arm)))


def page(text: str) -> str:
    """Return the page with the part written anew."""
    before, rest = text.split(BEGIN)
    return f'{before}{BEGIN}\n\n{states()}\n\n{END}{rest.split(END)[1]}'


def _cell(state: Arm, then: Then) -> str:
    out = ', '.join(LEAVES[action.__name__] for action in then.actions)
    where = 'stays' if then.state is state else str(then.state)
    return f'{where}: {out}' if out else where


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
