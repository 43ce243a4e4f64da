# SPDX-License-Identifier: Apache-2.0
"""Names of the options of ``remaster import`` as arguments of functions, in messages."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection

# Option -> argument.
_NAMES = {
    '--joints': 'joints',
    '--points': 'points',
    '--time': 'time',
    '--names': 'names',
    '--join': 'join',
    '--angles': 'angles',
    '--length': 'length',
    '--clock-offset': 'clock_offset_s',
    '--pulses-per-degree': 'pulses_per_degree',
    '--sheet': 'sheets',
    '--couple': 'couple',
    '--reverse': 'reverse',
    '--offset': 'offset_deg',
    '--never-mastered': 'never_mastered',
    '--base-link': 'base_link',
    '--tip-link': 'tip_link',
}
_LISTS = ('--joints', '--points', '--reverse', '--sheet', '--pulses-per-degree')
_MAPPINGS = ('--couple', '--offset')
_OPTION = re.compile(r'--[a-z]+(?:-[a-z]+)*')
# An option with its value in a sentence.
_VALUE = re.compile(
    r'(--join|--angles|--length|--time) (name|time|order|deg|rad|gon|mm|cm|m|none)\b'
)
# Remedy for a function that joins data frames.
_BY_ORDER = 'take the index off both (reset_index(drop=True))'
_LEFT_OUT = '; to write it as it is, add --unchecked'


def in_python(sentence: str, arguments: Collection[str]) -> str:
    """Message of ``remaster import`` with its options replaced by a Python function's arguments.

    ``--angles deg`` becomes ``angles='deg'``. `arguments`: those that the function has; other
    options become ``remaster import --option``. The advice to add --unchecked is taken out.
    """
    if 'join' not in arguments:
        sentence = sentence.replace('say --join order', _BY_ORDER)
    sentence = _VALUE.sub(
        lambda m: f'{_NAMES[m[1]]}={m[2]!r}' if _NAMES[m[1]] in arguments else m[0],
        sentence.replace(_LEFT_OUT, ''),
    )

    def named(option: re.Match[str]) -> str:
        name = _NAMES.get(option[0], '')
        return name if name in arguments else f'remaster import {option[0]}'

    return _OPTION.sub(named, sentence)


def remedy(options: str, arguments: Collection[str]) -> str:
    """Options of ``remaster import``, with values, as arguments of a Python function; '' for ''.

    `options`: text such as ``--couple A3=A2``, which becomes ``couple={'A3': 'A2'}``. Options
    that are not among `arguments` are written as ``remaster import --option value``.
    """
    words = shlex.split(options)
    found: dict[str, list[str]] = {}
    for word in words:
        option, sign, value = word.partition('=') if word.startswith('--') else ('', '', word)
        if option:
            found.setdefault(option, []).extend([value] if sign else [])
        elif found:
            found[[*found][-1]].append(value)
    parts = []
    for option, values in found.items():
        name = _NAMES.get(option, '')
        if name not in arguments:
            parts.append(f'remaster import {option} {" ".join(values)}'.strip())
        elif option in _MAPPINGS:
            pairs = dict(value.split('=', 1) for value in values)
            shown = pairs if option == '--couple' else {k: float(v) for k, v in pairs.items()}
            parts.append(f'{name}={shown}')
        elif option in _LISTS:
            parts.append(f'{name}={",".join(values).split(",")}')
        else:
            parts.append(f'{name}={values[0]!r}' if values else f'{name}=True')
    return ', '.join(parts)
