# SPDX-License-Identifier: Apache-2.0
"""Three markers of the bar through the nodes: one is hidden, the recorder is killed."""

import numpy as np
import pytest
from rigs.collection_rig import Cell

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.bags.bag import BagReader
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.simulation.faults import inject

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


def test_markers_of_a_frame_are_recorded_together_and_a_hidden_one_costs_nothing(
    start, client, tmp_path
):
    text = config_path('cells/quick.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots')))
    path = tmp_path / 'cell.yaml'
    text = text.replace('design: optimal', 'design: latin_hypercube')
    kept = [line for line in text.splitlines() if not line.startswith('  joint_std')]
    path.write_text('\n'.join(kept), encoding='utf-8')
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], cell=path)
    cell.until(lambda: len(cell.results) > 4, 'the first configurations')
    inject(tmp_path / 'world', {'mocap': {'hidden': 1}})
    hidden_from = len(cell.results)
    cell.until(lambda: len(cell.results) > hidden_from + 2, 'some with a hidden marker')
    inject(tmp_path / 'world', {})
    cell.kill_and_start('recorder')
    session = cell.complete()

    m, truth = session.measurements, cell.world.truth
    assert session.further_markers == {'mocap': ('sir_2', 'sir_3')}
    names = np.array(session.marker_names)[m.marker]
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    for name in ('sir', 'sir_2', 'sir_3'):
        mine = names == name
        expected = truth.without_noise(chain, 'mocap', m.q[mine], name)
        assert np.all(np.linalg.norm(m.position[mine] - expected, axis=1) < 0.4e-3), name
    # Each marker once in a configuration, and where one was hidden (at times the bar loses one
    # by itself) the others.
    of = [sorted(names[m.configuration == number]) for number in np.unique(m.configuration)]
    assert all(len(set(found)) == len(found) > 1 for found in of), of
    assert 2 <= sum('sir' not in found for found in of) < len(of) - 3
    np.testing.assert_array_equal(m.frame, m.configuration)
    # On a busy machine a recorder that starts again is waited for in vain, or few frames arrive
    # in time, which the plan says.
    ended = cell.ended(session)
    assert sum(ended.values()) == cell.planned() > 3
    lost = ended['failed'] + ended['rejected']
    assert lost <= 2, ended
    assert len(of) == cell.planned() - lost, ended

    stamps: dict[str, set[int]] = {}
    from geometry_msgs.msg import PointStamped
    from rclpy.serialization import deserialize_message

    hidden = 0
    for message in BagReader(cell.session / 'bag'):
        if message.topic.startswith('/optitrack/marker'):
            point = deserialize_message(message.cdr, PointStamped)
            stamp = point.header.stamp
            stamps.setdefault(message.topic, set()).add(stamp.sec * 10**9 + stamp.nanosec)
            hidden += message.topic == '/optitrack/marker' and np.isnan(point.point.x)
    first, second, third = (
        stamps[f'/optitrack/marker{name}'] for name in ('', '/sir_2', '/sir_3')
    )
    # Equal stamps in a frame, but for those that a bag began or ended in.
    assert len(first & second & third) > 0.98 * len(first | second | third)
    assert hidden > 10
