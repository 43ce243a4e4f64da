# SPDX-License-Identifier: Apache-2.0
"""`remaster fit` where something else than the offsets is wrong: not green, and why."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import remaster

from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Session


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp('made') / 'session'
    remaster('simulate', folder, '--seed', 2, '--quiet')
    return read_session(folder)


def fitted(session: Session, folder: Path) -> tuple[dict, str, str]:
    """Return fit.json, the mood of the report's verdict, and what was printed."""
    write_session(folder / 'session', session)
    process = remaster('fit', folder / 'session', '--out', folder / 'fit')
    page = (folder / 'fit' / 'report.html').read_text(encoding='utf-8')
    mood = re.search(r'class="verdict (\w+)"', page)
    assert mood is not None
    fit = json.loads((folder / 'fit' / 'fit.json').read_text(encoding='utf-8'))
    explained = all(check['explained'] for check in fit['explained_by_noise'].values())
    assert ('other errors dominate' in page) != explained
    return fit, mood[1], process.stdout


def test_a_healthy_arm_is_green(made: Session, tmp_path: Path) -> None:
    fit, mood, out = fitted(made, tmp_path)
    assert mood == 'good'
    assert 'other errors dominate' not in out
    for check in fit['explained_by_noise'].values():
        assert check['explained'] is True
        # 0.1 mm per axis, which simulate adds; it states none.
        assert check['within_pose_std_m'] == pytest.approx(0.1e-3, rel=0.2)
        assert check['stated_std_m'] is None


@pytest.mark.parametrize(
    'share',
    [
        pytest.param(0.25, id='while fitting', marks=pytest.mark.qualify),
        pytest.param(0.5, id='before the held-out poses'),
    ],
)
def test_a_tracker_that_was_moved_4_mm_is_not(made: Session, tmp_path: Path, share: float) -> None:
    m = made.measurements
    tracker = list(made.sensors).index('tracker')
    moved = (m.sensor == tracker) & (m.observation > share * len(m))
    position = m.position + 4e-3 * moved[:, None] * np.array([0.0, 1.0, 0.0])
    session = replace(made, measurements=replace(m, position=position))
    fit, mood, out = fitted(session, tmp_path)
    metrics = fit['accuracy']['validation']['post_registration']
    # It gains all the same, which is not enough.
    assert metrics['before']['mean_mm'] > 1.3 * metrics['after']['mean_mm'] > 1.3
    assert mood == ('caution' if fit['sampler']['converged'] else 'bad')
    assert fit['explained_by_noise']['mocap']['explained'] is True
    check = fit['explained_by_noise']['tracker']
    assert check['explained'] is False
    assert check['after_m'] > 8 * check['noise_m']
    # The fitted noise takes up the misfit where it was fitted.
    assert (fit['noise']['tracker']['pose_sigma_m'] > 1e-3) == (share < 0.5)
    # What is printed is the verdict of the file and of the page.
    for line in (fit['judgement']['headline'], *fit['judgement']['points']):
        assert line in out.splitlines()
    assert 'run "remaster discover"' in fit['judgement']['headline']
    assert any(line.startswith('tracker: the error') for line in fit['judgement']['findings'])
