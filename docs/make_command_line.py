# SPDX-License-Identifier: Apache-2.0
"""Write docs/command-line.md: every verb and option, from the parsers themselves."""

from __future__ import annotations

import argparse
from pathlib import Path

from remaster_ros.cli.main import VERBS, build_parser

PAGE = Path(__file__).parent / 'command-line.md'
COMMON = {'--help', '--seed', '--quiet', '--no-figures', '--json'}
HEAD = """# Command line

This page lists the commands with all options. Written by `make docs` from the parsers; a test
keeps it equal. `remaster VERB --help` shows the same.

Every verb also takes `--help`, `--seed SEED` (of all randomness, default 0), `--quiet` (print
nothing but errors), `--no-figures` and, but for `demo`, `watch` and `replay`, `--json` (print one
JSON object in place of a summary). `remaster --version` prints the version,
`eval "$(remaster --completion bash)"` (or zsh, fish) completes verbs and options.

Exit status: 0 done, 1 the data allow no answer, 2 wrong usage or bad input; 3 of `recover`:
something was lost. An error is one line on stderr.
"""


def page() -> str:
    """Return the page."""
    return '\n'.join([HEAD, *(section(verb) for verb in VERBS)])


def section(verb: str) -> str:
    """Return the heading and the table of one verb."""
    parser = verb_parser(verb)
    rows = [row(action) for action in parser._actions if not COMMON & {*action.option_strings}]
    return '\n'.join(
        [
            f'## remaster {verb}',
            '',
            ' '.join((parser.description or '').split()),
            '',
            '| argument | what it is |',
            '|---|---|',
            *rows,
            '',
        ]
    )


def verb_parser(verb: str) -> argparse.ArgumentParser:
    """Return the parser of one verb."""
    for action in build_parser(verb)._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices[verb]
    raise LookupError(verb)


def row(action: argparse.Action) -> str:
    """Return the table row of an option or positional argument."""
    name = '`, `'.join(action.option_strings)
    metavar = action.metavar or ('' if action.nargs == 0 else action.dest.upper())
    if action.choices and not action.metavar:
        metavar = '{' + ','.join(map(str, action.choices)) + '}'
    words = [metavar] if isinstance(metavar, str) else list(metavar)
    if action.nargs == '*' or action.nargs == '+':
        words.append('…')
    text = ' '.join(filter(None, [name, *words]))
    needed = ' (must be given)' if action.option_strings and action.required else ''
    what = (action.help or '').replace('%%', '%') + needed
    return f'| `{escape(text)}` | {escape(what)} |'


def escape(text: str) -> str:
    """Return the text with the bars that would end a cell of a table escaped."""
    return text.replace('|', '\\|')


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
