# SPDX-License-Identifier: Apache-2.0
"""Records of YAML files, each declared once: a msgspec struct with the bounds of its numbers.

Bounds (`remaster_ros.bounds`) are in the annotation of a field and hold for every number in it.
They are not msgspec's (`msgspec.Meta`), whose messages lack the keys of dictionaries.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np
import yaml

from remaster_ros.bounds import Bounds
from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.session.files import decode_text
from remaster_ros.session.strict_yaml import YamlError, load_yaml

Keys = tuple[str, ...]
# End of a msgspec message, with [...] for the keys of dictionaries and for indices.
_AT = re.compile(r' - at `(?:key in )?\$([^`]*)`$')
_UNKNOWN = re.compile(r'Object contains unknown field `([^`]*)`')

YAML_LIMIT = 256 * 1024
FINITE = Bounds()
Record = TypeVar('Record', bound=msgspec.Struct)


def key_lines(text: str) -> dict[Keys, int]:
    """Return the line number, from 1, of every key of YAML text by its path; {} if it is not YAML.

    Keys in lists are not counted.
    """
    lines: dict[Keys, int] = {}

    def visit(node: Any, path: Keys) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                keys = (*path, str(key.value))
                lines.setdefault(keys, key.start_mark.line + 1)
                visit(value, keys)

    try:
        visit(yaml.compose(text, Loader=yaml.SafeLoader), ())
    except (yaml.YAMLError, RecursionError):
        return {}
    return lines


def with_line(text: str, problem: str) -> str:
    """Return the message of a problem with 'line N: ' in front, if its key is in the YAML text.

    ``problem``: message that begins with the dotted key.
    """
    key = problem.split(maxsplit=1)[0].rstrip(':')
    line = key_lines(text).get(tuple(key.split('.')))
    return f'line {line}: {problem}' if line else problem


def explained(text: str, record: type[msgspec.Struct], message: str) -> str:
    """Return a validation message of msgspec with the line and path of the key in the file.

    ``text``: of the file; ``record``: its type; ``message``: msgspec's. The message on an
    unknown key ends with a similar known key, or else with all known ones. Another message is
    returned unchanged if its place is not found in the file.
    """
    match = _AT.search(message)
    steps = re.findall(r'\w+|\[[^\]]*\]', match[1]) if match else []
    unknown = _UNKNOWN.match(message)
    if unknown:
        steps.append(unknown[1])
    places = [
        (path, line)
        for path, line in key_lines(text).items()
        if len(path) == len(steps)
        and all(step.startswith('[') or step == key for step, key in zip(steps, path))
    ]
    if unknown:
        names = _fields(record, steps[:-1])
        where = f'line {places[0][1]}: ' if places else ''
        remedy = did_you_mean(unknown[1], names) or f'; the keys here are {", ".join(names)}'
        return f'{where}unknown key {unknown[1]!r}{remedy}'
    wrong = (p for p in places if len(places) == 1 or _is_wrong(text, record, steps, p[0]))
    path, line = next(wrong, ((), 0))
    if not line:
        return message
    return f'line {line}: {".".join(path)}: {_AT.sub("", message)}'


def _is_wrong(text: str, record: type[msgspec.Struct], steps: list[str], path: Keys) -> bool:
    """Return whether the entry at a path of a YAML text breaks the record type.

    To find out which key of a dictionary a message of msgspec is about. ``path``: the keys to
    the entry; ``steps``: the same in msgspec's message, with [...] in place of a key of a
    dictionary. The text is validated without the other entries of these dictionaries.
    """
    content = load_yaml(text)
    here = content
    for step, key in zip(steps, path):
        if step.startswith('['):
            for reduced in [reduced for reduced in here if str(reduced) != key]:
                del here[reduced]
        here = here[key]
    try:
        msgspec.convert(content, record)
    except msgspec.ValidationError:
        return True
    return False


def _fields(record: type[msgspec.Struct], steps: list[str]) -> list[str]:
    """Return the known keys of a record that is nested in a record type.

    ``steps``: keys that lead to it. [] if there is no record.
    """
    kind: Any = msgspec.inspect.type_info(record)
    for step in steps:
        kind = _record_of(kind)
        if isinstance(kind, msgspec.inspect.StructType):
            kind = next((f.type for f in kind.fields if f.encode_name == step), None)
        elif isinstance(kind, msgspec.inspect.DictType):
            kind = kind.value_type
    kind = _record_of(kind)
    if isinstance(kind, msgspec.inspect.StructType):
        return [field.encode_name for field in kind.fields]
    return []


def _record_of(kind: Any) -> Any:
    """Return the first type of a union that is not None; other types unchanged."""
    if isinstance(kind, msgspec.inspect.UnionType):
        kind = next(t for t in kind.types if not isinstance(t, msgspec.inspect.NoneType))
    return kind


def to_plain(value: Any) -> Any:
    """Return a dataclass, struct or container as plain data; floats are exact, arrays lists."""
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())


def from_plain(content: Any, record: Any) -> Any:
    """Return an object of the type `record` from plain data, as `to_plain` returns it.

    Arrays become arrays of floats. Raises ValueError, which names the place of an error.
    """
    return msgspec.convert(content, record, dec_hook=lambda _, values: np.array(values, float))


def read_yaml(data: bytes, path: Path, record: type[Record], remedy: str = '') -> Record:
    """Read a YAML file into a struct within its bounds; ``remedy``: ends messages.

    Raises InputError, which names file, key and remedy, if the content is invalid.
    """
    text = decode_text(data, path)
    try:
        content = msgspec.convert(load_yaml(text), record)
    except YamlError as error:
        raise InputError(f'{path}: {error}{remedy}') from None
    except msgspec.ValidationError as error:
        raise InputError(f'{path}: {explained(text, record, str(error))}{remedy}') from None
    if problem := out_of_bounds(content):
        raise InputError(f'{path}: {with_line(text, problem)}')
    return content


@cache
def _hints(record: type) -> dict[str, Any]:
    """Return the annotation of each field of a record type, with the bounds in it."""
    return get_type_hints(record, include_extras=True)


def out_of_bounds(value: Any, key: str = '', bounds: Bounds = FINITE) -> str:
    """Return the error of the first number that is outside its bounds; '' if none is.

    ``value``: a record or a part of one, searched at every level; ``key``: its dotted key, ''
    for a whole record; ``bounds``: of the numbers in ``value``, unless it is a record, whose
    fields have their own.
    """
    if isinstance(value, float):
        return bounds.problem(key, value)
    parts: list[tuple[str, Any, Bounds]] = []
    if isinstance(value, msgspec.Struct):
        for name, hint in _hints(type(value)).items():
            (declared,) = getattr(hint, '__metadata__', (Bounds(),))
            parts.append((name, getattr(value, name), declared))
    elif isinstance(value, dict):
        parts = [(str(name), inner, bounds) for name, inner in value.items()]
    elif isinstance(value, list | tuple):
        parts = [('', inner, bounds) for inner in value]
    problems = (out_of_bounds(inner, f'{key}.{name}'.strip('.'), at) for name, inner, at in parts)
    return next(filter(None, problems), '')
