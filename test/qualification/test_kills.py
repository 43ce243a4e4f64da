# SPDX-License-Identifier: Apache-2.0
"""SIGKILL of nodes in a running demo: nothing lost, nothing twice, the collection completes.

KILLS=100 makes at least as many, in complete demos of other seeds; about a minute for four.
"""

import os
import random
import signal
import time

import pytest
import yaml
from judges.kills import judge, node_processes
from rigs.ros_rig import wait_until

from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(400)]

SEED = 5
KILLS = int(os.environ.get('KILLS', '4'))
SENSOR_NODES = ('optitrack_markers', 'laser_tracker_markers')


@pytest.mark.parametrize(
    ('cell', 'options', 'seed'),
    [('quick', (), SEED)]
    + [('demo', ('--candidates', '4'), SEED + turn) for turn in range(-(-KILLS // 4))],
)
def test_killed_nodes_cost_nothing(start, tmp_path, cell, options, seed):
    """Recorder, planner, bridge and a random sensor node; with one marker, and with three."""
    print('seed', seed)
    chooser = random.Random(seed)
    out = tmp_path / 'out'
    demo = start(
        'remaster_ros.cli.main', 'demo', '--out', out, *options, '--no-figures',
        '--seed', seed, '--rate', '20',
    )  # fmt: skip
    path = out / 'session' / 'observations.csv'
    seen = set()

    def rows():
        if not path.exists():
            return -1
        text = path.read_text()
        seen.update(text[: text.rfind('\n') + 1].splitlines()[1:])
        return len(seen)

    for node in ('recorder', 'pose_planner', 'robot_bridge', chooser.choice(SENSOR_NODES)):
        before = rows()
        wait_until(
            lambda before=before: rows() > before or demo.poll() is not None, 120, 'progress'
        )
        assert demo.poll() is None, demo.communicate()
        time.sleep(chooser.uniform(0.0, 1.0))
        os.kill(node_processes(demo.pid)[node], signal.SIGKILL)

    def complete():
        rows()
        assert demo.poll() is None, demo.communicate()
        text = (out / 'session' / 'session.yaml').read_text()
        return yaml.safe_load(text)['exit_status'] == 'complete'

    wait_until(complete, 240, 'the collection to complete')
    # What follows is the fit, which is tested elsewhere.
    demo.send_signal(signal.SIGINT)
    demo.communicate(timeout=30)
    rows()
    truth = make_world(tmp_path / 'world', read_cell(cell), seed, 20.0).truth
    result = judge(out, seen, truth)
    assert result['exit_status'] == 'complete'
    assert (result['lost'], result['twice'], result['wrong']) == (0, 0, 0)
    assert result['configurations'] == result['planned_configurations'] > 5
    assert result['closest_rad'] > 1e-3
