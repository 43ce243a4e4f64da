"""Where in a YAML file a key stands, and which key was meant."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import yaml

from remaster_ros.errors import did_you_mean
from remaster_ros.session.safe_yaml import load_yaml

Path = tuple[str, ...]
# What msgspec appends to a message; it writes [...] for the keys of dictionaries and for indices.
_AT = re.compile(r' - at `(?:key in )?\$([^`]*)`$')
_UNKNOWN = re.compile(r'Object contains unknown field `([^`]*)`')


def key_lines(text: str) -> dict[Path, int]:
    """Return the line, from 1, of every key of YAML text; {} where it is not YAML."""
    lines: dict[Path, int] = {}

    def visit(node: Any, path: Path) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                here = (*path, str(key.value))
                lines.setdefault(here, key.start_mark.line + 1)
                visit(value, here)

    try:
        visit(yaml.compose(text, Loader=yaml.SafeLoader), ())
    except yaml.YAMLError:
        return {}
    return lines


def with_line(text: str, problem: str) -> str:
    """Return a problem that begins with a dotted key, with the key's line before it."""
    key = problem.split(maxsplit=1)[0].rstrip(':')
    line = key_lines(text).get(tuple(key.split('.')))
    return f'line {line}: {problem}' if line else problem


def explained(text: str, record: type[msgspec.Struct], message: str) -> str:
    """Return msgspec's message with the line of the key, and the key that was meant.

    Parameters
    ----------
    text
        The file.
    record
        What it was to be.
    message
        As msgspec has it.
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


def _is_wrong(text: str, record: type[msgspec.Struct], steps: list[str], path: Path) -> bool:
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
    """Return what a type is beside None, and without its metadata."""
    while isinstance(kind, msgspec.inspect.Metadata | msgspec.inspect.UnionType):
        if isinstance(kind, msgspec.inspect.Metadata):
            kind = kind.type
        else:
            kind = next(t for t in kind.types if not isinstance(t, msgspec.inspect.NoneType))
    return kind
