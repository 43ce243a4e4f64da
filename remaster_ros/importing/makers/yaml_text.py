# SPDX-License-Identifier: Apache-2.0
"""YAML: samples of hand-eye calibrations (MoveIt, easy_handeye2), messages that ROS prints."""

from __future__ import annotations

import re
from typing import Any

import yaml

from remaster_ros.errors import InputError
from remaster_ros.importing.makers import records
from remaster_ros.importing.makers.named import NamedColumns, unexpected

_START = re.compile(
    r'(?:[^\S\n]*(?:#[^\n]*)?\n|%YAML[^\n]*\n|---[^\n]*\n)*(?:- ?|[A-Za-z_]\w*:(?:\s|$))'
)
# A line of nested data: an item, a document, or an indented key.
_NESTED = re.compile(r'[ ]*-(?:\s.*)?|---.*|[ ]+[A-Za-z_]\w*:(?:\s.*)?|[A-Za-z_]\w*:\s*')
_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_SEEN, _SHARE = 50, 0.7


def read(text: str) -> NamedColumns | None:
    """Records of YAML; None for text of which most lines are not nested YAML.

    Raises InputError, with the line, for damaged YAML, a key given twice, records of unequal
    keys, or nested YAML without a list of records.
    """
    if not _START.match(text):
        return None
    lines = [line for line in text.splitlines() if line.strip()]
    for part in (lines[:_SEEN], lines[-_SEEN:]):
        # A table with keys above it is none.
        if sum(map(bool, map(_NESTED.fullmatch, part))) < _SHARE * len(part):
            return None
    try:
        documents = [
            _plain(node, [len(text)], 0)
            for node in yaml.compose_all(
                text, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
            )
        ]
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        number = mark.line + 1 if mark else 1
        line = [*text.split('\n'), ''][number - 1] if number <= text.count('\n') + 1 else ''
        raise unexpected(number, line, f'YAML ({error.problem or error.context})') from None
    except (yaml.YAMLError, RecursionError) as error:
        what = ' '.join(str(error).split())[:60]
        raise InputError(f'line 1: no YAML that can be read ({what})') from None
    documents = [document for document in documents if document not in ('', 'null')]
    data: Any = records.Items(documents)
    found = records.read('YAML', data[0] if len(documents) == 1 else data)
    if found is None:
        raise InputError(
            'line 1: YAML without a list of records with equal keys; a record for each '
            'configuration, with its joints or its point, is expected'
        )
    return found


def _plain(node: yaml.Node | None, budget: list[int], depth: int) -> Any:
    """YAML node as text, `Items` or `Mapping`, the latter two with their line.

    `budget`: a list with the number of nodes that may still be expanded, which is counted down
    in place: aliases of aliases multiply. Raises InputError if it is used up, or a key is
    given twice.
    """
    budget[0] -= 1
    if budget[0] < 0:
        # An alias stands for what is elsewhere, and aliases of aliases multiply.
        raise InputError('line 1: YAML whose aliases are larger than the file; write them out')
    if node is None:
        return ''
    line = node.start_mark.line + 1
    if isinstance(node, yaml.ScalarNode):
        # Nothing behind a key is what a file that was cut off ends with: no null.
        none = node.tag == 'tag:yaml.org,2002:null'
        return 'nothing' if none and not node.value else 'null' if none else node.value
    if isinstance(node, yaml.SequenceNode):
        items = records.Items(_plain(item, budget, depth + 1) for item in node.value)
        items.line = line
        return items
    mapping = records.Mapping()
    mapping.line = line
    for key, value in node.value:
        name = str(key.value)
        if name in mapping:
            raise unexpected(key.start_mark.line + 1, name, 'each key once')
        mapping[name] = _plain(value, budget, depth + 1)
    return mapping
