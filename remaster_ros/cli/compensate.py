# SPDX-License-Identifier: Apache-2.0
"""Correct a table of joint targets, for controllers that take nothing but programs."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.gauge_words import counted
from remaster_ros.cli.console import tell
from remaster_ros.cli.options import names, number
from remaster_ros.compensation.compensator import ROUNDING_RAD, Compensator, Correction
from remaster_ros.compensation.file import read_compensation
from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.columns import ColumnChoice, Columns
from remaster_ros.importing.text_table import TextTable, read_table
from remaster_ros.importing.units import ANGLES
from remaster_ros.importing.values import joint_values, numbers, times
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.files import write_atomically
from remaster_ros.types import FloatArray

FORMAT = 'remaster-compensate/1'
# A hundred-thousandth of a degree is a fifth of a micrometre a metre away.
DIGITS = {'deg': 6, 'rad': 8, 'mm': 5}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster compensate``."""
    parser.add_argument(
        'compensation', metavar='COMPENSATION', type=Path, help='apply/compensation.json'
    )
    parser.add_argument(
        'table', metavar='TABLE', type=Path, help='joint targets, columns as in import'
    )
    parser.add_argument('--out', metavar='FILE', type=Path, required=True, help='the new table')
    parser.add_argument(
        '--inverse',
        action='store_true',
        help='from reported angles to those at which the nominal robot has its tool there',
    )
    parser.add_argument(
        '--joints', type=names, default=(), help='columns of the joints, base to tip'
    )
    parser.add_argument(
        '--angles', choices=sorted(ANGLES), help='unit, where the header has none: never guessed'
    )
    parser.add_argument(
        '--temperature',
        metavar='C',
        type=number(-50.0, 150.0, 'degrees Celsius'),
        help='of the arm, where the table has none (default: as it was measured)',
    )
    parser.add_argument(
        '--max-change-deg',
        metavar='DEG',
        type=number(0.0, 90.0, 'degrees'),
        default=2.0,
        help='largest change of a joint (default 2); one that slides by 4.36 mm for each degree; '
        'refused where the error of a joint alone is more',
    )
    parser.add_argument('--json', action='store_true', help='print what was done as JSON')


def run(args: argparse.Namespace) -> int:
    """Correct the table, write it, and print a summary; return 0.

    Raises InputError if joint columns or their units are not known, a change or a command is
    beyond its limits (`_refuse_beyond`), or --out is the table itself; nothing is written then.
    """
    compensation = read_compensation(args.compensation)
    if args.out.exists() and args.out.samefile(args.table):
        raise InputError(f'{args.out}: is the table itself; name another file for --out')
    table = read_table(args.table)
    chain = compensation.model.chain
    sliding = np.flatnonzero(chain.slides).tolist()
    columns = find_columns(table, chain.joint_names, ColumnChoice(joints=args.joints), sliding)
    if len(columns.joints) != len(chain):
        raise InputError(
            f'{args.table}: {len(columns.joints)} columns are joint angles, but the arm of '
            f'{args.compensation} has {len(chain)} ({", ".join(chain.joint_names)}); name them, '
            'base to tip, with --joints'
        )
    given, units, scale = joint_values(table, columns, chain, args.angles or '')
    for joint, (_, known) in enumerate(units):
        if chain.slides[joint] and known != 'header':
            raise InputError(
                f'{args.table}: the header states no unit of {chain.joint_names[joint]}, which '
                'slides; write it there, such as [mm]'
            )
    if any(known == 'guessed' for _, known in units):
        raise InputError(
            f'{args.table}: the header states no unit of the joint angles; say --angles deg or '
            '--angles rad'
        )
    temperature = _temperature(table, columns, args.temperature)
    compensator = Compensator(compensation.model, float(np.radians(args.max_change_deg)))
    if args.inverse:
        result = compensator.true(given, temperature)
        done = compensator.correct(result, temperature)
    else:
        done = compensator.correct(given, temperature)
        result = done.command
    _refuse_beyond(table, columns, given, result, done, compensator, args)
    digits = [DIGITS.get(unit, 8) for unit, _ in units]
    write_atomically(args.out, _text(table, columns, result / scale, digits))
    wanted = result if args.inverse else given
    facts = _facts(compensator, given, result, wanted, done, times(table, columns))
    tell(args, facts, _summary(facts, args.out))
    return 0


def _shown(chain: SerialChain, joint: int, value: float, digits: int = 2) -> str:
    """Return a position or change of a joint, rad or m, in degrees or mm with its unit."""
    return chain.shown_offset(joint, value, digits).replace('deg', 'degrees')


def _temperature(table: TextTable, columns: Columns, stated: float | None) -> FloatArray | None:
    """Return the temperature of each row, °C, (n,); None if it is not known.

    ``stated``: that of the command line, for all rows, which has precedence over the table's
    column; None for none. Raises InputError if a cell of the column has no number.
    """
    column = columns.first_of_kind('temperature')
    if stated is not None:
        return np.full(len(table.rows), stated)
    return None if column is None else numbers(table, (column,))[:, 0]


def _refuse_beyond(
    table: TextTable,
    columns: Columns,
    given: FloatArray,
    result: FloatArray,
    done: Correction,
    compensator: Compensator,
    args: argparse.Namespace,
) -> None:
    """Raise InputError for implausible changes, and commands beyond the joints' limits.

    A change of more than --max-change-deg is implausible. The first such row is named, with
    its line. ``given, result``: joint positions before and after, rad or m, (n, k); ``done``:
    the correction with its commands.
    """
    chain, joints = compensator.model.chain, compensator.joint_names
    change, most = np.abs(result - given), np.radians(args.max_change_deg) * chain.per_radian
    for row, j in np.argwhere(change > most + ROUNDING_RAD)[:1]:
        raise InputError(
            f'{table.path}, line {table.lines[row]}: {joints[j]} would change by '
            f'{_shown(chain, j, change[row, j])}, more than '
            f'{_shown(chain, j, most[j])}; is it the '
            'compensation of this arm, and the unit right? (--max-change-deg)'
        )
    beyond = (done.command < chain.lower) | (done.command > chain.upper)
    for row, j in np.argwhere(beyond)[:1]:
        raise InputError(
            f'{table.path}, line {table.lines[row]}, column '
            f'{table.names[columns.joints[j]]}: the command of {joints[j]} is '
            f'{_shown(chain, j, done.command[row, j], 3)}, beyond its limits '
            f'({chain.shown_limits(j)}); keep further away from them'
        )


def _text(table: TextTable, columns: Columns, joints: FloatArray, digits: Sequence[int]) -> str:
    """Return the table as CSV text with other joint positions, everything else unchanged.

    ``joints``: (n, k), in the units of the table; ``digits``: decimals of each joint. A
    separator of several characters becomes a comma.
    """
    separator = table.separator if len(table.separator) == 1 else ','
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator, lineterminator='\n')
    if table.has_header:
        writer.writerow(table.names)
    for cells, row in zip(table.rows, joints, strict=True):
        new = list(cells)
        for column, place, behind in zip(columns.joints, row, digits, strict=True):
            new[column] = f'{place:.{behind}f}'.replace('.', table.decimal or '.')
        writer.writerow(new)
    return text.getvalue()


def _facts(
    compensator: Compensator,
    given: FloatArray,
    result: FloatArray,
    wanted: FloatArray,
    done: Correction,
    times_s: FloatArray | None,
) -> dict[str, Any]:
    """Return the summary of a correction as plain data for --json.

    Largest changes (deg, mm), added speed (%), residuals and expected error (mm), and numbers
    of rows, from 1 without the header. ``given, result``: joint positions before and after,
    (n, k); ``wanted``: those at which the expected error is computed; ``times_s``: of the
    rows; the added speed is None without increasing times.
    """
    chain, joints = compensator.model.chain, compensator.joint_names
    shown = chain.shown_scale * np.abs(result - given).max(axis=0, initial=0.0)
    change: dict[str, dict[str, float]] = {'change_deg': {}}
    for joint, unit, most in zip(joints, chain.shown_units, shown.tolist(), strict=True):
        change.setdefault(f'change_{unit}', {})[joint] = most
    added: dict[str, float | None] = dict.fromkeys(joints)
    if times_s is not None and len(times_s) > 1 and np.all(np.diff(times_s) > 0.0):
        step = np.diff(times_s)[:, None]
        before, after = (np.abs(np.diff(q, axis=0) / step).max(axis=0) for q in (given, result))
        for j, joint in enumerate(joints):
            if before[j] > 0.0:
                added[joint] = 100.0 * float(after[j] / before[j] - 1.0)
    square = np.trace(compensator.uncertainty(wanted), axis1=1, axis2=2)
    residual_mm = 1e3 * done.residual_m
    return {
        'format': FORMAT,
        'rows': len(given),
        'residual_mm': {
            'rms': float(np.sqrt(np.mean(residual_mm**2))),
            'max': float(residual_mm.max()),
        },
        **change,
        'added_speed_percent': added,
        'faded_rows': (np.flatnonzero(done.incomplete) + 1).tolist(),
        'outside_range_rows': (np.flatnonzero(done.outside_range) + 1).tolist(),
        'expected_error_mm': 1e3 * float(np.sqrt(np.mean(square))),
    }


def _summary(facts: dict[str, Any], out: Path) -> str:
    """Return the summary in `facts` as text, with the largest change in each unit.

    ``facts``: as returned by `_facts`; ``out``: path of the written table.
    """
    residual, most = facts['residual_mm'], []
    for unit in ('deg', 'mm'):
        if of_joints := facts.get(f'change_{unit}'):
            joint = max(of_joints, key=lambda name: of_joints[name])
            most.append(f'{joint} changes most, by {of_joints[joint]:.3f} {unit}')
    lines = [
        '; '.join([counted(facts['rows'], 'row'), *most]),
        f'left of the correction: {residual["rms"]:.3f} mm RMS, {residual["max"]:.3f} mm at most; '
        f'expected error of the marker {facts["expected_error_mm"]:.3f} mm RMS',
    ]
    for key, what in (
        ('faded_rows', 'in which not all of the pose is corrected, near a singularity'),
        ('outside_range_rows', 'beyond the angles at which a curve was measured'),
    ):
        if facts[key]:
            lines.append(f'{counted(len(facts[key]), "row")} {what} (--json lists them)')
    return '\n'.join([*lines, f'written: {out}'])
