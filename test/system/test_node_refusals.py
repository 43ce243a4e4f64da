# SPDX-License-Identifier: Apache-2.0
"""A node that cannot work ends with one error line and status 2."""

import socket
import subprocess
import sys

import pytest
from rigs.ros_rig import node_arguments
from worlds.sliding_cells import sliding_cell, telescope

from remaster_ros.errors import InputError

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]


def refuse(start, node, *, timeout=900, **parameters):
    """Start a node that must refuse; return its one line."""
    module = 'remaster_ros.demo' if node == 'demo' else f'remaster_ros.nodes.{node}'
    process = start(module, *node_arguments(**parameters))
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == 2, out + err
    lines = [line for line in err.splitlines() if line.startswith('error:')]
    assert len(lines) == 1, err
    assert 'Traceback' not in err
    return lines[0]


def test_a_parameter_out_of_range(start):
    line = refuse(start, 'robot_bridge', speed_share=1.5)
    assert 'robot_bridge: parameter speed_share is 1.5; it must lie in 0.01 to 1.0' in line


def test_an_unknown_parameter(start):
    line = refuse(start, 'robot_bridge', sped_share=0.3)
    assert "unknown parameter 'sped_share'" in line
    assert 'speed_share' in line.replace('sped_share', '')


def test_a_missing_cell_file(start, tmp_path):
    assert 'nowhere.yaml' in refuse(start, 'pose_planner', cell=tmp_path / 'nowhere.yaml')


@pytest.mark.parametrize(
    ('node', 'parameters', 'why'),
    [
        ('demo', {'apply': True}, 'no node corrects what such an arm is commanded'),
        (
            'robot_bridge',
            {'compensation': 'c.json', 'emergency_stop_topic': 'none'},
            'leave the parameter compensation empty',
        ),
    ],
)
def test_what_an_arm_with_a_joint_that_slides_is_not_for(node, parameters, why, start, tmp_path):
    cell = sliding_cell(tmp_path, telescope(), held_joint='joint_3', held_values_m=[0.0])
    given = {'out': tmp_path / 'out'} if node == 'demo' else {}
    line = refuse(start, node, cell=cell, **parameters, **given)
    assert "joint 'joint_3'" in line
    assert why in line
    assert not (tmp_path / 'out').exists()


def test_motion_that_the_sensors_of_the_cell_cannot_measure(start, tmp_path):
    """At the start, and not when the arm has been moved for the registration."""
    line = refuse(start, 'pose_planner', cell='quick', moving_s=40.0, session=tmp_path / 's')
    assert 'mocap sees 3 markers, and motion takes 4' in line
    assert not (tmp_path / 's').exists()


def test_a_session_folder_that_is_in_use(start, tmp_path):
    (tmp_path / 'session').mkdir()
    (tmp_path / 'session' / 'observations.csv').write_text('mine\n')
    assert str(tmp_path / 'session') in refuse(start, 'recorder', session=tmp_path / 'session')


def test_an_optitrack_server_that_never_answers(start):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(('127.0.0.1', 0))
        line = refuse(
            start,
            'optitrack_markers',
            server='127.0.0.1',
            local_interface='127.0.0.1',
            command_port=silent.getsockname()[1],
            start_timeout_s=2.0,
        )
    assert 'OptiTrack' in line
    assert '127.0.0.1' in line


def test_a_laser_tracker_that_never_answers(start):
    with socket.socket() as silent:
        silent.bind(('127.0.0.1', 0))
        silent.listen()
        port = silent.getsockname()[1]
        line = refuse(
            start, 'laser_tracker_markers', host='127.0.0.1', port=port, start_timeout_s=2.0
        )
    assert f'127.0.0.1:{port}' in line


def test_a_laser_tracker_that_is_not_there(start):
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        port = probe.getsockname()[1]
    line = refuse(start, 'laser_tracker_markers', host='127.0.0.1', port=port, start_timeout_s=1.0)
    assert f'127.0.0.1:{port}' in line


def test_a_demo_that_is_refused_or_stopped_before_its_session_does_not_block_the_next(
    start, tmp_path
):
    from remaster_ros.demo.demo import output_folder

    line = refuse(start, 'demo', out=tmp_path / 'demo', hide='backlash@9:0.3')
    assert 'backlash@9: the arm has 7 joints; give 1 to 7' in line
    assert not (tmp_path / 'demo').exists()
    (tmp_path / 'demo' / 'log').mkdir(parents=True)
    (tmp_path / 'demo' / 'log' / 'recorder.log').write_text('it was starting\n')
    assert output_folder(tmp_path / 'demo') == tmp_path / 'demo'
    (tmp_path / 'demo' / 'thesis.tex').write_text('mine')
    with pytest.raises(InputError, match='is not empty, and holds no unfinished session'):
        output_folder(tmp_path / 'demo')


@pytest.mark.parametrize('fake', ['fake_optitrack', 'fake_laser_tracker'])
def test_a_port_in_use(start, tmp_path, fake):
    from remaster_ros.session.cells.workcell import read_cell
    from remaster_ros.simulation.setup import make_world

    make_world(tmp_path / 'world', read_cell('demo'), seed=1, rate=1.0).close()
    kind = socket.SOCK_DGRAM if fake == 'fake_optitrack' else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(('127.0.0.1', 0))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        port = taken.getsockname()[1]
        name = 'command_port' if fake == 'fake_optitrack' else 'port'
        line = refuse(start, fake, world=tmp_path / 'world', **{name: port})
    assert str(port) in line


def test_a_bag_that_is_not_there(start, tmp_path):
    assert str(tmp_path / 'none') in refuse(start, 'replay', bag=tmp_path / 'none')


QUEUED = """
import sys, time
from rclpy.callback_groups import ReentrantCallbackGroup
from remaster_ros.nodes.running import RemasterNode, run

class Busy(RemasterNode):
    def __init__(self):
        super().__init__('busy')
        for _ in range(6):
            self.create_timer(0.01, self.work, callback_group=ReentrantCallbackGroup())

    def work(self):
        time.sleep(0.5)
        self.finished = True

sys.exit(run(Busy, threads=2))
"""


def test_a_node_that_ends_while_callbacks_are_queued_prints_nothing(ros_environment):
    done = subprocess.run(
        [sys.executable, '-c', QUEUED],
        env=ros_environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, '')


def test_a_link_where_the_fakes_meet(start, ros_environment, tmp_path, monkeypatch):
    """In a temporary directory that is open to all, another user may have put it there."""
    import os

    victim = tmp_path / 'home'
    victim.mkdir()
    name = f'remaster_world_{os.getuid()}_{ros_environment["ROS_DOMAIN_ID"]}'
    (tmp_path / name).symlink_to(victim)
    monkeypatch.setitem(ros_environment, 'TMPDIR', str(tmp_path))
    assert 'is a link, which is not followed' in refuse(start, 'fake_robot')
    assert not list(victim.iterdir())
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir(mode=0o755)
    # Without it the node would wait for somebody to make it.
    (tmp_path / name / 'world.yaml').touch()
    assert 'open to other users' in refuse(start, 'fake_optitrack')
