# SPDX-License-Identifier: Apache-2.0
"""Poses chosen for what they tell, in the order of least travel, through the nodes."""

import numpy as np
import pytest
from rigs.collection_rig import Cell

from remaster_ros.collection.events import PoseAnnounced, TourPlanned
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.pose_design import Floors
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.session.records.journal import read_journal

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

DESIGN = """poses:
  design: optimal
  solutions: chosen
  order: fastest
  joint_std_deg: 0.05
"""


def test_a_designed_collection_goes_on_after_its_planner_was_killed(start, client, tmp_path):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots'))).replace('poses:\n', DESIGN, 1)
    text = text.replace('  design: latin_hypercube\n', '')
    path = tmp_path / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], candidates=6, cell=path)
    cell.until(lambda: cell.results.count('recorded') > 12, 'the first configurations')
    cell.kill_and_start('pose_planner')
    session = cell.complete()
    cell.check(session)

    planned = [body.description for body in cell.events if isinstance(body, TourPlanned)]
    assert 'expected std of the offsets' in planned[0]
    fitted = session.measurements.select(~session.measurements.is_validation)
    assert Floors().hold(fitted.pose)
    # A pose has one number, also where it was visited again for another of its solutions.
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    places = chain.forward(session.measurements.q)[:, :3, 3]
    is_other_place = np.linalg.norm(places[:, None] - places, axis=2) > 2e-3
    pose = session.measurements.pose
    np.testing.assert_array_equal(is_other_place, pose[:, None] != pose)
    # The order of the journal, before and after the kill.
    records = read_journal(cell.session / 'plan.jsonl').records
    (order,) = [record['order'] for record in records if record.get('order')]
    stops = [
        r for r in records if r['kind'] == 'stop' and r['split'] in ('optimization', 'validation')
    ]
    assert [[r['split'], r['index']] for r in stops for _ in r['ids']] == [v[:2] for v in order]
    announced = [body for body in cell.events if isinstance(body, PoseAnnounced)]
    assert len(announced) >= len(stops)
