# SPDX-License-Identifier: Apache-2.0
"""Options of ``remaster import``, a function for each group, and the types of their arguments."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal, get_args

from remaster_ros.cli.options import add_description, names, number
from remaster_ros.importing.sessions import Stretch
from remaster_ros.importing.units import ANGLES, LENGTHS
from remaster_ros.types import SensorKind

SEPARATORS = {'comma': ',', 'semicolon': ';', 'tab': '\t', 'bar': '|', 'blank': ' '}
DECIMALS = {'comma': ',', 'point': '.'}


def add_files(parser: argparse.ArgumentParser) -> None:
    """Add the files that are read and the folder that is written."""
    parser.add_argument(
        'files',
        metavar='FILE',
        type=Path,
        nargs='+',
        help='a table with joints and points, or two to be joined; or a ROS bag; or a session '
        'folder, to write it without a mistake that is in it',
    )
    parser.add_argument('--out', metavar='SESSION', type=Path, required=True, help='new folder')


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Add the options for the nominal arm: a description or a cell, and the ends of the arm."""
    robot = parser.add_mutually_exclusive_group()
    robot.add_argument('--urdf', metavar='FILE', type=Path, help='the nominal arm')
    robot.add_argument(
        '--cell', metavar='CELL', help='a cell file: its arm, sensor (aim_at) and marker'
    )
    parser.add_argument('--base-link', metavar='LINK', help='frame R (default: the root link)')
    parser.add_argument(
        '--tip-link', metavar='LINK', help='frame T, in which the marker is (default: proposed)'
    )
    add_description(parser)
    parser.add_argument(
        '--xacro-argument',
        metavar='NAME:=VALUE',
        action='append',
        default=[],
        help='of a xacro file given with --urdf, such as ur_type:=ur5e; may be repeated',
    )


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options for a bag of an arm that moved while it was measured."""
    parser.add_argument(
        '--moving',
        action='store_true',
        help='of a bag: rows of 0.1 s while the arm moves, in place of its standstills',
    )
    parser.add_argument(
        '--proof',
        metavar='SESSION',
        type=Path,
        help='with --moving: its held-out poses at standstill are held-out rows as well, by which '
        'the model of the motion is proved; measured by the same sensors, which stand where they '
        'stood',
    )


def add_columns(parser: argparse.ArgumentParser) -> None:
    """Add the options for columns and units of the tables, and for the joining of two tables."""
    table = parser.add_argument_group('what the columns are, where it was not found')
    table.add_argument(
        '--joints',
        metavar='COLUMN,…',
        type=names,
        default=(),
        help='base to tip: names, or numbers (1-6) where there is no header; joints.txt:1-6 of '
        'that file',
    )
    table.add_argument(
        '--points',
        metavar='X,Y,Z',
        type=names,
        default=(),
        help='measured points; three columns for each marker, or the names of markers',
    )
    table.add_argument('--time', metavar='COLUMN', default='', help="or 'none' to leave it out")
    table.add_argument('--names', metavar='COLUMN', default='', help='by which to join two tables')
    table.add_argument('--angles', choices=tuple(ANGLES), default='', help='unit of the joints')
    table.add_argument(
        '--pulses-per-degree',
        metavar='N,…',
        type=_pulses,
        default=(),
        help='of joints in pulses of the motors, base to tip; negative where one counts the '
        'other way round',
    )
    table.add_argument(
        '--sheet',
        metavar='NAME,…',
        type=names,
        default=(),
        help='of a workbook: the one with joints and points, or two (default: those with numbers)',
    )
    table.add_argument('--length', choices=tuple(LENGTHS), default='', help='unit of the points')
    table.add_argument('--separator', choices=tuple(SEPARATORS), help='between the columns')
    table.add_argument('--decimal', choices=tuple(DECIMALS), help='decimal sign')
    table.add_argument('--encoding', metavar='NAME', default='', help='such as utf-8 or cp1252')
    table.add_argument(
        '--join', choices=('name', 'time', 'order'), default='', help='how two tables are joined'
    )
    table.add_argument(
        '--within',
        metavar='S',
        type=number(unit='s'),
        default=1.0,
        help='largest difference of times that are joined (default 1)',
    )
    table.add_argument(
        '--clock-offset',
        metavar='S',
        type=number(-1e10, 1e10, 's'),
        help="of two streams: the joints' clock less the points' (default: found by standstills)",
    )


def add_corrections(parser: argparse.ArgumentParser) -> None:
    """Add the options that correct a mistake in the joints or the points."""
    arm = parser.add_argument_group('corrections of the joints, by column or joint')
    arm.add_argument(
        '--couple',
        metavar='JOINT=JOINT',
        type=_couple,
        action='append',
        default=[],
        help='add a joint to another (J3=J2 on FANUC; J3=-J2 subtracts); before the next two',
    )
    arm.add_argument(
        '--reverse',
        metavar='JOINT,…',
        type=names,
        action='extend',
        default=[],
        help='counts the other way round; may be repeated, and a joint named twice is as it was',
    )
    arm.add_argument(
        '--offset',
        metavar='JOINT=DEG',
        type=_offset,
        action='append',
        default=[],
        help='add an angle to a joint; may be repeated',
    )
    arm.add_argument(
        '--multiply-angles',
        metavar='F',
        type=number(1e-6, 1e6),
        default=1.0,
        help='of a session: its angles, which were converted twice',
    )
    arm.add_argument(
        '--multiply-points',
        metavar='F',
        type=number(1e-9, 1e9),
        default=1.0,
        help='of a session: its points, which were converted twice',
    )
    arm.add_argument(
        '--shift-points',
        metavar='ROWS[@FROM-TO]',
        type=_stretch,
        help='move each point to the joints of the row behind it (1) or before it (-1); in the '
        'observations (rows, counted from 0) from FROM on, before TO, or all',
    )
    arm.add_argument(
        '--exchange-markers',
        metavar='A,B[@FROM-TO]',
        type=_stretch,
        help='exchange the labels of two markers, in all rows or in some',
    )
    arm.add_argument(
        '--turn-tool',
        metavar='AXIS=DEG',
        type=_turn,
        default=('', 0.0),
        help="turn the markers' places about x, y or z of the tool frame, by a multiple of 90",
    )


def add_session(parser: argparse.ArgumentParser) -> None:
    """Add the options for what the session states: sensor, marker, held-out poses and checks."""
    session = parser.add_argument_group('the session')
    session.add_argument(
        '--on-tool',
        action='store_true',
        help='the sensor, a camera, is on the tool: the points and quaternions are poses of what '
        'stands (a board), in its frame',
    )
    session.add_argument('--sensor', metavar='NAME', help='default: sensor')
    session.add_argument(
        '--sensor-kind',
        choices=get_args(SensorKind),
        default='',
        help='what measured the points: no lens is looked for in a tracker, and no error of a '
        "sensor in points that the robot's controller computed (default: by names and files, "
        'else unknown)',
    )
    session.add_argument('--marker', metavar='NAME', help='default: marker')
    session.add_argument(
        '--marker-mm',
        metavar=('X', 'Y', 'Z'),
        type=number(-3000.0, 3000.0, 'mm'),
        nargs=3,
        help='the marker in the tip link, mm (default: unknown, and fitted)',
    )
    session.add_argument(
        '--marker-std-mm',
        metavar='S',
        type=number(0.0, 400.0, 'mm'),
        help='how well that is known (default 0.5; 300 where unknown)',
    )
    session.add_argument(
        '--hold-out',
        metavar='SHARE',
        type=number(0.0, 0.5),
        default=0.25,
        help='share of the poses held out where the table names none (default 0.25)',
    )
    session.add_argument(
        '--visited-in-order',
        action='store_true',
        help='the arm went from row to row and nowhere between: fills from_q, for backlash',
    )
    session.add_argument(
        '--accuracy-option',
        choices=('active', 'inactive'),
        default='',
        help="the maker's own (KUKA $ABS_ACCUR, ABB Absolute Accuracy), while it was measured",
    )
    session.add_argument(
        '--never-mastered',
        action='store_true',
        help='zero-offsets may be of any size (hobby servos, a motor that was replaced); all else '
        'is checked',
    )
    session.add_argument(
        '--unchecked', action='store_true', help='write it also where it does not fit the robot'
    )


def _couple(text: str) -> tuple[str, tuple[str, Literal[1, -1]]]:
    """Argument type: a joint to which another one is added (1) or subtracted (-1).

    JOINT=OTHER or JOINT=-OTHER, as (joint, (other, sign)); ArgumentTypeError for another form.
    """
    name, sign, other = text.partition('=')
    if not (name and sign and other.lstrip('+-')):
        raise argparse.ArgumentTypeError(f'{text!r} is not JOINT=JOINT, such as J3=J2')
    return name, (other.lstrip('+-'), -1 if other.startswith('-') else 1)


def _stretch(text: str) -> Stretch:
    """Argument type: a change, and the observations that it applies to, WHAT[@FROM-TO].

    The change is WHAT (a text that is not checked here) in observations from number FROM to
    before TO. FROM, TO or all of @FROM-TO may be missing: None, no bound on that side. Raises
    ArgumentTypeError for another form.
    """
    what, at, between = text.partition('@')
    since, dash, until = between.partition('-')
    if at and not (dash and all(end.isdigit() or not end for end in (since, until))):
        raise argparse.ArgumentTypeError(
            f'{text!r} does not end in @FROM-TO, such as @40- or @-40'
        )
    return Stretch(what, int(since) if since else None, int(until) if until else None)


def _turn(text: str) -> tuple[str, float]:
    """Argument type: an axis and an angle from -360 to 360 degrees, AXIS=DEGREES.

    The axis is x, y or z; ArgumentTypeError for another form.
    """
    axis, sign, angle = text.partition('=')
    if axis not in ('x', 'y', 'z') or not sign:
        raise argparse.ArgumentTypeError(f'{text!r} is not AXIS=DEGREES, such as z=90')
    return axis, number(-360.0, 360.0, 'degrees')(angle)


def _pulses(text: str) -> tuple[float, ...]:
    """Argument type: pulses per degree of each joint, numbers with commas between.

    ArgumentTypeError for a 0 or what is no number.
    """
    counts = tuple(number(-1e9, 1e9)(part) for part in text.split(','))
    if not all(counts):
        raise argparse.ArgumentTypeError(f'{text!r}: no joint has 0 pulses a degree')
    return counts


def _offset(text: str) -> tuple[str, float]:
    """Argument type: a joint and an angle from -360 to 360 degrees, JOINT=DEGREES.

    ArgumentTypeError for another form.
    """
    name, sign, angle = text.rpartition('=')
    if not sign or not name:
        raise argparse.ArgumentTypeError(f'{text!r} is not JOINT=DEGREES, such as A2=-90')
    return name, number(-360.0, 360.0, 'degrees')(angle)
