# SPDX-License-Identifier: Apache-2.0
"""The fake arm takes and drops trajectories as joint_trajectory_controller does."""

import numpy as np
import pytest
from worlds.dynamic_fakes import SteppedWorld

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.faults import inject
from remaster_ros.simulation.robot import FakeArm
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor
from remaster_ros.simulation.world import WorldContent


@pytest.fixture
def world(tmp_path):
    urdf = config_path('robots/lwr4plus.urdf').read_text()
    chain = SerialChain.from_urdf(urdf)
    rng = np.random.default_rng(5)
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.0, 1.0]
    content = WorldContent(
        SessionTruth(
            rng.normal(0, 0.005, 7),
            {'sir': np.array([0.1, 0, 0])},
            {'mocap': SimulatedSensor('sir', T)},
        ),
        seed=5,
        rate=10.0,
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        start_q=np.array([0, 0.3, 0, -1.2, 0, 1.0, 0]),
        link_radius_m=0.06,
    )
    world = SteppedWorld.create(tmp_path / 'world', content)
    yield world
    world.close()


@pytest.fixture
def arm(world):
    return FakeArm(world, np.random.default_rng(7))


def go(arm, target, seconds=2.0, names=None, velocities=None):
    velocity = None if velocities is None else np.array(velocities)
    return arm.command(names or arm.names, [ServoPoint(seconds, np.array(target), velocity)])


def test_it_follows_permuted_names(world, arm):
    target = np.linspace(-0.3, 0.3, 7)
    order = [3, 1, 0, 2, 6, 5, 4]
    assert go(arm, target[order], names=[arm.names[i] for i in order]) is None
    world.time_s += 10.0
    stamp, names, q, velocity = arm.joint_state()
    assert stamp == world.time_s
    assert names != list(arm.names), 'joint_states must come in an order of their own'
    np.testing.assert_allclose([dict(zip(names, q))[n] for n in arm.names], target, atol=2e-4)
    np.testing.assert_allclose(velocity, 0, atol=1e-9)


def test_it_does_not_clamp_to_limits(world, arm):
    assert go(arm, np.full(7, 3.5)) is None
    world.time_s += 10.0
    np.testing.assert_allclose(arm.joint_state()[2], 3.5, atol=2e-4)


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ({'names': [f'joint_{i}' for i in range(7)]}, 'do not match'),
        ({'names': [f'joint_{i + 1}' for i in range(6)]}, 'do not match'),
        ({'velocities': [0.1] * 7}, 'velocity'),
        ({'target': [np.nan] * 7}, 'finite'),
        ({'target': [0.0] * 6}, '6 positions'),
    ],
)
def test_what_it_cannot_follow_is_dropped_with_a_reason(world, arm, change, reason):
    before = world.reported(world.now())[0]
    change = dict(change)
    assert reason in go(arm, change.pop('target', [0.0] * 7), **change)
    world.time_s += 10.0
    np.testing.assert_array_equal(world.reported(world.now())[0], before)


def test_times_must_increase_and_not_end_in_the_past(arm):
    points = [ServoPoint(1.0, np.zeros(7)), ServoPoint(1.0, np.full(7, 0.1))]
    assert 'increase' in arm.command(arm.names, points)
    for start_s in (50.0, -50.0):
        assert 'past' in arm.command(arm.names, points[:1], start_s=start_s)
    close = [ServoPoint(1.0, np.zeros(7)), ServoPoint(1.0 + 1e-9, np.full(7, 0.1))]
    assert 'too close' in arm.command(arm.names, close, start_s=2e9)


def test_an_empty_trajectory_is_no_way_to_stop_it(world, arm):
    """As with the controllers that refuse one: who wants the arm to stand must say where."""
    go(arm, np.zeros(7), seconds=4.0)
    world.time_s += 2.0
    assert 'empty' in arm.command(arm.names, [])
    assert np.max(np.abs(world.reported(world.now())[1])) > 0.1
    world.time_s += 5.0
    np.testing.assert_allclose(world.reported(world.now())[0], 0.0, atol=2e-4)


def test_another_process_sees_the_same_arm(world, arm):
    """A second World on the same folder computes the same marker at the same time."""
    go(arm, np.linspace(-0.4, 0.4, 7))
    other = SteppedWorld.open(world.folder)
    go(arm, np.linspace(0.2, -0.2, 7))
    for t in (100.5, 101.0, 103.0):
        np.testing.assert_array_equal(
            other.marker_in_sensor('mocap', t), world.marker_in_sensor('mocap', t)
        )
    other.close()


def test_the_marker_is_where_offsets_put_it(world):
    """True angle = reported one + zero-offset."""
    truth = world.truth
    T = world.chain.forward(world.start_q + truth.joint_offsets)
    expected = T @ [*truth.markers['sir'], 1.0]
    seen = truth.sensors['mocap'].T_R_N @ [*world.marker_in_sensor('mocap', 100.0), 1.0]
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def reports(world, arm, count, step_s=0.05):
    """Return that many reports, each by joint name."""
    found = []
    for _ in range(count):
        world.time_s += step_s
        state = arm.joint_state()
        if state is not None:
            stamp, names, q, _ = state
            found.append((stamp, np.array([dict(zip(names, q))[name] for name in arm.names])))
    return found


def spoiled(world, arm, count=6, **numbers):
    """Return reports of a moving arm: before a fault, and with it."""
    inject(world.folder, {})
    go(arm, np.full(7, 0.5), seconds=20.0)
    before = reports(world, arm, 10)
    inject(world.folder, {'robot': numbers})
    return before, reports(world, arm, count)


def test_a_fault_that_no_fake_knows_is_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"no fault 'occlude' of mocap; there are off, .*'occluded'"
    ):
        inject(tmp_path, {'mocap': {'occlude': 1}})
    with pytest.raises(InputError, match="no fault 'occluded' of robot; there are off, dropped"):
        inject(tmp_path, {'robot': {'occluded': 1}})
    assert not any(tmp_path.iterdir())


def test_a_joint_that_is_a_turn_off(world, arm):
    before, after = spoiled(world, arm, wrapped=3)
    turn = np.array([0, 0, 2 * np.pi, 0, 0, 0, 0])
    assert all(np.allclose(q - turn, before[-1][1], atol=0.1) for _, q in after)
    before, after = spoiled(world, arm, wrapped_once=3)
    assert np.allclose(after[0][1] - turn, before[-1][1], atol=0.1)
    assert all(np.allclose(q, before[-1][1], atol=0.1) for _, q in after[1:])


def test_reports_that_are_lost_doubled_repeated_or_frozen(world, arm):
    assert len(spoiled(world, arm, lost=3)[1]) == 2
    before, after = spoiled(world, arm, repeated=1)
    assert all(stamp == before[-1][0] for stamp, _ in after)
    before, after = spoiled(world, arm, frozen=1)
    assert np.all(np.diff([stamp for stamp, _ in after]) > 0)
    assert all(np.array_equal(q, before[-1][1]) for _, q in after)
    assert not np.array_equal(before[-1][1], before[-2][1])
    assert arm.copies == 1
    spoiled(world, arm, doubled=1)
    assert arm.copies == 2
