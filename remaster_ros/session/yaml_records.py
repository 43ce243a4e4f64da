# SPDX-License-Identifier: Apache-2.0
"""Records of YAML files, each declared once: a msgspec struct with the bounds of its numbers.

Bounds stand in the annotation of a field and hold for every number in it::

    class Marker(msgspec.Struct, forbid_unknown_fields=True):
        position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]

They are not msgspec's own (`msgspec.Meta`), whose messages leave out the keys of dictionaries.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np
import yaml

from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.session.files import decode_text

# YAML of unknown origin: plain data only, YAML 1.2's numbers, no aliases, no tags.
#
# YAML 1.1, PyYAML's default, reads ``1e-3`` as text, ``no`` as false and ``010`` as eight; a
# session file is read by YAML 1.2. Aliases are refused: nested ones make a few lines into
# gigabytes.


_CORE_RESOLVERS = (
    ('null', r'~|null|Null|NULL|', ['~', 'n', 'N', '']),
    ('bool', r'true|True|TRUE|false|False|FALSE', list('tTfF')),
    ('int', r'[-+]?(?:0|[1-9][0-9]*)', list('-+0123456789')),
    (
        'float',
        r'[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?'
        r'|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)',
        list('-+.0123456789'),
    ),
)


class YamlError(ValueError):
    """The text is not the YAML this package reads; ``str()`` is one line with the place."""


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise YamlError(f'line {line}: aliases (*{event.anchor}) are not read; write it out')
        if event.tag is not None:
            raise YamlError(f'line {line}: tags ({event.tag}) are not read; leave the tag out')
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            seen = set()
            for key_node, _ in node.value:
                if key_node.value in seen:
                    line = key_node.start_mark.line + 1
                    raise YamlError(
                        f'line {line}: key {key_node.value!r} is given twice; keep one'
                    )
                seen.add(key_node.value)
        return mapping


class _Dumper(yaml.SafeDumper):
    """Quotes whatever YAML 1.1 or 1.2 would read as anything but text."""


for _name, _pattern, _first in _CORE_RESOLVERS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f'tag:yaml.org,2002:{_name}', re.compile(f'(?:{_pattern})\\Z'), _first
        )


def load_yaml(text: str) -> Any:
    """Return the plain data of one YAML document.

    A `YamlError` for more than one, an alias, a tag, a repeated key, or what is nested too deep.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except YamlError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f'line {mark.line + 1}: ' if mark else ''
        problem = ' '.join((error.problem or error.context or 'not YAML').split())
        raise YamlError(f'{line}{problem}; correct the YAML') from None
    except RecursionError:
        raise YamlError('nested too deep; this is not a file of this format') from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise YamlError(f'{" ".join(str(error).split())}; correct the YAML') from None


def dump_yaml(content: Any) -> str:
    """Return plain data as YAML text, keys in their order, floats exact."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None
    )


Keys = tuple[str, ...]
# What msgspec appends to a message; it writes [...] for the keys of dictionaries and for indices.
_AT = re.compile(r' - at `(?:key in )?\$([^`]*)`$')
_UNKNOWN = re.compile(r'Object contains unknown field `([^`]*)`')


def key_lines(text: str) -> dict[Keys, int]:
    """Return the line, from 1, of every key of YAML text; {} where it is not YAML."""
    lines: dict[Keys, int] = {}

    def visit(node: Any, path: Keys) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                here = (*path, str(key.value))
                lines.setdefault(here, key.start_mark.line + 1)
                visit(value, here)

    try:
        visit(yaml.compose(text, Loader=yaml.SafeLoader), ())
    except (yaml.YAMLError, RecursionError):
        return {}
    return lines


def with_line(text: str, problem: str) -> str:
    """Return a problem that begins with a dotted key, with the key's line before it."""
    key = problem.split(maxsplit=1)[0].rstrip(':')
    line = key_lines(text).get(tuple(key.split('.')))
    return f'line {line}: {problem}' if line else problem


def explained(text: str, record: type[msgspec.Struct], message: str) -> str:
    """Return msgspec's message with the line of the key, and the key that was meant.

    The text of the file was to be a `record`.
    """
    found = _AT.search(message)
    steps = re.findall(r'\w+|\[[^\]]*\]', found[1]) if found else []
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
    """Return whether a file is refused that has this entry alone where the steps have [...]."""
    content = load_yaml(text)
    here = content
    for step, key in zip(steps, path):
        if step.startswith('['):
            for other in [other for other in here if str(other) != key]:
                del here[other]
        here = here[key]
    try:
        msgspec.convert(content, record)
    except msgspec.ValidationError:
        return True
    return False


def _fields(record: type[msgspec.Struct], steps: list[str]) -> list[str]:
    """Return the keys that a record has after some steps into it."""
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
    """Return what a type is beside None."""
    if isinstance(kind, msgspec.inspect.UnionType):
        kind = next(t for t in kind.types if not isinstance(t, msgspec.inspect.NoneType))
    return kind


def to_plain(value: Any) -> Any:
    """Return a dataclass, struct or container as plain data; floats keep every bit."""
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist())


def from_plain(content: Any, record: Any) -> Any:
    """Return what `to_plain` made plain, a `record` (a type); its arrays are of floats.

    A `ValueError` names the place that does not fit it.
    """
    return msgspec.convert(content, record, dec_hook=lambda _, values: np.array(values, float))


YAML_LIMIT = 256 * 1024

Triple = tuple[float, float, float]
Record = TypeVar('Record', bound=msgspec.Struct)


@dataclass(frozen=True)
class Bounds:
    """What a number of a file may be; in any case it is finite."""

    least: float = -math.inf
    most: float = math.inf
    # Beyond `most` m, or below `least` degrees, the message gives the value as it is if it was
    # written in millimetres or radians.
    unit: str = ''
    # Whether `least` itself is refused.
    above: bool = False
    # Further text of the message.
    remedy: str = ''

    def problem(self, key: str, value: float) -> str:
        """Return what is wrong with a value, in one line with the remedy; '' where nothing is."""
        if not math.isfinite(value):
            return f'{key}: {value} is not a finite number; correct it'
        if self.least < value <= self.most or (value == self.least and not self.above):
            return ''
        limits = [f'above {self.least:g}' if self.above else f'from {self.least:g}']
        if math.isfinite(self.most):
            limits.append(f'to {self.most:g}')
        text = f'{key} is {value:g}; it must be {" ".join((*limits, self.unit)).rstrip()}'
        if self.unit == 'm' and abs(value) > self.most:
            text += f'; if millimetres were meant, write {value / 1e3:g}'
        elif self.unit == 'degrees' and 0.0 < value < self.least:
            text += f'; if radians were meant, write {math.degrees(value):.4g}'
        return text + self.remedy


def read_yaml(data: bytes, path: Path, record: type[Record], remedy: str = '') -> Record:
    """Read a YAML file into a struct within its bounds; a remedy follows msgspec's messages."""
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
    return get_type_hints(record, include_extras=True)


def out_of_bounds(value: Any, key: str = '', bounds: Bounds = Bounds()) -> str:
    """Return what is wrong with the first number that its bounds refuse; '' where none is.

    The value is a record or a part of one, at a dotted key, in a field with these bounds.
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
