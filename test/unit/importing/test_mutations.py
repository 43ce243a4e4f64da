# SPDX-License-Identifier: Apache-2.0
"""Plain tables and takes with one thing wrong: read right but for it, or refused."""

import json
import random
import re
from collections import Counter

import numpy as np
import pytest
import yaml
from foreign.streams import arm_of, run_of, seen, take_of
from foreign.tables import text
from test_makers import JOINTS, changed_cell, joints_of, mutated

from remaster_ros.errors import InputError
from remaster_ros.importing.column_search import find_columns
from remaster_ros.importing.text_table import read_table
from remaster_ros.importing.values import length_unit, numbers, times

NAMES = [f'P{i:02d}' for i in range(1, 9)]


def points_of(seed=5):
    return (1000.0 * np.random.default_rng(seed).uniform(-2.0, 2.0, (8, 3))).round(4)


def leica():
    points = [[f'{value:.4f}'.replace('.', ',') for value in row] for row in points_of()]
    rows = zip(NAMES, points, strict=True)
    lines = ['Messprotokoll AT960   Auftrag 4711   1 2', 'Station 1   Einheit: mm   20,8 C', '']
    lines += ['Punktname Rechtswert Hochwert H\u00f6he Datum Uhrzeit']
    lines += [f'{n} {" ".join(p)} 12.03.2026 14:05:{i:02d}' for i, (n, p) in enumerate(rows)]
    return '\r\n'.join(lines)


def spatial_analyzer():
    rows = [', '.join(f'{value:.4f}' for value in row) for row in points_of()]
    lines = [f'A::KR6::{name}, {row}' for name, row in zip(NAMES, rows, strict=True)]
    return '\n'.join(['// Working Frame: A::WORLD', '// Units: Millimeters', *lines])


def one_table():
    header = ['name', *[f'A{i} [deg]' for i in range(1, 7)], 'X [mm]', 'Y [mm]', 'Z [mm]']
    return text(header, [NAMES, *joints_of(8).T, *points_of().T], ';', ',')


def wide():
    header = [f'q{i}' for i in range(1, 7)] + [f'm{i}_{axis}' for i in (1, 2, 3) for axis in 'xyz']
    points = np.concatenate([points_of(seed) for seed in (5, 6, 7)], axis=1)
    return text(header, [*joints_of(8).T, *points.T])


def take():
    return take_of(run_of(arm_of(4)), ends_s=0.4, rate_hz=20.0)


def report():
    """A report of nominal and measured points in two lines of names, with pages and a footer."""
    rows = [';'.join(f'{v:.4f}' for v in (*row, *(row + 0.125))) for row in points_of()]
    lines = [f'{name};{row}' for name, row in zip(NAMES, rows, strict=True)]
    head = ['Report;;;;;;', ';Nominal;;;Measured;;', 'Point;X;Y;Z;X;Y;Z', ';mm;mm;mm;mm;mm;mm']
    foot = ['RMS;0.1', 'End of report']
    return '\n'.join([*head, *lines[:4], 'Page 1 of 2', *head[2:3], *lines[4:], *foot, ''])


def inspection():
    """A report with a row for each of X, Y and Z."""
    lines = ['Name\tAxis\tNominal\tMeasured\tDeviation']
    for name, row in zip(NAMES, points_of(), strict=True):
        for axis, v in zip('XYZ', row, strict=True):
            lines.append(f'{name}\t{axis}\t{v - 0.125:.4f}\t{v:.4f}\t0.1250')
    return '\n'.join([*lines, ''])


def axis_lines():
    """Names, and below each the number of each axis."""
    lines = ['Feature report']
    for name, row in zip(NAMES, points_of(), strict=True):
        lines += [f'Point {name}', *(f'{axis}\t{v:.4f}' for axis, v in zip('XYZ', row))]
    return '\n'.join([*lines, ''])


def capture():
    run = run_of(arm_of(4))
    rows = 1e3 * seen(run, np.arange(0.0, 0.4, 0.05), 1, 1e-4)
    head = ['Trajectories', '20', ',,arm:tool,,', 'Frame,Sub Frame,X,Y,Z', ',,mm,mm,mm']
    lines = [f'{i},0,{",".join(f"{v:.4f}" for v in row)}' for i, row in enumerate(rows, 1)]
    return '\n'.join([*head, *lines, ''])


def pieces():
    """A take of two pieces of one marker, which overlap."""
    run = run_of(arm_of(4))
    rows = 1e3 * seen(run, np.arange(0.0, 0.4, 0.05), 1, 1e-4)
    head = ['Format Version,1.23,Length Units,Millimeters', ',Type' + 6 * ',Marker']
    head += [',Name' + 3 * ',Unlabeled 1' + 3 * ',Unlabeled 2', ',' + 6 * ',Position']
    lines = []
    for i, row in enumerate(rows):
        cells = [f'{v:.4f}' for v in row]
        parts = [*(cells if i < 6 else 3 * ['']), *(cells if i > 2 else 3 * [''])]
        lines.append(f'{i},{i / 20:.3f},{",".join(parts)}')
    return '\n'.join([*head, 'Frame,Time (Seconds),X,Y,Z,X,Y,Z', *lines, ''])


def json_lines():
    """An object a line."""
    rows = zip(NAMES, joints_of(8).tolist(), points_of().tolist(), strict=True)
    return '\n'.join(json.dumps({'name': n, 'angles': q, 'marker': p}) for n, q, p in rows)


def yaml_records():
    """Records as a block of YAML."""
    rows = zip(NAMES, joints_of(8).tolist(), points_of().tolist(), strict=True)
    records = [{'name': n, 'angles': q, 'marker': dict(zip('xyz', p))} for n, q, p in rows]
    return yaml.safe_dump(records, sort_keys=False)


def qualisys():
    """A capture of one marker."""
    head = ['NO_OF_FRAMES\t8', 'FREQUENCY\t20', 'DATA_INCLUDED\t3D', 'MARKER_NAMES\ttool']
    head += ['Frame\tTime\ttool X\ttool Y\ttool Z']
    rows = enumerate(points_of().tolist(), 1)
    lines = [f'{i}\t{i / 20:.3f}\t' + '\t'.join(f'{v:.4f}' for v in p) for i, p in rows]
    return '\n'.join([*head, *lines, ''])


def pacscript():
    """Joints of Denso, eight axes."""
    rows = enumerate(joints_of(8).tolist(), 10)
    lines = [f'  J[{i}] = J({", ".join(f"{v:.4f}" for v in q)}, 0, 0)' for i, q in rows]
    return '\n'.join(['Sub Main', '  TakeArm Keep = 0', *lines, 'End Sub', ''])


def replies():
    """A log of replies with times."""
    rows = enumerate(joints_of(8).tolist())
    lines = [
        f'[2026-03-02 10:00:{i:02d}] Recv: 0,{{{",".join(f"{v:.4f}" for v in q)}}},GetAngle();'
        for i, q in rows
    ]
    return '\n'.join(['[2026-03-02 09:59:59] Send: GetAngle()', *lines, ''])


KINDS = {
    'json_lines': (json_lines, True),
    'yaml_records': (yaml_records, False),
    'qualisys': (qualisys, True),
    'pacscript': (pacscript, True),
    'replies': (replies, True),
    'report': (report, True),
    'inspection': (inspection, False),
    'axis_lines': (axis_lines, False),
    'capture': (capture, True),
    'pieces': (pieces, False),
    'leica': (leica, True),
    'spatial_analyzer': (spatial_analyzer, True),
    'one_table': (one_table, True),
    'wide': (wide, True),
    'take': (take, False),
}


def cells_of(table):
    """Return the cells of joints and points, counted; () where the table has not both kinds."""
    found = find_columns(table, JOINTS)
    columns = (*found.joints, *found.point)
    values = numbers(table, columns, optional=True)
    assert np.all(np.isnan(values) | np.isfinite(values))
    times(table, found)
    if found.point:
        length_unit(table, found, '', values[:, -3:], values[:, -3:])
    return columns, Counter(tuple(row[i] for i in columns) for row in table.rows)


@pytest.mark.parametrize(
    ('count', 'seed'), [(60, 21), pytest.param(2000, 22, marks=pytest.mark.qualify)]
)
@pytest.mark.parametrize('kind', KINDS)
def test_a_mutated_table_is_read_right_or_refused(kind, count, seed, tmp_path):
    print(f'mutations of {kind}: {count}, seed {seed}')
    rng = random.Random(seed)
    make, one_line = KINDS[kind]
    content, path = make(), tmp_path / 'table.txt'
    path.write_bytes(content.encode())
    columns, true = cells_of(read_table(path))
    read, refusals = 0, []
    for _ in range(count):
        marks = '#/!*' + "'" * (kind == 'pacscript')
        broken, may_lose = mutated(rng, content, one_line, [*marks])
        path.write_bytes(broken.encode())
        try:
            found, rows = cells_of(read_table(path))
        except InputError as error:
            refusals.append(str(error))
            continue
        if len(found) != len(columns) or sum(rows.values()) < 2:
            # What `read_rows` refuses: joints or points are not there; and a title left alone.
            continue
        read += 1
        other = [row for row in (rows - true).elements() if row not in true]
        number = re.escape(changed_cell(other, true, broken))
        assert not number or re.search(rf'(?<![\w.]){number}(?![\w.])', broken), (number, broken)
        lost = sum((true - rows).values())
        assert may_lose or lost <= len(other), broken
    assert read > 0
    assert all(str(path) in text for text in refusals)
