# SPDX-License-Identifier: Apache-2.0
"""Curves that are measured in motion: what they keep, and what they are worth."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from worlds.planned_motion import driven
from worlds.simple_cells import four_markers

from remaster_ros.calibration.dynamics import estimate_moving
from remaster_ros.calibration.estimate import Problem
from remaster_ros.collection.plan_confirmation import fingerprint
from remaster_ros.errors import InputError
from remaster_ros.motion.trajectory import Line
from remaster_ros.planning import moving_design
from remaster_ros.planning.collection_plan import plan_collection, session_time_s
from remaster_ros.planning.moving_design import (
    EXCHANGES,
    MOVING_S,
    SHORTEST_MOVING_S,
    check_sensors,
    design_moving,
)
from remaster_ros.planning.moving_information import MotionRows, expected_along
from remaster_ros.planning.tour_order import FITTED, HELD_OUT
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.cells.workcell import read_cell

TOOL_SPEED = 0.25
FEW = 120
COUNTS = {'optimization': 10, 'validation': 10, 'registration': 12}


@cache
def cell():
    with TemporaryDirectory() as folder:
        return read_cell(four_markers(Path(folder) / 'cell.yaml'))


@cache
def scene():
    return cell().planning_scene(cell().chain(), without_meshes=True)


@cache
def travel():
    limits = cell().acceleration_limits(scene().model.chain)
    return TravelTime.of(scene().model, 0.3, TOOL_SPEED, limits)


def designed(seed, exchanges=FEW, seconds=24.0):
    settings = cell().design_settings()
    rng = np.random.default_rng(seed)
    return design_moving(
        scene(), travel(), settings, scene().rough_R, rng, seconds, exchanges=exchanges
    )


@cache
def design():
    return designed(0)


def random_times(curve, count, rng):
    return rng.uniform(0.0, curve.duration_s, count)


def test_curves_keep_limits_clearance_and_sight_at_any_time():
    chain, model, limits = scene().model.chain, scene().model, travel().limits
    rng, h = np.random.default_rng(1), 1e-3
    (sensor,) = cell().design_settings().sensors
    markers = np.array(list(sensor.markers.values()))
    margin = scene().limit_margin_rad
    for curve in design().curves:
        assert 3.0 - 0.3 <= curve.duration_s <= 12.0
        times = random_times(curve, 500, rng)
        q = np.array([curve.at(t)[0] for t in times])
        after = np.array([curve.at(min(t + h, curve.duration_s))[0] for t in times])
        before = np.array([curve.at(max(t - h, 0.0))[0] for t in times])
        assert np.all(q >= chain.lower + margin - 1e-9)
        assert np.all(q <= chain.upper - margin + 1e-9)
        assert np.all(np.abs(after - q) / h <= limits.velocity)
        inner = (times > h) & (times < curve.duration_s - h)
        bent = np.abs(after - 2.0 * q + before)[inner] / h**2
        assert np.all(bent <= limits.acceleration * 1.001)
        assert all(not model.trouble(each) for each in q)
        # The markers, and the corners of the arm's bodies: none is faster than allowed.
        for link, points in enumerate(model.extent_points):
            ends = [
                np.einsum('nij,mj->nmi', chain.frames(at)[:, link, :3, :3], points)
                + chain.frames(at)[:, link, None, :3, 3]
                for at in (q, after)
            ]
            assert np.max(np.linalg.norm(ends[1] - ends[0], axis=2)) / h <= TOOL_SPEED
        tool = chain.forward(q)
        for marker in markers:
            place = tool[:, :3, 3] + tool[:, :3, :3] @ marker
            line = sensor.position_R - place
            angle = np.arccos(np.sum(line * tool[:, :3, 2], axis=1) / np.linalg.norm(line, axis=1))
            assert np.max(angle) <= np.radians(60.0) + 0.01
            assert not model.hides(q, marker, sensor.position_R).any()
    assert design().share_in_sight > 0.99
    assert design().max_tool_speed_m_s <= TOOL_SPEED
    assert design().max_joint_share <= 1.0


def test_each_curve_begins_where_the_one_before_ends_with_places_a_second_apart():
    here = design().begin.solutions[0]
    for end, curve in zip(design().ends, design().curves, strict=True):
        np.testing.assert_array_equal(end.way.points[0], here)
        shares = np.append(end.way.shares, 1.0)
        assert end.way.shares[0] == 0.0
        assert np.min(np.diff(shares)) / curve.rate >= 1.0
        made, _ = travel().curve(np.vstack((end.way.points, end.solutions)), end.way.shares)
        assert made.duration_s == pytest.approx(curve.duration_s)
        (here,) = end.solutions
    assert len(design().ends) == 8


def variance(rows):
    settings = cell().design_settings()
    expected = expected_along(
        scene().model.chain, rows, settings.sensors, settings.marker_std_m, settings.priors
    )
    return expected.joint_rms**2


def until(rows, seconds):
    """The rows before a time."""
    part = slice(0, int(np.searchsorted(rows.seconds, seconds)))
    return MotionRows(*(values[part] for values in vars(rows).values()))


def along_lines(found):
    """Rows of straight lines through the same places."""
    points = np.vstack([*(end.way.points for end in found.ends), found.ends[-1].solutions])
    parts, total = [], 0.0
    for line in travel().trajectory(points)[0].lines:
        assert isinstance(line, Line)
        times = 0.05 + 0.1 * np.arange(int(line.duration_s / 0.1))
        q, velocity = map(np.array, zip(*(line.at(t) for t in times), strict=True))
        after, before = (np.array([line.at(t + d)[1] for t in times]) for d in (1e-4, -1e-4))
        parts.append(MotionRows(total + times, q, velocity, (after - before) / 2e-4))
        total += line.duration_s
    return MotionRows.joined(parts)


def moved(found):
    """Rows of all curves without the standstills between."""
    return replace(found.rows, seconds=0.05 + 0.1 * np.arange(len(found.rows.seconds)))


@pytest.mark.qualify
def test_information_a_second_beats_random_curves_and_straight_lines():
    """At the default time: at the least one each curve is a straight begin and end, and no more.

    There, too, the time is kept: 2 % more of it count as the variance times exp(30 * 0.02) = 1.8.
    """
    by_curves, by_lines = [], []
    for seed in range(5):
        found = designed(seed, exchanges=600, seconds=MOVING_S)
        drawn = designed(seed, exchanges=0, seconds=1.5 * MOVING_S)
        # As many seconds of each; more is drawn than that.
        assert found.moving_s < 1.02 * MOVING_S < drawn.moving_s
        of_found, rows = variance(moved(found)), (moved(drawn), along_lines(drawn))
        of_drawn, of_lines = (variance(until(each, found.moving_s)) for each in rows)
        by_curves.append(of_drawn / of_found)
        by_lines.append(of_lines / of_found)
        print(f'seed {seed}: random curves {by_curves[-1]:.2f}, lines {by_lines[-1]:.2f}')
    assert np.median(by_curves) > 1.2
    assert np.median(by_lines) > 1.2
    least = designed(0, exchanges=EXCHANGES, seconds=SHORTEST_MOVING_S)
    print(f'least time: {least.moving_s:.2f} s')
    assert least.moving_s < 1.02 * SHORTEST_MOVING_S


def test_a_fit_of_the_curves_states_what_is_expected():
    world, _, session = driven(cell(), design().curves, 0)
    found = estimate_moving(Problem.of(session))
    std = dict(zip(found.posterior.free, np.sqrt(np.diag(found.mode.covariance)), strict=False))
    stated = np.array([std[joint] for joint in range(1, 6)])
    expected = np.array(list(design().expected.joint_std.values())[1:6])
    ratio = np.sqrt(np.mean(stated**2) / np.mean(expected**2))
    print(f'stated over expected {ratio:.2f}')
    assert 0.75 < ratio < 1.35
    off = found.model.offsets(found.model.natural(found.mode.z))[1:6] - world.joint_offsets[1:6]
    assert np.all(np.abs(off) < 5.0 * stated)


def test_the_same_seed_gives_the_same_curves():
    first, second = designed(3, exchanges=15), designed(3, exchanges=15)
    np.testing.assert_array_equal(first.rows.q, second.rows.q)
    assert first.expected.joint_std == second.expected.joint_std
    other = designed(4, exchanges=15)
    assert first.rows.q.shape != other.rows.q.shape or np.any(first.rows.q != other.rows.q)


def planner_of(seed=0, seconds=24.0):
    settings = cell().design_settings()
    return TourPlanner(scene(), COUNTS, seed, 25, settings, travel(), (), seconds)


def test_a_session_goes_curve_by_curve_and_ends_with_its_proof(monkeypatch):
    monkeypatch.setattr(moving_design, 'EXCHANGES', 15)
    planner = planner_of()
    plan = plan_collection(planner, planner.rough_places, np.zeros(7))
    splits = [visit.split for visit in plan.visits]
    assert splits == ['registration'] * 3 + [FITTED] + [HELD_OUT] * 8
    assert [visit.pose for visit in plan.visits[4:]] == list(range(8))
    assert [visit.trajectory.is_curve for visit in plan.visits] == ([False] * 4 + [True] * 8)
    curves = planner.moving_design.curves
    for visit, curve in zip(plan.visits[4:], curves, strict=True):
        assert visit.trajectory.duration_s == pytest.approx(curve.duration_s)
    for before, after in zip(plan.visits, plan.visits[1:], strict=False):
        np.testing.assert_allclose(after.trajectory.start, before.q)
    total = sum(visit.trajectory.duration_s + 3.5 for visit in plan.visits)
    assert plan.robot_time_s == pytest.approx(total)
    straight = session_time_s(planner, plan.tour, np.zeros(7))
    assert straight == pytest.approx(total, rel=0.15)
    assert plan.joint_std == planner.moving_design.expected.joint_std
    assert plan.moving_design is planner.moving_design
    # Another curve to the same poses is another plan to confirm.
    held_out = plan.tour.plans[HELD_OUT]
    first = held_out.poses[0]
    bent = replace(first, way=replace(first.way, points=first.way.points + 1e-6))
    name = fingerprint(plan.tour)
    plan.tour.plans[HELD_OUT] = replace(held_out, poses=(bent, *held_out.poses[1:]))
    assert fingerprint(plan.tour) != name


def test_curves_are_prepared_for_sensors_about_where_they_are(monkeypatch):
    """Before the registration; anew where a registered sensor does not see them."""
    monkeypatch.setattr(moving_design, 'EXCHANGES', 15)
    planner = planner_of()
    planner.prepare()
    near_places = {name: T.copy() for name, T in planner.rough_places.items()}
    near_places['mocap'][:3, 3] += (-0.05, 0.06, 0.09)
    tour = planner.moving(near_places)
    prepared = planner.moving_design
    planner.moving(planner.rough_places)
    assert planner.moving_design is prepared
    far_places = {name: T.copy() for name, T in planner.rough_places.items()}
    far_places['mocap'][:3, 3] += (-0.5, 1.5, 0.0)
    planner.moving(far_places)
    assert planner.moving_design is not prepared
    # Another planner prepares the same.
    other = planner_of()
    other.prepare()
    assert fingerprint(other.moving(planner.rough_places)) == fingerprint(tour)


def test_stop_and_go_has_no_curves():
    planner = planner_of(seconds=0.0)
    tour = planner.collection(planner.rough_places)
    assert planner.moving_design is None
    assert all(pose.way is None for plan in tour.plans.values() for pose in plan.poses)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'on_request': True}, 'mocap measures on request'),
        ({'markers': {'sir': np.array([0.1, 0.0, 0.0])}}, 'mocap sees 1 marker, and motion takes'),
    ],
)
def test_sensors_that_cannot_are_refused_with_a_remedy(changes, words):
    (sensor,) = cell().design_settings().sensors
    check_sensors(scene(), [sensor])
    with pytest.raises(InputError, match=words) as refused:
        check_sensors(scene(), [replace(sensor, **changes)])
    assert 'stop and go' in str(refused.value)


@pytest.mark.parametrize('seconds', [3.0, 2000.0, np.nan])
def test_a_time_out_of_range_is_refused(seconds):
    with pytest.raises(InputError, match='give 24 to 600 s'):
        designed(0, seconds=seconds)
