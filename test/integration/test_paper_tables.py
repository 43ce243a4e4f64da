# SPDX-License-Identifier: Apache-2.0
"""Tables V to VII of the paper follow from its own Tables I and II, joints 1 and 7 counted."""

import re
from pathlib import Path

import numpy as np
import pytest
from worlds.paper_convention import errors, random_configurations
from worlds.paper_experiment import OPTIMIZATION, VALIDATION, choose_poses
from worlds.paper_published import ERRORS

SEED = 2
PAGE = Path(__file__).resolve().parents[2] / 'benchmarks' / 'PAPER.md'
CELL = re.compile(r'([\d.]+) \[([\d.]+), ([\d.]+)\]')


@pytest.mark.parametrize('number', ['V', 'VI', 'VII'])
@pytest.mark.parametrize('sensor', ['mocap', 'tracker'])
def test_the_means_are_the_papers(sensor, number):
    """Of 1,000 random configurations the mean before scatters by 1.3 %, the rest by less."""
    print(f'seed {SEED}')
    rng = np.random.default_rng(SEED)
    poses = choose_poses((OPTIMIZATION, VALIDATION), rng)[0]
    q = np.concatenate(poses) if number == 'V' else random_configurations(rng)
    found = errors(sensor, q, rng, noise=number != 'VII')
    for ours, (mean, *_) in zip(found, ERRORS[number][sensor], strict=True):
        assert ours['mean_mm'] == pytest.approx(mean, rel=0.08)


def test_the_page_has_them():
    page = PAGE.read_text(encoding='utf-8')
    for number in ('V', 'VI', 'VII'):
        text = page.split(f'## Table {number}: ')[1].split('\n## ')[0]
        assert "the paper's convention" in text
        rows = [line for line in text.splitlines() if CELL.search(line)]
        assert len(rows) == 4
        for row in rows:
            cells = [float(mean) for mean, _, _ in CELL.findall(row)]
            assert cells[-1] == pytest.approx(cells[0], rel=0.06)
    row = '| Bayesian | Motion Capture | 1.439 ['
    (after,) = (line for line in page.splitlines() if line.startswith(row))
    found = [float(value) for value in CELL.findall(after)[-1]]
    np.testing.assert_allclose(found, [1.436, 0.419, 2.760], atol=0.01)
