# SPDX-License-Identifier: Apache-2.0
"""What a fake arm does behind its encoders while it moves, and how its camera's clock goes."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.dynamic_fakes import CELL, play

from remaster_ros.calibration.dynamics import clocks_of, estimate_moving
from remaster_ros.calibration.estimate import Problem
from remaster_ros.kinematics.moving_links import MovingLinks
from remaster_ros.simulation.arm_motion import Motion, ServoPoint
from remaster_ros.simulation.dynamics import MODE_HZ, Dynamics, LinkSide
from remaster_ros.simulation.setup import make_world
from remaster_ros.simulation.world import World

SEED = 20261130
CHAIN = CELL.chain()
K = len(CHAIN)
REST = np.array([0.1, 0.2, 0.0, 1.5, 0.1, 0.6, 0.0])
NOTHING = replace(
    Dynamics.drawn(CHAIN, ('mocap',), 1.0, np.random.default_rng(SEED)),
    lag_s=np.zeros(K),
    windup_rad=np.zeros(K),
    softness=np.zeros(K),
    mode_hz=np.inf,
    jitter_s=0.0,
)


def there_and_back(turn: float = 0.5, takes: float = 2.0) -> Motion:
    motion = Motion(0.0, REST)
    goal = ServoPoint(takes, REST + turn, np.zeros(K))
    motion.follow(0.0, [goal, ServoPoint(2.0 * takes, REST, np.zeros(K))])
    return motion


def test_friction_winds_a_joint_up_against_its_way_and_keeps_its_side_at_rest():
    windup = np.linspace(1e-5, 7e-5, K)
    side = LinkSide(CHAIN, replace(NOTHING, windup_rad=windup), np.zeros(K), 0.0)
    motion = there_and_back()
    np.testing.assert_allclose(side.at(motion, 1.0)[0], -windup, rtol=1e-6)
    np.testing.assert_allclose(side.at(motion, 3.0)[0], windup, rtol=1e-6)
    # The servo overshoots by less than the travel within which friction turns round.
    assert np.all(np.abs(side.at(motion, 20.0)[0]) > 0.2 * windup)


def test_a_joint_yields_to_the_inertia_of_what_it_carries():
    softness = np.full(K, 1e-4)
    side = LinkSide(CHAIN, replace(NOTHING, softness=softness), np.zeros(K), 0.0)
    motion, h = there_and_back(), 1e-4
    for t in (0.4, 1.2, 2.5):
        added, _ = side.at(motion, t)
        (q, v), before, after = motion.at(t), motion.at(t - h)[1], motion.at(t + h)[1]
        a = (after - before) / (2.0 * h)
        torque = MovingLinks.of(CHAIN, q[None], v[None], a[None]).inertial_torque()[0]
        np.testing.assert_allclose(
            added, softness * torque, atol=0.02 * np.abs(softness * torque).max()
        )


def test_the_tool_swings_behind_its_acceleration():
    side = LinkSide(CHAIN, replace(NOTHING, mode_hz=MODE_HZ), np.zeros(K), 0.0)
    motion, h = there_and_back(), 1e-3
    for t in (0.6, 1.4):
        _, shift = side.at(motion, t)
        places = [CHAIN.forward(motion.at(at)[0])[:3, 3] for at in (t - h, t, t + h)]
        moved = (places[2] - 2.0 * places[1] + places[0]) / h**2
        still = -moved / (2.0 * np.pi * MODE_HZ) ** 2
        # Far below resonance, up to what rings.
        assert np.linalg.norm(shift - still) < 0.15 * np.linalg.norm(still) + 2e-6


def test_processes_of_one_world_see_the_same(tmp_path):
    played = play(tmp_path / 'w', SEED, 6.0)
    again = World.open(played.world.folder)
    t = played.world.time_s
    for at in (t - 0.3, t - 0.01, t):
        np.testing.assert_allclose(
            again.marker_in_sensor('mocap', at),
            played.world.marker_in_sensor('mocap', at),
            atol=2e-6,
        )
    again.close()
    played.world.close()


def test_without_dynamics_frames_show_the_moment_at_which_they_are_sent(tmp_path):
    world = make_world(tmp_path / 'w', CELL, SEED, 1.0)
    assert world.camera('mocap') is None
    np.testing.assert_array_equal(world.encoders(101.0), world.reported(101.0)[0])
    world.close()


@pytest.mark.parametrize('scale', [1.0, pytest.param(3.0, marks=pytest.mark.qualify)])
def test_offsets_and_clock_are_found_from_what_the_fakes_say(tmp_path, scale):
    print(f'seed {SEED}')
    played = play(tmp_path / 'w', SEED, 25.0, scale=scale)
    found = estimate_moving(Problem.of(played.session(SEED)))
    model, free = found.model, found.posterior.free
    std = dict(zip(free.tolist(), np.sqrt(np.diag(found.mode.covariance)), strict=False))
    off = model.offsets(model.natural(found.mode.z)) - played.world.truth.joint_offsets
    # Joints 2 to 6, each missed in one of two thousand.
    for joint in range(1, K - 1):
        assert abs(off[joint]) < 3.5 * std[joint]
        assert std[joint] < np.radians(0.01)
    late_s, _ = clocks_of(found)['mocap']
    camera = played.world.dynamics.cameras['mocap']
    # Reports of joints are late themselves.
    assert 0.0 < camera.late_s - late_s < 2.0 * played.world.dynamics.lag_s.max() + 2e-4
    played.world.close()
