"""Which token recorder and bridge hold after what the planner said."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.nodes.status import run_after

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    ('held', 'state', 'run', 'after'),
    [
        ('', 'running', 'a', 'a'),
        ('a', 'running', 'b', 'b'),
        # Waiting for room on the disk is a part of the run.
        ('a', 'held', 'a', 'a'),
        # A planner that was started again, and asks whether the run still lives.
        ('a', 'idle', '', 'a'),
        # Of another version, or a stand-in.
        ('a', 'running', '', 'a'),
        # Ended: whoever is started again must not go on.
        ('a', 'paused', '', ''),
        ('a', 'stopped', '', ''),
        ('a', 'failed', '', ''),
        ('a', 'complete', '', ''),
        # A token counts in a run alone.
        ('', 'idle', 'a', ''),
    ],
)
def test_the_token_lives_as_long_as_the_run(held, state, run, after):
    assert run_after(held, {'state': state, 'run': run}) == after
