# SPDX-License-Identifier: Apache-2.0
"""A laser tracker with two reflectors: one after another at each standstill, also after a kill."""

import numpy as np
import pytest
from rigs.collection_rig import Cell

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.simulation.faults import inject

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.qualify
def test_reflectors_are_measured_one_after_another(start, client, tmp_path):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    for old, new in (
        ('../robots', str(config_path('robots'))),
        ('smr: [-0.1, 0.0, 0.0]', 'smr: [-0.1, 0.0, 0.0]\n  smr_2: [0.0, -0.09, 0.03]'),
        ('marker: smr\n', 'marker: smr\n    further_markers: {smr_2: 2}\n'),
    ):
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    cell = Cell(start, client, tmp_path, 'tracker', ['tracker'], cell=path)
    cell.until(lambda: cell.results.count('recorded') > 4, 'the first configurations')
    inject(tmp_path / 'world', {'tracker': {'hidden': 2}})
    hidden_from = len(cell.results)
    cell.until(lambda: len(cell.results) > hidden_from + 2, 'some with a hidden reflector')
    inject(tmp_path / 'world', {})
    cell.kill_and_start('laser_tracker_markers')
    session = cell.complete()

    m, truth = session.measurements, cell.world.truth
    assert session.further_markers == {'tracker': ('smr_2',)}
    names = np.array(session.marker_names)[m.marker]
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    for name in ('smr', 'smr_2'):
        mine = names == name
        expected = truth.without_noise(chain, 'tracker', m.q[mine], name)
        assert np.all(np.linalg.norm(m.position[mine] - expected, axis=1) < 0.15e-3), name
    of = [names[m.configuration == number].tolist() for number in np.unique(m.configuration)]
    assert all(len(set(found)) == len(found) for found in of), of
    assert len(of) == cell.planned() > 5
    pairs = [found for found in of if len(found) == 2]
    assert 2 <= len(of) - len(pairs) < len(of) - 3, of
    # The one that was measured last is measured first.
    assert {tuple(found) for found in pairs} == {('smr', 'smr_2'), ('smr_2', 'smr')}
    # Each has a time of its own, and they share no frame.
    assert len(set(m.stamp_s.tolist())) == len(m)
    assert np.all(m.frame == -1)
