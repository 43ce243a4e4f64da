# SPDX-License-Identifier: Apache-2.0
"""Small inputs on which users got stuck: the offsets that made them, or what to do."""

from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import run

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.session.records.reader import read_session

CASES = Path(__file__).parents[4] / 'shared' / 'cases'
pytestmark = pytest.mark.skipif(
    not CASES.is_dir(), reason='the small inputs of ../shared/cases are not here'
)
KR6 = (-0.196, -0.052, 0.499, 0.198, -0.492, -0.002)
LRMATE = (-0.241, -0.397, -0.075, 0.126, 0.341, 0.033)
CAMERA = (0.1, 0.25, -0.3, 0.2, -0.15, 0.1)
UR5E = (0.104, 0.246, 0.099, -0.391, 0.272, 0.134)
# The stated offsets are rounded to a thousandth of a degree. Of 4 offsets of an input, normal ones
# would pass 3.5 std in one of 500 inputs.
ROUNDED_DEG, MOST_STDS = 5e-4, 3.5


def imported(files, options, urdf, out):
    paths = [CASES / name for name in files]
    return run(
        'import', *paths, '--urdf', CASES / f'{urdf}.urdf', *options, '--out', out, '--quiet'
    )


@pytest.mark.parametrize(
    ('files', 'options', 'urdf', 'true_deg'),
    [
        (('3_angles_0_to_360.csv',), (), 'kr6', KR6),
        (
            ('5_leica_german_blank_separated.txt', '5_joints_pendant_names.csv'),
            ('--tip-link', 'tool0'),
            'ur5e',
            UR5E,
        ),
        (('6_sa_points.txt', '6_kuka.dat'), (), 'kr6', KR6),
        (('6_sa_points.txt', '6_kuka.src'), ('--join', 'order'), 'kr6', KR6),
        (('6_sa_points.txt', '6_kuka_axis_act.txt'), ('--join', 'order'), 'kr6', KR6),
        (('7_fanuc.ls', '7_fanuc_points.csv'), (), 'fanuc_lrmate', LRMATE),
        (('10_three_markers_wide.csv',), ('--points', 'm1'), 'kr6', KR6),
        (('j8_board_in_camera.csv',), ('--on-tool', '--tip-link', 'tool0'), 'ur5e', CAMERA),
        (('j8_camera_in_board.csv',), ('--tip-link', 'tool0'), 'ur5e', CAMERA),
    ],
    ids=['360', 'leica', 'dat', 'src', 'axis_act', 'fanuc', 'wide', 'on_tool', 'inverted'],
)
def test_the_offsets_are_those_that_made_the_table(files, options, urdf, true_deg, tmp_path):
    out = tmp_path / 'session'
    assert imported(files, options, urdf, out).returncode == 0
    found = estimate(Problem.of(read_session(out)))
    assert bool(found.model.bodies) == files[0].startswith('j8')
    mean = np.rad2deg(found.model.offsets(found.mode.z))
    std = np.zeros(len(found.mode.z))
    std[found.posterior.free] = np.rad2deg(np.sqrt(np.diag(found.mode.covariance)))
    std = std[: len(mean)]
    # The outer joints' are those of registration and marker.
    inner = slice(1, -1)
    off = np.abs(mean - true_deg)[inner] - ROUNDED_DEG
    assert np.all(off < MOST_STDS * std[inner]), (mean, std)
    # The camera's poses were made with more noise.
    assert std[inner].max() < (0.03 if found.model.bodies else 0.005)


@pytest.mark.parametrize(
    ('files', 'urdf', 'words'),
    [
        (
            ('4_motive_take_v123.csv', '4_plotjuggler_joints.csv'),
            ('fer', '--tip-link', 'fer_link8'),
            '4 different configurations to fit are too few',
        ),
        (
            ('5_leica_german_blank_separated.txt', '11_ur_rtde_record.csv'),
            ('ur5e', '--tip-link', 'tool0'),
            '2 different configurations to fit are too few',
        ),
        (
            ('10_three_markers_wide.csv',),
            ('kr6',),
            'm1, m2, m3 to 0.039 mm each alone; were they computed from one another?',
        ),
        (('6_sa_points.txt', '6_kuka.src'), ('kr6',), 'say --join order'),
    ],
    ids=['motive', 'rtde', 'wide', 'order'],
)
def test_what_makes_no_session_ends_in_what_to_do(files, urdf, words, tmp_path):
    out = tmp_path / 'session'
    name, *options = urdf
    done = imported(files, options, name, out)
    assert done.returncode in (1, 2)
    assert words in done.stderr
    assert done.stderr.count('\n') == 1
    assert not out.exists()


def test_poses_of_a_camera_on_the_tool_say_so(tmp_path):
    files, options = ['j8_board_in_camera.csv'], ('--tip-link', 'tool0')
    done = imported(files, options, 'ur5e', tmp_path / 'session')
    assert done.returncode == 1
    assert 'need --on-tool' in done.stderr
