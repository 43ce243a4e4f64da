# SPDX-License-Identifier: Apache-2.0
"""Swapped and frozen markers: found by the robot's own motion, and good ones let through."""

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.collection.pairing import PairedReading, Rejection
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
MARKER = np.array(CELL.markers['sir'])


def reading(q, position, sensor='mocap'):
    return PairedReading(sensor, 'sir', 1.0, q, position, np.full(3, 1e-5), 15)


@pytest.fixture(params=range(5))
def scene(request):
    """Return (rng, plausibility, T_R_N, measure) of a robot off by 0.3 degree at each joint."""
    rng = np.random.default_rng(request.param)
    print(f'seed {request.param}')
    offsets = rng.normal(0, np.deg2rad(0.3), len(CHAIN))
    T_R_N = transforms.transform(
        transforms.rotation_vector_to_matrix(rng.normal(0, 1, 3)), np.array([2.0, 0.1, 1.2])
    )
    # The first registration is off too: three points of a robot that is off.
    off = transforms.transform(
        transforms.rotation_vector_to_matrix(rng.normal(0, 2e-3, 3)), rng.normal(0, 3e-3, 3)
    )

    def measure(q, offset=0.0):
        marker_R = CHAIN.positions(q, MARKER + offset, offsets)
        return transforms.apply(transforms.inverse(T_R_N), marker_R) + rng.normal(0, 5e-5, 3)

    plausibility = Plausibility(CHAIN, {'sir': MARKER})
    return rng, plausibility, T_R_N @ off, measure


def poses(rng, count):
    middle = np.array([0.1, 0.3, 0.0, 1.4, 0.0, 0.6, 0.0])
    return middle + rng.uniform(-0.6, 0.6, (count, len(CHAIN)))


def test_readings_of_a_robot_that_is_off_are_let_through(scene):
    """A wrong refusal would cost the very data that tell the offsets."""
    rng, plausibility, T_R_N, measure = scene
    for q in poses(rng, 60):
        good = reading(q, measure(q))
        assert plausibility.judge(good, T_R_N) is good


def test_a_stray_at_a_fixed_place_is_found(scene):
    rng, plausibility, T_R_N, measure = scene
    stray = np.array([0.3, -0.2, 2.4])
    for number, q in enumerate(poses(rng, 30)):
        if number % 3 == 2:
            verdict = plausibility.judge(reading(q, stray + rng.normal(0, 5e-5, 3)), T_R_N)
            assert isinstance(verdict, Rejection)
            assert verdict.reason == 'swapped'
            assert 'mm from where the robot has the marker' in verdict.detail
        else:
            assert isinstance(plausibility.judge(reading(q, measure(q)), T_R_N), PairedReading)


def test_another_marker_of_the_same_tool_is_found(scene):
    """8 cm beside on the tool: it moves nearly as the marker does."""
    rng, plausibility, T_R_N, measure = scene
    for q in poses(rng, 10):
        plausibility.judge(reading(q, measure(q)), T_R_N)
    for q in poses(rng, 20):
        offset = np.array([0.0, 0.08, 0.0])
        assert isinstance(plausibility.judge(reading(q, measure(q, offset)), T_R_N), Rejection)


def test_what_is_usual_narrows_what_is_allowed():
    """A robot that is off by 1 mm: 3 cm is another marker, though 5 would be allowed at first."""
    plausibility, T = Plausibility(CHAIN, {'sir': MARKER}), np.eye(4)
    rng = np.random.default_rng(0)
    offset = np.array([0.03, 0.0, 0.0])
    for number, q in enumerate(poses(rng, 20)):
        place = CHAIN.positions(q, MARKER)
        good = reading(q, place + rng.normal(0, 5e-4, 3))
        assert plausibility.judge(good, T) is good
        if number > 6:
            verdict = plausibility.judge(reading(q, place + offset), T)
            assert '30 mm from where the robot has the marker (allowed 10 mm)' in verdict.detail
    # Another sensor has its own experience.
    assert isinstance(plausibility.judge(reading(q, place + offset, 'tracker'), T), PairedReading)


def test_a_reading_that_repeats_the_last_one_though_the_arm_moved_is_frozen():
    plausibility = Plausibility(CHAIN, {'sir': MARKER})
    first, second = poses(np.random.default_rng(1), 2)
    shot = np.array([1.0, 2.0, 3.0])
    assert isinstance(plausibility.judge(reading(first, shot), None), PairedReading)
    verdict = plausibility.judge(reading(second, shot.copy()), None)
    moved = np.linalg.norm(CHAIN.positions(first, MARKER) - CHAIN.positions(second, MARKER))
    assert verdict.reason == 'frozen'
    assert f'the arm moved it {1e3 * moved:.0f} mm' in verdict.detail
    # Where the arm did not move, the same reading is possible.
    assert isinstance(plausibility.judge(reading(first, shot), None), PairedReading)


def test_solutions_of_one_pose_do_not_share_a_reading(scene):
    """By the model their marker is at one place; 3 mm beside the true one was recorded once."""
    rng, plausibility, T_R_N, measure = scene
    (first,) = poses(rng, 1)
    inverse = InverseKinematics(CHAIN, held=CELL.held(CHAIN))
    found = inverse.usable(inverse.solutions_of_each(CHAIN.forward(first)[None])[0])
    second = found[np.argmax(np.max(np.abs(found - first), axis=1))]
    np.testing.assert_allclose(
        CHAIN.positions(first, MARKER), CHAIN.positions(second, MARKER), atol=1e-6
    )
    shot = measure(first)
    assert isinstance(plausibility.judge(reading(first, shot), T_R_N), PairedReading)
    verdict = plausibility.judge(reading(second, shot.copy()), T_R_N)
    assert verdict.reason == 'frozen'
    # At the same configuration once more, as a coarse sensor may have it.
    assert isinstance(plausibility.judge(reading(first + 1e-4, shot), T_R_N), PairedReading)


def test_not_a_number_is_not_the_marker():
    plausibility = Plausibility(CHAIN, {'sir': MARKER})
    verdict = plausibility.judge(reading(np.zeros(7), np.full(3, np.nan)), np.eye(4))
    assert verdict.reason == 'swapped'


def test_a_reference_may_be_beside_its_place_but_not_frozen(scene):
    """Where a sensor was moved by 20 mm it is the references that must tell it."""
    rng, _, T_R_N, measure = scene
    plausibility = Plausibility(CHAIN, {'sir': MARKER}, 0.08)
    for q in poses(rng, 30):
        plausibility.judge(reading(q, measure(q)), T_R_N)
    usual = plausibility._allowed_m('mocap')
    first, second = poses(rng, 2)
    error = transforms.apply(T_R_N, measure(first)) - CHAIN.positions(first, MARKER)
    onward = T_R_N[:3, :3].T @ (error / np.linalg.norm(error))
    moved = reading(first, measure(first) + onward * usual)
    assert isinstance(plausibility.judge(moved, T_R_N), Rejection)
    assert plausibility.judge(moved, T_R_N, anywhere=True) is moved
    stray = reading(first, measure(first) + onward * 0.3)
    assert isinstance(plausibility.judge(stray, T_R_N, anywhere=True), Rejection)
    frozen = plausibility.judge(reading(second, moved.position), T_R_N, anywhere=True)
    assert isinstance(frozen, Rejection)
    assert frozen.reason == 'frozen'


BODY = {'sir': MARKER, 'b': np.array([0.02, 0.09, 0.0]), 'c': np.array([0.04, -0.06, 0.05])}


T_R_N = transforms.transform(np.eye(3), np.array([2.0, 0.1, 1.2]))


def frame_of(q, places=BODY):
    """Return the readings of a body's markers at these places of the tool."""
    T_N_R = transforms.inverse(T_R_N)
    return [
        replace(reading(q, transforms.apply(T_N_R, CHAIN.positions(q, place))), marker=name)
        for name, place in places.items()
    ]


@pytest.mark.parametrize('registered', [False, True])
def test_a_frame_whose_markers_were_exchanged_is_refused_as_a_whole(registered):
    seed = 4
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    true = {name: place + 0.5e-3 * rng.standard_normal(3) for name, place in BODY.items()}
    given = T_R_N if registered else None
    for q in poses(rng, 20):
        plausibility = Plausibility(CHAIN, BODY)
        good = frame_of(q, true)
        assert plausibility.judge_frame(good, given) == good
        for marker, other in (('sir', 'b'), ('sir', 'c'), ('b', 'c')):
            swapped = {**true, marker: true[other], other: true[marker]}
            (verdict,) = plausibility.judge_frame(frame_of(q, swapped), given)
            assert isinstance(verdict, Rejection)
            assert verdict.reason == 'swapped'
            assert 'mm apart' in verdict.detail


def test_a_stray_that_is_taken_for_a_further_marker_is_refused_before_any_registration():
    rng = np.random.default_rng(5)
    (q,) = poses(rng, 1)
    readings = frame_of(q)
    readings[2] = replace(readings[2], position=readings[2].position + (0.0, 0.008, 0.0))
    (verdict,) = Plausibility(CHAIN, BODY).judge_frame(readings, None)
    assert verdict.reason == 'swapped'


def test_every_marker_of_a_frame_has_a_last_reading_of_its_own():
    """A sensor that repeats a frame is frozen; two markers of one frame are not compared."""
    rng = np.random.default_rng(6)
    first, second = poses(rng, 2)
    plausibility = Plausibility(CHAIN, BODY)
    readings = frame_of(first)
    assert plausibility.judge_frame(readings, T_R_N) == readings
    again = [replace(marker_reading, q=second) for marker_reading in readings]
    assert [item.reason for item in plausibility.judge_frame(again, None)] == ['frozen'] * 3
