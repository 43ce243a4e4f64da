# SPDX-License-Identifier: Apache-2.0
"""YAML of unknown origin: plain data only, numbers of YAML 1.2, no aliases, no tags.

YAML 1.1, PyYAML's default, reads ``1e-3`` as text, ``no`` as false and ``010`` as eight; session
files are read by YAML 1.2. Aliases are refused: nested ones expand a few lines to gigabytes.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

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
    """Text that is not YAML as read here; ``str()`` is one line with the place in the text."""


class _Loader(yaml.SafeLoader):
    """Loader of plain data; raises YamlError for aliases, tags and repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose the next node; YamlError with the line for an alias or a tag."""
        event = self.peek_event()
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise YamlError(f'line {line}: aliases (*{event.anchor}) are not read; write it out')
        if event.tag is not None:
            raise YamlError(f'line {line}: tags ({event.tag}) are not read; leave the tag out')
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; YamlError with the line for a repeated key."""
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
    """Dumper that quotes text which YAML 1.1 or 1.2 would not read as text."""


for _name, _pattern, _first in _CORE_RESOLVERS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f'tag:yaml.org,2002:{_name}', re.compile(f'(?:{_pattern})\\Z'), _first
        )


def load_yaml(text: str) -> Any:
    """Return the plain data of one YAML document; None for an empty text.

    Raises YamlError, one line with the place, for text that is not YAML, several documents, an
    alias, a tag, a repeated key, or deep nesting.
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
