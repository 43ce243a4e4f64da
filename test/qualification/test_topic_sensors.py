# SPDX-License-Identifier: Apache-2.0
"""Collections through topics of other packages' nodes: every fault, kills of every node."""

import pytest
from rigs.topic_rig import Collection

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

REPETITIONS = 3


@pytest.mark.parametrize('repetition', range(REPETITIONS))
def test_every_fault_and_kill_in_one_collection(start, client, tmp_path, repetition):
    c = Collection(start, client, tmp_path, candidates=12, rate=5.0)
    # Few messages: the dwell is prolonged, and the reading is taken all the same.
    c.spoil('mocap', c.says('mocap', 'fewer than min_rate_hz'), slow=20)
    c.spoil('mocap', c.refused('mocap: scattered'), jumping=1)
    c.spoil('tracker', c.refused('tracker: scattered'), jumping=1)
    c.spoil('mocap', c.waits_for('repeats one position to the last bit'), frozen=1)
    for sensor in ('mocap', 'tracker'):
        c.spoil(sensor, c.waits_for('synchronise the clocks'), late=60.0)
        c.spoil(sensor, c.waits_for('synchronise the clocks'), late=-60.0)
    # It stops and comes back: the arm waits for one that sends always; the other may have its
    # marker out of sight, which the arm has to move on for.
    c.spoil('mocap', c.waits_for('nothing on /vrpn_mocap/tool/pose'), stopped=1)
    c.spoil('tracker', c.refused('tracker: stale'), stopped=1)
    for sensor, shows in (
        ('mocap', c.waits_for('nothing on /vrpn_mocap/tool/pose')),
        ('tracker', c.says('tracker', 'is the marker in view?')),
    ):
        c.kill_source(sensor, shows)
    for node in ('topic_markers_mocap', 'topic_markers_tracker', 'recorder', 'pose_planner'):
        c.kill(node)
    c.kill('robot_bridge')
    c.finish()
