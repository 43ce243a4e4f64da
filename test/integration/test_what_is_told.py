# SPDX-License-Identifier: Apache-2.0
"""What a person is told of pure noise, of readings paired wrongly and of backlash.

By the real commands. Terminal, JSON and pages have one verdict.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import ROOT, remaster

from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Session

CASES = ROOT.parent / 'shared' / 'cases'
# Words for errors that noise does not explain.
MORE = ('does not explain', 'More than noise', 'other errors dominate', 'does not have')


def results_of(session: Path, folder: Path) -> tuple[str, dict, dict, dict]:
    """Fit, discover and report; return all that was printed, and the three results."""
    printed = ''
    for verb, *more in (
        ('fit', '--out', folder / 'fit'),
        ('discover', '--out', folder / 'causes'),
        ('report', folder / 'fit', folder / 'causes', '--out', folder / 'page'),
    ):
        process = remaster(verb, session, *more, '--no-figures')
        printed += process.stdout
    fit = json.loads((folder / 'fit' / 'fit.json').read_text(encoding='utf-8'))
    found = json.loads((folder / 'causes' / 'discovery.json').read_text(encoding='utf-8'))
    page = (folder / 'page' / 'report.html').read_text(encoding='utf-8')
    for result in (fit, found):
        assert result['judgement']['headline'] in printed.splitlines()
    options = (folder / 'fit', folder / 'causes', '--out', folder / 'page', '--no-figures')
    answer = json.loads(remaster('report', session, *options, '--json').stdout)
    return printed + page, fit, found, answer


def simulated(folder: Path, *options: object) -> Path:
    remaster('simulate', folder, '--quiet', *options)
    return folder


def test_a_table_of_pure_noise_is_not_said_to_be_more(tmp_path: Path) -> None:
    """No reading has a standard deviation and no pose two solutions: a doubt, and no finding."""
    if not CASES.is_dir():
        pytest.skip('needs the small inputs of ../shared/cases')
    tables = (CASES / '13_pure_noise_joints.csv', CASES / '13_pure_noise_points.csv')
    session = tmp_path / 'session'
    urdf = CASES / 'kr6.urdf'
    remaster('import', *tables, '--urdf', urdf, '--out', session)
    text, fit, found, answer = results_of(session, tmp_path)
    assert found['verdict'] == 'none'
    assert not any(words in text for words in MORE)
    assert fit['explained_by_noise']['sensor']['explained'] is None
    assert fit['judgement']['findings'] == []
    assert len(fit['judgement']['doubts']) == 1
    assert [row['what'] for row in answer['remains']] == ['Noise']
    assert answer['action'] == 'set'


# Of each session one in a hundred by chance has structure, by the levels of the tests.
@pytest.mark.parametrize(
    ('robot', 'seed'),
    [
        pytest.param(
            robot, seed, marks=[] if (robot, seed) == ('lwr4plus', 1) else [pytest.mark.qualify]
        )
        for robot in ('lwr4plus', 'iiwa7', 'iiwa14')
        for seed in (1, 2, 3, 4)
    ],
)
def test_simulated_noise_is_noise(robot: str, seed: int, tmp_path: Path) -> None:
    options = ('--robot', robot, '--sensors', 'mocap', '--pose-noise-mm', 0, '--seed', seed)
    session = simulated(tmp_path / 'session', '--poses', 20, '--validation', 10, *options)
    text, fit, found, answer = results_of(session, tmp_path)
    assert found['verdict'] == 'none'
    assert not any(words in text for words in MORE)
    assert fit['judgement']['findings'] == []
    assert [row['what'] for row in answer['remains']] == ['Noise']


def paired_wrongly(session: Session, share: float) -> Session:
    """Exchange readings of some rows, drawn at random, of each sensor."""
    rng, m = np.random.default_rng(1), session.measurements
    position = m.position.copy()
    for sensor in range(len(session.sensor_names)):
        rows = np.flatnonzero(m.sensor == sensor)
        chosen = rng.choice(rows, int(share * len(rows)), replace=False)
        position[chosen] = position[np.roll(chosen, 1)]
    return replace(session, measurements=replace(m, position=position))


def test_a_few_readings_paired_wrongly_do_not_decide_and_are_told(tmp_path: Path) -> None:
    """5 % of the rows, which make the error on held-out poses hundreds of times the noise."""
    options = ('--poses', 22, '--validation', 12, '--seed', 7)
    session = read_session(simulated(tmp_path / 'clean', *options))
    write_session(tmp_path / 'session', paired_wrongly(session, 0.05))
    text, fit, found, answer = results_of(tmp_path / 'session', tmp_path)
    gain = found['gain']
    assert gain['held_out_rms_after_m'] > 50 * gain['noise_floor_m']
    assert gain['held_out_kept_after_m'] < 1.5 * gain['noise_floor_m']
    assert gain['held_out_gross'] >= 1
    judged = found['judgement']
    assert judged['mood'] == 'caution'
    assert 'Nothing is there' not in text
    outliers = len(found['noise']['outliers'])
    assert f'{outliers} of {len(session.measurements)} readings are gross errors' in text
    # Whatever 5 % of the rows do, the offsets of the others hold.
    assert answer['action'] == 'set'
    assert answer['not_counted'] == gain['held_out_gross']
    assert answer['stages'][1]['mean_mm'] < 1.0
    assert fit['judgement']['mood'] == 'caution'


def test_backlash_is_no_slip(tmp_path: Path) -> None:
    """Its form is a step, over the side of approach: the zero-offsets hold all the time."""
    options = ('--poses', 30, '--validation', 15, '--sensors', 'mocap', '--seed', 5)
    session = simulated(tmp_path / 'session', *options, '--effect', 'backlash@4:0.5')
    text, _, found, answer = results_of(session, tmp_path)
    (effect,) = found['effects']
    assert (effect['name'], effect['form'], effect['moment_s']) == ('backlash', 'step', None)
    assert answer['action'] == 'set'
    assert 'Set nothing yet' not in text
    assert 'slipped' not in text
    # No file corrects it: what is left of the error with what can be loaded is the backlash's.
    offsets, *_, every = (row['held_out_mean_mm'] for row in found['loadable'])
    total = found['metrics']['post_registration']['after']['mean_mm']
    assert total < 0.7 * offsets
    assert every > 0.9 * offsets
