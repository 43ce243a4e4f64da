# SPDX-License-Identifier: Apache-2.0
"""The figures of docs/safety.md are those of the code."""

import re
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.compensation import in_use
from remaster_ros.kinematics import collision
from remaster_ros.kinematics.serial_chain import LEVER_M
from remaster_ros.motion import (
    arm_supervisor,
    following,
    joint_reports,
    limits,
    motion_gate,
    motion_under_way,
    move_queue,
    stopping,
)
from remaster_ros.motion.limits import MotionLimits
from remaster_ros.motion.motion_gate import MotionGate
from remaster_ros.motion.path_check import PointSpeeds
from remaster_ros.nodes import robot_bridge
from remaster_ros.nodes.robot_bridge import Parameters
from remaster_ros.session import session_recorder
from remaster_ros.session.cells.workcell import read_cell

PAGE = ' '.join(
    (Path(__file__).parents[3] / 'docs' / 'safety.md').read_text(encoding='utf-8').split()
)
DEFAULT = Parameters()
LATE_S = joint_reports.LATE_S + joint_reports.LATE_WALL_S
AHEAD_S = following.EARLY_S + following.LATENCY_S

# What stands on the page, and what it must be: a number in the place of each pair of brackets.
SAID = [
    (r'`limit_margin_deg` \((.+?)°\)', [DEFAULT.limit_margin_deg]),
    (r'each joint is changed by (\d+)° at most', [in_use.MOST_DEG]),
    (r'velocity limits \((\S+) rad/s where it has none\)', [limits.UNKNOWN_VELOCITY]),
    (r'`speed_share` \((.+?)\) \|', [DEFAULT.speed_share]),
    (r'(\S+) m/s, the customary limit', [DEFAULT.cartesian_speed_limit_m_s]),
    (r'(\S+) rad/s² where the cell file gives none', [limits.ACCELERATION]),
    (
        r'within (\S+) mrad of where the arm is reported to stand, and has stood for (\S+) s',
        [1e3 * motion_gate.START_RAD, following.STANDING_S],
    ),
    (r'received within `heartbeat_s` \((\S+) s\)', [DEFAULT.heartbeat_s]),
    (r'looked for in (\d+) configurations', [in_use.SAMPLED]),
    (r'more than (\d+) mm between two checks', [1e3 * collision.STEP_M]),
    (r'within `arrive_tolerance` \((\S+) mrad\)', [1e3 * DEFAULT.arrive_tolerance]),
    (r'the same to the last bit for (\S+) s', [following.VARIES_S]),
    (r'In the other cases it takes (\S+) s', [motion_gate.PROBE_S]),
    (
        r'within the limits \((\S+) rad tolerance\), no faster than (\S+) times',
        [joint_reports.LIMIT_TOLERANCE_RAD, joint_reports.SPEED_TOLERANCE],
    ),
    (r'at most (\S+) s later than reports usually', [LATE_S]),
    (
        r'at most (\S+) mrad beside it and `lag_s` \((\S+) s, and (\S+) s for a busy computer\) '
        r'behind it, or (\S+) s ahead',
        [1e3 * following.ON_PATH_RAD, DEFAULT.lag_s, following.LATENCY_S, AHEAD_S],
    ),
    (r'half of its speed within the last (\S+) s', [following.SLOWED_S]),
    (r'in rests and below (\S+) rad/s', [following.SLOWED_RAD / following.SLOWED_S]),
    (r'along the same line, in (\S+) s', [stopping.STOP_S]),
    (r'within `resume_alone_s` \((\S+) s\)', [DEFAULT.resume_alone_s]),
    (
        r'left the path \((\S+) mrad, and `lag_s` \+ (\S+) s behind\)',
        [1e3 * following.ON_PATH_RAD, following.LATENCY_S],
    ),
    (
        r'decided more than (\S+) s before it can be published, or a move (\S+) s',
        [
            robot_bridge.LATE_WALL_S[robot_bridge.Stop],
            robot_bridge.LATE_WALL_S[robot_bridge.Drive],
        ],
    ),
    (r'and at most (\S+) m/s, and on it', [motion_gate.WAY_OUT_TOOL_SPEED]),
]
# Of joints that slide: an angle in rad, and how both are written.
SLIDES = [
    (r'for each degree \| (\S+)° \| (\S+) mm', np.deg2rad(1.0), np.degrees(1.0), 1e3),
    (r'the URDF has none \| (\S+) rad/s \| (\S+) m/s', limits.UNKNOWN_VELOCITY, 1.0, 1.0),
    (r'or missing \| (\S+) rad/s² \| (\S+) m/s²', limits.ACCELERATION, 1.0, 1.0),
    (r'\(`arrive_tolerance`\) \| (\S+) mrad \| (\S+) mm', motion_gate.START_RAD, 1e3, 1e3),
    (r'\(`arrive_tolerance`\) \| (\S+) mrad \| (\S+) mm', DEFAULT.arrive_tolerance, 1e3, 1e3),
    (r'\(`still_tolerance`\) \| (\S+) mrad \| (\S+) mm', DEFAULT.still_tolerance, 1e3, 1e3),
    (
        r'of the recorder\) \| (\S+) mrad \| (\S+) mm',
        session_recorder.Parameters().motion_tolerance, 1e3, 1e3,
    ),
    (r'while it is measured \| (\S+) mrad \| (\S+) mm', following.ON_PATH_RAD, 1e3, 1e3),
    (r'while it is measured \| (\S+) mrad \| (\S+) mm', motion_under_way.MOVED_RAD, 1e3, 1e3),
    (
        r'beyond its limits \| (\S+) mrad \| (\S+) mm',
        joint_reports.LIMIT_TOLERANCE_RAD, 1e3, 1e3,
    ),
    (r'times this\) \| (\S+) rad/s \| (\S+) m/s', joint_reports.UNKNOWN_SPEED, 1.0, 1.0),
    (r'the probe \| (\S+) µrad \| (\S+) µm', move_queue.PROBE_RAD, 1e6, 1e6),
    (
        r'noticed below \| (\S+) rad/s \| (\S+) mm/s',
        following.SLOWED_RAD / following.SLOWED_S, 1.0, 1e3,
    ),
]  # fmt: skip


@pytest.mark.parametrize(('text', 'angle', 'shown', 'length'), SLIDES)
def test_a_figure_of_joints_that_slide_is_a_quarter_of_a_metre_for_a_radian(
    text, angle, shown, length
):
    found = re.search(text, PAGE)
    assert found, f'docs/safety.md has no sentence {text}'
    turning, sliding = (float(number) for number in found.groups())
    assert turning == pytest.approx(shown * angle)
    # With as many digits as are written.
    assert sliding == pytest.approx(length * angle * LEVER_M, abs=0.005)


@pytest.mark.parametrize(('text', 'values'), SAID, ids=[text[:30] for text, _ in SAID])
def test_a_figure_is_that_of_the_code(text, values):
    found = re.search(text, PAGE)
    assert found, f'docs/safety.md has no sentence {text}'
    assert [float(number) for number in found.groups()] == pytest.approx(values)


def test_what_is_said_in_words():
    assert 'a tenth of the speed' in PAGE
    assert motion_gate.WAY_OUT_SPEED == 0.1
    assert 'one micrometre' in PAGE
    # At the end of an arm of about a metre.
    assert move_queue.PROBE_RAD == 1e-6
    assert 'go on for half a second' in PAGE
    assert arm_supervisor.DOUBT_S == 0.5
    assert 'twice that' in PAGE
    assert motion_under_way.OTHER_PLACES == 2.0


def test_the_longest_probe_takes_what_is_said():
    """An arm of 1.2 m with 0.25 m/s: some 70 s."""
    cell = read_cell('demo')
    chain = cell.chain()
    speeds = PointSpeeds(chain, cell.collision_model(chain, None).extent_points)
    assert speeds.reach_m[0] == pytest.approx(1.2, abs=0.05)
    share, margin = DEFAULT.speed_share, float(np.deg2rad(DEFAULT.limit_margin_deg))
    bounds = MotionLimits.of(chain, share, None, cell.acceleration_limits(chain), 0.25, margin)
    at, unsure = np.zeros(len(chain)), np.ones(len(chain), dtype=bool)
    path = move_queue.probe_path(at, bounds)
    probe = MotionGate(bounds, speeds).admit_probe(path, at, unsure)
    assert probe.waypoints[-1].time_s == pytest.approx(70.0, abs=2.0)
    assert PAGE.count('some 70 s') + PAGE.count('up to 70 s') == 2
