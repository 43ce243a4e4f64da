# SPDX-License-Identifier: Apache-2.0
"""What a controller draws through the corrected points, against the wanted path of the tool."""

from dataclasses import replace

import numpy as np
import pytest
from test_compensator import arm, configurations, erring
from worlds.drawn_moves import drawn

from remaster_ros.compensation.arm_model import Function, JointTerm
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.trajectories import corrected_trajectory
from remaster_ros.errors import InputError


def a_path(model, seed, points=4):
    """Return a path between random configurations, at rest at both ends."""
    q = configurations(model, points, seed)
    t = np.arange(points) * 1.5
    v = np.zeros_like(q)
    v[1:-1] = (q[2:] - q[:-2]) / (t[2:] - t[:-2])[:, None]
    return t, q, v


def off_path(model, sent, wanted):
    """Return how far the tool of the arm is from that of the nominal one, m, (n,)."""
    reached, nominal = model.state(sent).tool, model.chain.forward(wanted)
    return np.linalg.norm(reached[:, :3, 3] - nominal[:, :3, 3], axis=1)


@pytest.mark.parametrize('name', ['six', 'lwr4plus'])
@pytest.mark.parametrize('with_velocities', [True, False])
def test_the_tool_stays_on_the_wanted_path(name, with_velocities):
    """Also midway between the points, and where it was not compared, through singularities."""
    model = erring(name, 3)
    compensator = Compensator(model)
    t, q, v = a_path(model, 5)
    if not with_velocities:
        v = None
    found = corrected_trajectory(
        compensator, t, q, v, velocity_limits=np.full(model.joints, np.inf)
    )
    assert found.stretched == 1.0
    at = np.linspace(t[0], t[-1], 3001)
    wanted = drawn(t, q, v, at)
    sent = drawn(found.times_s, found.positions, found.velocities, at)
    off = off_path(model, sent, wanted)
    # What is left is stated at the points, and goes from one to the next.
    stated = np.interp(at, found.times_s, found.residual_m)
    assert np.all(off < stated + 1.3 * 2e-5)
    assert found.deviation_m < 2e-5
    before = off_path(model, wanted, wanted)
    assert np.median(off) < 0.02 * np.median(before)
    # At both ends it is that of a single target.
    np.testing.assert_allclose(found.positions[[0, -1]], compensator.command(q[[0, -1]]))
    # What it is for: the planner's points alone, corrected, leave it.
    few = drawn(t, compensator.command(q), v, at)
    assert off_path(model, few, wanted).max() > 2.0 * off.max()
    # As few points as do.
    assert len(found.times_s) < 400
    assert set(t) <= set(found.times_s)


@pytest.mark.parametrize('name', ['six', 'lwr4plus'])
def test_no_limit_is_passed_and_the_path_stays(name):
    """Random paths through singularities; by differences of what is drawn."""
    model = erring(name, 8)
    k = model.joints
    stretched, distances = [], []
    for seed in range(3):
        t, q, v = a_path(model, 20 + seed)
        # The wrist passes through its singularity.
        wrist = 4 if name == 'six' else 5
        q[:, wrist] = (-0.5, 0.4, -0.3, 0.5)
        wanted = np.linspace(t[0], t[-1], 20001)
        path = drawn(t, q, v, wanted)
        h = wanted[1] - wanted[0]
        speed, acceleration = np.gradient(path, h, axis=0), np.diff(path, 2, axis=0) / h**2
        # What the wanted path needs: all that is added has to be made up for by time.
        limits = [np.full(k, np.abs(rates).max()) for rates in (speed, acceleration)]
        found = corrected_trajectory(
            Compensator(model),
            *(t, q, v),
            velocity_limits=limits[0],
            acceleration_limits=limits[1],
        )
        print(name, seed, found.stretched)
        assert 1.0 <= found.stretched < 1.06
        stretched.append(found.stretched)
        at = np.linspace(found.times_s[0], found.times_s[-1], 40001)
        sent = drawn(found.times_s, found.positions, found.velocities, at)
        distances.append(off_path(model, sent, drawn(t, q, v, at / found.stretched)))
        h = at[1] - at[0]
        # The limits themselves were taken from differences.
        assert np.all(np.abs(np.diff(sent, axis=0) / h) <= limits[0] * (1 + 1e-4))
        assert np.all(np.abs(np.diff(sent, 2, axis=0) / h**2) <= limits[1] * (1 + 1e-3))
        assert np.abs(found.change).max() < np.radians(2.0) + 1e-3
        assert np.all(np.isfinite(found.added_speed))
    assert max(stretched) > 1.0
    # Of some millimetres: by a fade of singular directions 0.3 mm RMS were left.
    assert np.median(distances) < 0.05e-3


def test_it_begins_where_the_arm_is():
    """Wherever that is: what is commanded there goes over into the best on the way."""
    model = erring('lwr4plus', 8)
    compensator = Compensator(model)
    t, q, v = a_path(model, 21)
    begins = compensator.command(q[0]) + np.radians(0.5) * np.array([1, -1, 1, 0, 0, 1, -1])
    found = corrected_trajectory(
        compensator, t, q, v, acceleration_limits=np.full(7, 10.0), begins=begins
    )
    np.testing.assert_allclose(found.positions[0], begins, atol=1e-12)
    np.testing.assert_allclose(found.velocities[[0, -1]], 0.0, atol=1e-12)
    off = off_path(model, found.positions, drawn(t, q, v, found.times_s / found.stretched))
    assert off[0] > 2e-3
    assert np.median(off[len(off) // 2 :]) < 0.1e-3


def test_a_gear_wave_is_not_missed():
    """A hundred waves a turn between two points far apart."""
    wave = JointTerm(1, 'gear_periodic', Function('angle', 'sin', 1, 100), np.full(1, 2e-4))
    model = replace(arm('lwr4plus'), joint_terms=(wave,))
    compensator = Compensator(model)
    q = np.array([[0.2, -1.0, 0.3, 1.2, 0.1, 0.9, 0.0], [0.2, 1.0, 0.3, 1.2, 0.1, 0.9, 0.0]])
    t, v = np.array([0.0, 4.0]), np.zeros_like(q)
    found = corrected_trajectory(compensator, t, q, v)
    at = np.linspace(0.0, 4.0 * found.stretched, 5001)
    sent = drawn(found.times_s, found.positions, found.velocities, at)
    assert off_path(model, sent, drawn(t, q, v, at / found.stretched)).max() < 2e-5
    assert found.added_speed[1] > 0.005


def test_what_is_no_trajectory_is_refused():
    compensator = Compensator(erring('lwr4plus', 1))
    t, q, v = a_path(compensator.model, 1)
    broken = q.copy()
    broken[1, 2] = np.nan
    for args, words in (
        ((t, q[:, :6], None), 'shape'),
        ((t, q, v[:2]), 'velocities have the shape'),
        ((t, broken, v), 'not finite'),
        ((t[::-1], q, v), 'ascend'),
        ((t * 1e-300, q, v), 'ascend'),
        ((t[:1], q[:1], v[:1]), 'two points'),
    ):
        with pytest.raises(InputError, match=words):
            corrected_trajectory(compensator, *args)
    with pytest.raises(InputError, match='go slower'):
        corrected_trajectory(compensator, t / 1000.0, q, v * 1000.0, tolerance_m=1e-9)
