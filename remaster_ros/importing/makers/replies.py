# SPDX-License-Identifier: Apache-2.0
"""Logs of a controller's replies, with times: `[10:00:05] 0,{1.0,…},GetAngle();`.

The replies of one call have the joints. Replies of other calls are text, or poses of the tool.
"""

from __future__ import annotations

import re
from collections import defaultdict

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, first_names, unexpected

_TIME = re.compile(
    r'\s*+[\[(<]?\s*+'
    r'((?:\d{4}[-/]\d\d[-/]\d\d[T ,]\s*)?\d\d:\d\d:\d\d(?:[.,]\d+)?Z?|\d{9,10}\.\d+)'
    r'\s*[\])>]?[\s:,;|-]*'
)
# Behind the time: words, the state of the call, a list, and the call.
_REPLY = re.compile(
    r'(?P<before>[^\[\]{}()\d]*)(?:(?P<state>-?\d+)\s*,\s*|\[(?P<code>\d+)\]\s*)?'
    r'[\[{(](?P<list>[^\[\]{}()]*)[\]})](?P<after>[^\[\]{}\d]*(?:\(\s*\))?[^\[\]{}\d]*)'
)
_PLACES = re.compile(r'pose|cart|tcp|coord|tool|user|flange', re.IGNORECASE)
_WORD = re.compile(r'[^\W\d_]\w*')
_SPLIT = re.compile(r'\s*[,;]\s*|\s+')
_FEWEST, _MOST = 3, 12
_SEEN = 50
_DIGITS = re.compile(r'\d+(?:\.\d+)?')


def read(text: str) -> NamedColumns | None:
    """Joints in a log of a controller's replies, with their times; None for other text.

    Replies of Cartesian poses, of errors, and other lines are left out, with notes. Raises
    InputError, with the line, for several calls with joints, or lists of other lengths or not
    of numbers.
    """
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    seen = [line for _, line in lines[:_SEEN]]
    timed = [line[match.end() :] for line in seen if (match := _TIME.match(line))]
    if 2 * len(timed) <= len(seen) or not any(
        (reply := _REPLY.fullmatch(reply_text.strip()))
        and (reply['state'] or reply['code'] or '(' in reply['after'])
        for reply_text in timed
    ):
        # A log of lists.
        return None
    found: dict[str, list[tuple[int, str, list[str]]]] = defaultdict(list)
    other_lines: list[str] = []
    failed: list[str] = []
    for number, line in lines:
        time = _TIME.match(line)
        reply_text = line[time.end() :].strip() if time else line.strip()
        reply = _REPLY.fullmatch(reply_text)
        cells = _SPLIT.split(reply['list'].strip()) if reply and reply['list'].strip() else []
        if reply is None or not time or len(cells) < _FEWEST:
            if len(_DIGITS.findall(reply_text)) >= _FEWEST:
                raise unexpected(number, line, 'a time and a list of numbers in brackets')
            (failed if reply and reply['state'] not in (None, '0') else other_lines).append(
                str(number)
            )
            continue
        if not all(map(NUMBER.fullmatch, cells)) or len(cells) > _MOST:
            raise unexpected(number, line, 'numbers alone in the brackets')
        if reply['state'] not in (None, '0'):
            raise unexpected(number, line, '0, the state of a reply that is right,')
        found[_call(reply)].append((number, time[1], cells))
    joints = {call: rows for call, rows in found.items() if not _PLACES.search(call)}
    if not joints:
        raise unexpected(*lines[0], 'replies with joints, not with poses of the tool alone,')
    if len(joints) > 1:
        call, other = [*joints][:2]
        raise unexpected(
            joints[other][0][0], other, f'{call or "one call"} in every reply with a list'
        )
    ((call, rows),) = joints.items()
    for number, _, cells in rows:
        if len(cells) != len(rows[0][2]):
            raise unexpected(number, ','.join(cells), f'{len(rows[0][2])} joints')
    notes = [f'replies of {", ".join(sorted(set(found) - {call}))} left out'] * (len(found) > 1)
    if failed:
        notes.append(
            f'line{"s" * (len(failed) > 1)} {first_names(failed)}: replies of an error, left out'
        )
    if other_lines:
        notes.append(f'{len(other_lines)} lines without a list were left out')
    return NamedColumns(
        kind=f'replies{" of " * bool(call)}{call}',
        names=('time', *(f'J{i}' for i in range(1, len(rows[0][2]) + 1))),
        rows=tuple((time.replace(',', '.'), *cells) for _, time, cells in rows),
        lines=tuple(number for number, *_ in rows),
        notes=tuple(notes),
    )


def _call(reply: re.Match[str]) -> str:
    """Name of the call in a reply: the first word behind the list, else the last before it.

    '' if there is neither.
    """
    behind = _WORD.findall(reply['after'])
    before = _WORD.findall(reply['before'])
    return behind[0] if behind else before[-1] if before else ''
