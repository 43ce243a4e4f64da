# SPDX-License-Identifier: Apache-2.0
"""Argument types of the command line, which refuse invalid values before any work."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from remaster_ros.errors import InputError

Number = TypeVar('Number', int, float)
# Of the source paper.
CANDIDATES = 60


class Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line, and whose options cannot be abbreviated."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{**kwargs, 'allow_abbrev': False})

    def error(self, message: str) -> NoReturn:
        """Print the error as one line on stderr, and exit with status 2."""
        self.exit(2, f'error: {message} (see {self.prog} --help)\n')


def integer(low: int) -> Callable[[str], int]:
    """Return an argument type: an integer of at least `low`; ArgumentTypeError for others."""
    return _bounded(int, 'a whole number', low)


def number(low: float = 0.0, high: float = math.inf, unit: str = '') -> Callable[[str], float]:
    """Return an argument type: a finite number from `low` to `high`, both included.

    ``unit``: for messages. It raises ArgumentTypeError for others.
    """
    return _bounded(float, 'a number', low, high, unit)


def _bounded(
    kind: type[Number], what: str, low: float, high: float = math.inf, unit: str = ''
) -> Callable[[str], Number]:
    """Return an argument type: a finite number of type `kind` from `low` to `high`.

    ``what``: the kind in words. It raises ArgumentTypeError, which names the limit, for others.
    The limits themselves are allowed; ``unit``: for the message.
    """
    unit = f' {unit}' if unit else ''

    def convert(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f'{text!r} is not {what}') from None
        if not -math.inf < value < math.inf:
            raise argparse.ArgumentTypeError(f'{text} is not a finite number')
        if value < low:
            raise argparse.ArgumentTypeError(f'{text} is less than {low:g}{unit}')
        if value > high:
            raise argparse.ArgumentTypeError(f'{text} is more than {high:g}{unit}')
        return value

    return convert


def add_poses(parser: argparse.ArgumentParser) -> None:
    """Add the options --poses and --validation, numbers of candidate poses."""
    for option, low, what in (('--poses', 1, 'to fit'), ('--validation', 0, 'held out')):
        parser.add_argument(
            option,
            type=integer(low),
            default=CANDIDATES,
            metavar='N',
            help=f'candidate poses {what} (default {CANDIDATES}; those out of reach are dropped)',
        )


def xacro_arguments(given: Iterable[object]) -> dict[str, str]:
    """Return arguments given as NAME:=VALUE, name -> value; the last of a name counts.

    Raises InputError for another form.
    """
    found = {}
    for text in map(str, given):
        name, sign, value = text.partition(':=')
        if not sign or not name:
            raise InputError(f'{text!r} is not NAME:=VALUE, such as ur_type:=ur5e')
        found[name] = value
    return found


def add_description(parser: argparse.ArgumentParser) -> None:
    """Add the options for reading a robot description."""
    parser.add_argument(
        '--package-path',
        metavar='DIR',
        type=Path,
        action='append',
        default=[],
        help='a folder with ROS packages, or a package; may be repeated',
    )
    parser.add_argument(
        '--trust',
        action='store_true',
        help='let a xacro file run any Python expression, and read any file and the environment',
    )


def names(text: str) -> tuple[str, ...]:
    """Argument type: distinct names separated by commas, in order.

    Raises ArgumentTypeError for an empty name, or one that is there twice.
    """
    found = tuple(part.strip() for part in text.split(','))
    if not all(found):
        raise argparse.ArgumentTypeError(f'{text!r} is no list of names with commas between')
    if len(set(found)) < len(found):
        raise argparse.ArgumentTypeError(f'{text!r} names one of them twice')
    return found


def add_sessions(parser: argparse.ArgumentParser) -> None:
    """Add the session arguments of ``remaster fit`` and ``remaster discover``."""
    parser.add_argument(
        'session',
        metavar='SESSION',
        type=Path,
        nargs='+',
        help='session folder; of several the arm is one, all else is of each session: '
        'registrations, markers, noise, errors of the sensors',
    )
