# SPDX-License-Identifier: Apache-2.0
"""Re-mastered as the file says, in the pad's own numbers, an arm has no zero-offsets left.

Measured on a controller whose pad counts otherwise than the URDF, imported, fitted, re-mastered
by the text of remaster.txt, measured again, imported, fitted: for each option of the import and
for pairs of them.
"""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from foreign.tables import MARKER, text, write
from judges.pad import Axis, Keeps, Pad, master_as_told
from rigs.command_line import remaster
from worlds.robot_descriptions import ROBOTS

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, rotation_vector_to_matrix, transform
from remaster_ros.session.records.reader import read_session

CASES = Path(__file__).parents[3] / 'shared' / 'cases'
ROWS, NOISE_M = 36, 3e-5
# Each offset of the second fit is compared with 0 in its own standard deviation and that of the
# first fit together: 60 comparisons of normal errors pass 4.5 by chance once in 2,500 runs.
SIGMAS = 4.5
# What the pad's digits (0.0001 degrees, and 0.001 in the table) leave.
DIGITS_DEG = 1e-3

QUICK = ('--no-figures', '--quiet')

NAMES = [f'A{i}' for i in range(1, 7)]
JOINTS = [f'joint_{i}' for i in range(1, 7)]


def axes_of(options: set[str]) -> tuple[list[Axis], str, list[str]]:
    """Return the axes in the order of the table, the unit, and what the import is told."""
    axes = [Axis(name, joint) for name, joint in zip(NAMES, JOINTS, strict=True)]
    unit, arguments = 'deg', []
    if 'couple' in options:
        axes[2].added = ('A2', 1)
        arguments += ['--couple', 'A3=A2']
    if 'reverse' in options:
        # With a coupling both of its joints count the other way round.
        for axis in axes[1:3]:
            axis.sign = -1
        arguments += ['--reverse', 'A2,A3']
    if 'offset' in options:
        axes[1].zero = 90.0
        axes[4].zero = -90.0
        arguments += ['--offset', 'A2=90', '--offset', 'A5=-90']
    if 'radians' in options:
        unit = 'rad'
        arguments += ['--angles', 'rad']
    if 'order' in options:
        axes[3], axes[4] = axes[4], axes[3]
        # The joint keeps the name of its column.
        arguments += ['--joints', ','.join(axis.name for axis in sorted(axes, key=_base_to_tip))]
    return axes, unit, arguments


def _base_to_tip(axis: Axis) -> str:
    return axis.joint


class Cell:
    """An arm with wrong zeros, its pad, and a tracker."""

    def __init__(self, folder: Path, options: set[str], keeps: Keeps, seed: int) -> None:
        print(f'seed {seed}, {sorted(options)}, {keeps}')
        description = ROBOTS['irb120']()
        (folder / 'robot.urdf').write_text(description.urdf)
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self.chain = SerialChain.from_urdf(
            description.urdf, description.base_link, description.tip_link
        )
        self.axes, unit, self.told = axes_of(options)
        self.wrong = dict(zip(JOINTS, self.rng.uniform(0.2, 0.7, 6) * [1, -1, 1, 1, -1, 1]))
        self.pad = Pad(self.axes, self.wrong, unit, keeps)
        turn = rotation_vector_to_matrix(self.rng.standard_normal(3))
        self.T_N_R = transform(turn, (2.5, -0.8, 0.4))

    def measured(self, name: str) -> Path:
        """Return the table of a tour: what the pad shows, and the tracker's points."""
        low, high = np.maximum(self.chain.lower, -2.0), np.minimum(self.chain.upper, 2.0)
        q = self.rng.uniform(low, high, (ROWS, 6))
        shown = np.empty((ROWS, 6))
        for row, angles in enumerate(q):
            for axis in self.axes:
                self.pad.true[axis.name] = np.degrees(angles[JOINTS.index(axis.joint)])
            for column, axis in enumerate(self.axes):
                shown[row, column] = round(self.pad.shows(axis.name), 6)
        points = apply(self.T_N_R, self.chain.positions(q, MARKER, np.zeros(6)))
        points += self.rng.normal(0.0, NOISE_M, points.shape)
        header = [*(axis.name for axis in self.axes), 'X_mm', 'Y_mm', 'Z_mm']
        return write(self.folder, name, text(header, [*shown.T, *(1e3 * points.T)]))

    def fitted(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
        """Measure, import, fit; return offsets and stds, degrees, what is known, remaster.txt."""
        session, out = self.folder / name, self.folder / f'{name}_fit'
        table, urdf = self.measured(f'{name}.csv'), self.folder / 'robot.urdf'
        remaster('import', table, '--urdf', urdf, '--out', session, *self.told, '--quiet')
        remaster('fit', session, '--out', out, *QUICK)
        rows = json.loads((out / 'fit.json').read_text())['joint_offsets']
        assert [row['joint'] for row in rows] == JOINTS
        instructions = (out / 'apply' / 'remaster.txt').read_text(encoding='utf-8')
        return (
            np.array([row['mean_deg'] for row in rows]),
            np.array([row.get('std_if_exactly_drawn_deg', row['std_deg']) for row in rows]),
            np.array([row['identifiable'] for row in rows]),
            instructions,
        )


def page_of(session: Path, fit: Path) -> str:
    """Return the text of the page of ``remaster report``."""
    out = fit.with_name('page')
    remaster('report', session, fit, '--out', out, '--no-figures', '--quiet')
    html = (out / 'report.html').read_text(encoding='utf-8')
    return ' '.join(re.sub('<[^>]+>', ' ', html).split())


OPTIONS = ('couple', 'reverse', 'offset', 'radians', 'order')
PAIRS = [set(pair) for pair in combinations(OPTIONS, 2)]
# Each option once at least, and those together that change the same joint.
SOON = ('couple', 'reverse')
SOON_TOGETHER = [
    {'couple', 'reverse'},
    {'couple', 'offset'},
    {'reverse', 'offset'},
    {'radians', 'order'},
]
INNER = [False, True, True, True, True, False]


@pytest.mark.parametrize(
    'option',
    [pytest.param(o, marks=() if o in SOON else pytest.mark.qualify) for o in OPTIONS],
)
def test_re_mastered_as_told_and_measured_again_no_offset_is_left(option, tmp_path):
    cell = Cell(tmp_path, {option}, 'motors', seed=OPTIONS.index(option))
    found, std, known, instructions = cell.fitted('before')
    print(instructions)
    assert known.tolist() == INNER
    true = np.array(list(cell.wrong.values()))
    assert np.all(np.abs(found - true)[known] < SIGMAS * std[known] + DIGITS_DEG)
    master_as_told(instructions, cell.pad)
    remaining, std_again, _, _ = cell.fitted('after')
    limit = SIGMAS * np.hypot(std, std_again) + DIGITS_DEG
    assert np.all(np.abs(remaining) < limit, where=known), (remaining, limit)
    # And far from the offsets that there were.
    assert np.all(limit < 0.1 * np.abs(true), where=known)


@pytest.mark.parametrize(
    'options',
    [pytest.param(p, marks=() if p in SOON_TOGETHER else pytest.mark.qualify) for p in PAIRS],
    ids=lambda options: '+'.join(sorted(options)),
)
def test_pairs_of_options_leave_the_controller_without_offsets(options, tmp_path):
    """Of the controller itself, whatever it keeps, and also where it sets nothing but 0."""
    kinds: list[Keeps] = ['motors', 'shown']
    cell = Cell(tmp_path, options, kinds[0], seed=10 + PAIRS.index(options))
    _, std, known, instructions = cell.fitted('before')
    assert known.tolist() == INNER
    for keeps in kinds:
        for only_zero in (False, True):
            pad = Pad(cell.axes, cell.wrong, cell.pad.unit, keeps)
            before = np.array([pad.missing()[joint] for joint in JOINTS])
            np.testing.assert_allclose(before, list(cell.wrong.values()), atol=1e-9)
            master_as_told(instructions, pad, only_zero)
            remaining = np.array([pad.missing()[joint] for joint in JOINTS])
            assert np.all(np.abs(remaining[known]) < SIGMAS * std[known] + DIGITS_DEG), (
                keeps,
                remaining,
            )
            assert SIGMAS * std[known].max() < 0.1 * np.abs(before[known]).min()
            # What the data do not determine stays as it was.
            np.testing.assert_allclose(remaining[~known], before[~known], atol=1e-9)


def test_a_joint_of_unknown_zero_keeps_it_where_another_is_added_to_it(tmp_path):
    """With A6 = pad + A5 a new zero of joint 5 moves what the pad has to show of joint 6."""
    cell = Cell(tmp_path, set(), 'shown', seed=30)
    cell.axes[5].added = ('A5', 1)
    cell.told = ['--couple', 'A6=A5']
    cell.pad = Pad(cell.axes, cell.wrong, 'deg', 'shown')
    _, std, known, instructions = cell.fitted('before')
    print(instructions)
    assert known.tolist() == INNER
    for keeps in ('motors', 'shown'):
        pad = Pad(cell.axes, cell.wrong, 'deg', keeps)
        master_as_told(instructions, pad)
        remaining = np.array([pad.missing()[joint] for joint in JOINTS])
        assert np.all(np.abs(remaining[known]) < SIGMAS * std[known] + DIGITS_DEG)
        np.testing.assert_allclose(remaining[5], cell.wrong['joint_6'], atol=2e-4)
    page = page_of(tmp_path / 'before', tmp_path / 'before_fit')
    assert 'Leave A1 (joint_1) as it is' in page


@pytest.mark.parametrize(
    ('table', 'urdf', 'arguments', 'drive_to', 'set_to'),
    [
        ('1_reversed_pad', 'irb120', ['--reverse', 'A3'], {'A3': -0.2876}, {'A3': 0.0}),
        ('1_zero_90_off_pad', 'irb120', ['--offset', 'A2=90'], {'A2': -89.4682}, {'A2': -90.0}),
        (
            '1_fanuc_coupled',
            'fanuc_lrmate',
            ['--couple', 'J3=J2'],
            # From the true offsets -0.397 and -0.075: -(-0.075 + 0.397) on joint 3.
            {'J2': 0.397, 'J3': -0.322},
            {'J2': 0.0, 'J3': 0.0},
        ),
    ],
)
def test_tables_of_pads_that_count_otherwise(table, urdf, arguments, drive_to, set_to, tmp_path):
    if not CASES.is_dir():
        pytest.skip('the tables of other pads are not part of this repository')
    session, out = tmp_path / 'session', tmp_path / 'fit'
    given = (CASES / f'{table}.csv', '--urdf', CASES / f'{urdf}.urdf', *arguments)
    remaster('import', *given, '--out', session, '--quiet')
    remaster('fit', session, '--out', out, *QUICK)
    text_file = (out / 'apply' / 'remaster.txt').read_text(encoding='utf-8')
    page = page_of(session, out)
    for name, angle in drive_to.items():
        (row,) = [line for line in text_file.splitlines() if re.match(rf'  {name} +joint_', line)]
        cells = re.split(r' {2,}', row.strip())
        shown, makes = (float(cell.removesuffix(' deg')) for cell in cells[-2:])
        # The page states the text's numbers, and both are the truth's.
        assert shown == pytest.approx(angle, abs=3e-3)
        assert makes == set_to[name]
        for value in (shown, makes):
            assert f'{value:+.4f} deg'.replace('-', '−') in page
    for name in ('offset_layer.yaml', 'robot_calibrated.urdf'):
        applied = (out / 'apply' / name).read_text(encoding='utf-8')
        assert 'not in those of the pad' in applied
    # It is kept, and read as it was written.
    again = read_session(session).controller
    assert again is not None
    assert list(again.joints) == JOINTS
    assert [joint.name for joint in again.joints.values()][:3] in (NAMES[:3], ['J1', 'J2', 'J3'])
