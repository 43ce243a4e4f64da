# SPDX-License-Identifier: Apache-2.0
"""The commands that stand in README and docs, and whether each can be run as it stands there."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from remaster_ros.cli.main import VERBS, build_parser
from remaster_ros.errors import RemasterError

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / 'README.md',
    # The page of the verbs is written from the parsers, that of the paper by a benchmark.
    *(p for p in sorted((ROOT / 'docs').glob('*.md')) if p.stem not in ('command-line', 'paper')),
]
# What needs ROS, or a session that a recorder has left, is parsed, not run.
NOT_RUN = {'demo', 'recover', 'replay', 'watch'}
# Programs of others; those of this project are checked word by word.
OTHERS = {'apt', 'cd', 'chronyc', 'colcon', 'eval', 'export', 'git', 'rviz2', 'source', 'sudo'}
ROS2 = {'bag', 'control', 'pkg', 'security', 'topic'}
FENCE = re.compile(r'^( *)```(\w*)\n(.*?)^\1```$', re.MULTILINE | re.DOTALL)


class Command(NamedTuple):
    """A command of a page: its words, and what the page shows of stderr."""

    page: str
    line: int
    words: list[str]
    error: str

    @property
    def verb(self) -> str:
        """The verb of `remaster`; '' for another program."""
        return self.words[1] if self.words[0] == 'remaster' and len(self.words) > 1 else ''

    @property
    def is_run(self) -> bool:
        """Whether it can be run here: without ROS, on files that are not the reader's own."""
        # A bag of standstills costs a page more than all else on it; bags are tried elsewhere.
        names_bag = 'my_bag' in self.words and '--moving' not in self.words
        is_private = names_bag or any(w.startswith(('~', '/')) or w == '…' for w in self.words)
        return self.verb in {*VERBS} - NOT_RUN and not is_private


def commands(page: Path) -> Iterator[Command]:
    """Return the commands of the fenced blocks ``bash`` and ``console``, in their order."""
    text = page.read_text(encoding='utf-8')
    for block in FENCE.finditer(text):
        indent, kind, content = block.groups()
        first = text[: block.start(3)].count('\n') + 1
        lines = [line.removeprefix(indent) for line in content.splitlines()]
        for at, line in enumerate(lines):
            if kind == 'bash' and line.strip() and not line.startswith('#'):
                yield from _split(page.name, first + at, line, '')
            elif kind == 'console' and line.startswith('$ '):
                shown = lines[at + 1] if at + 1 < len(lines) else ''
                error = shown if shown.startswith('error: ') else ''
                yield from _split(page.name, first + at, line[2:], error)


def _split(page: str, line: int, text: str, error: str) -> Iterator[Command]:
    """Return the commands between which && stands, without comment and &."""
    words = shlex.split(text, comments=True)
    while words:
        end = words.index('&&') if '&&' in words else len(words)
        yield Command(page, line, [word for word in words[:end] if word != '&'], error)
        words = words[end + 1 :]


def hidden_commands(page: Path) -> list[str]:
    """Return lines that are commands of this project outside of the blocks that are checked."""
    text = FENCE.sub(
        lambda b: '' if b[2] in ('bash', 'console') else b[0], page.read_text('utf-8')
    )
    return re.findall(
        r'^(?: {4}|\$ |)(?:remaster [a-z]+|ros2 [a-z]+|make [a-z]+) \S.*$', text, re.M
    )


def parser(verb: str) -> argparse.ArgumentParser:
    """Return the parser of one verb."""
    return build_parser(verb)._subparsers._group_actions[0].choices[verb]


def fault(command: Command) -> str:
    """Return what is wrong with a command; '' where nothing is."""
    program, *args = command.words
    if program == 'remaster':
        return _remaster(args)
    if program == 'make':
        return _make(args)
    if program == 'pip':
        return _pip(args)
    if program == 'python':
        return _python(args)
    if program == 'ros2':
        return _ros2(args)
    if program == 'ssh':
        return _remaster(args[args.index('remaster') + 1 :])
    return '' if program in OTHERS else f'{program} is no program that this test has heard of'


def _remaster(words: list[str]) -> str:
    try:
        build_parser(words[0]).parse_args(words)
    except SystemExit as ended:
        return f'its options are refused: {ended}' if ended.code else ''
    except RemasterError as refused:
        return str(refused)
    return ''


def _make(words: list[str]) -> str:
    text = (ROOT / 'Makefile').read_text(encoding='utf-8')
    targets = {*re.findall(r'^([\w.-]+):', text, re.MULTILINE), '.venv-ros/installed'}
    variables = {*re.findall(r'\$\((?:if \$\(|or \$\()?([A-Z]+)\b', text)}
    for word in words:
        name, is_set, _ = word.partition('=')
        if name not in (variables if is_set else targets):
            return f'the Makefile has no {name}'
    return ''


def _pip(words: list[str]) -> str:
    extras = re.findall(r'\[(\w+)\]', ' '.join(words))
    text = (ROOT / 'setup.py').read_text(encoding='utf-8')
    missing = [extra for extra in extras if f"'{extra}': " not in text]
    return f'setup.py has no extra {missing}' if missing else ''


def _python(words: list[str]) -> str:
    if words[:2] == ['-m', 'remaster_ros.nodes']:
        return _node(words[2], words[3:])
    path = ROOT / words[0]
    if not path.is_file():
        return f'there is no {words[0]}'
    text = path.read_text(encoding='utf-8')
    missing = [word for word in words[1:] if word.startswith('--') and f"'{word}'" not in text]
    return f'{words[0]} has no {missing}' if missing else ''


def _node(name: str, words: list[str]) -> str:
    sections = re.split(r'^## ', (ROOT / 'docs/parameters.md').read_text('utf-8'), flags=re.M)
    section = next((text for text in sections if text.startswith(f'{name}\n')), None)
    if section is None:
        return f'there is no node {name}'
    for at, word in enumerate(words):
        if word == '-p':
            parameter = words[at + 1].partition(':=')[0]
            if f'| `{parameter}` |' not in section and parameter != 'use_sim_time':
                return f'{name} has no parameter {parameter}'
    return ''


def _ros2(words: list[str]) -> str:
    kind, *args = words
    if kind == 'service':
        services = (ROOT / 'docs/topics.md').read_text(encoding='utf-8')
        return '' if f'`{args[1]}`' in services else f'docs/topics.md has no service {args[1]}'
    if kind == 'launch':
        path = ROOT / 'launch' / args[1]
        if not path.is_file():
            return f'there is no {args[1]}'
        text = path.read_text(encoding='utf-8')
        missing = [w for w in args[2:] if f"'{w.partition(':=')[0]}'" not in text]
        return f'{args[1]} has no {missing}' if missing else ''
    if kind == 'run':
        return _node(args[1], args[2:])
    if kind == 'param':
        return _node(args[1].strip('/'), ['-p', args[2]])
    return '' if kind in ROS2 else f'ros2 {kind} is not known here'


def reads(command: Command) -> list[str]:
    """Return the words that may name a file or folder which the command reads."""
    written = command.words.index('--out') + 1 if '--out' in command.words else 0
    if command.verb == 'simulate':
        written = 2
    return [word for at, word in enumerate(command.words[2:], 2) if at != written]


def small(command: Command) -> list[str]:
    """Return the words for `main`, with sizes that cost little where the page leaves them open."""
    words = command.words[1:]
    if find_spec('weasyprint') is None:
        words = [word for word in words if word != '--pdf']
    options = {
        'init': ['--no-plan'],
        'simulate': ['--poses', '24', '--validation', '12'],
        'plan': ['--poses', '20', '--validation', '6', '--reference-every', '0'],
        'fit': ['--draws', '500', '--no-figures'],
        'discover': ['--no-figures'],
        'report': ['--no-figures'],
    }.get(command.verb, [])
    chosen = '--poses' in words or '--draws' in words
    return words if chosen else [*words, *options]
