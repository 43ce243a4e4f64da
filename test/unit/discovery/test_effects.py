# SPDX-License-Identifier: Apache-2.0
"""Every effect's columns against numerical derivatives of its own equation."""

import ast
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN
from worlds.discovery_scenes import residuals_of, session_with

from remaster_ros.discovery.effects.base import PLACES, Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.sizes import along_mean, number
from remaster_ros.discovery.effects.splines import Curve, basis, centers, knot_vector, roughness
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, rotation_vector_to_matrix, transform
from remaster_ros.simulation.hidden_effects import NAMED

STEP = 1e-6
DISCOVERY = Path(__file__).parents[3] / 'remaster_ros' / 'discovery'


@cache
def scene_of(gravity: bool = True) -> Context:
    session = session_with(11, poses=8, validation=0, sensor_count=2)
    rows = session.measurements
    warm = 20.0 + np.linspace(0.0, 4.0, len(rows))
    session = replace(session, measurements=replace(rows, temperature_c=warm))
    scene = residuals_of(session).context
    return scene if gravity else replace(scene, chain=replace(CHAIN, has_inertials=False))


def candidates_of(name: str) -> list[Candidate]:
    return list(EFFECTS[name].candidates(scene_of()))


def moved(chain: SerialChain, scene: Context) -> np.ndarray:
    points = chain.forward(scene.q)
    return apply(points, scene.markers[scene.marker])


@pytest.mark.parametrize('name', EFFECTS)
def test_every_candidate_has_columns_of_its_size_and_a_place_of_the_table(name):
    scene = scene_of()
    effect = EFFECTS[name]
    assert effect.needs(scene) == ''
    candidates = [
        c for c in effect.candidates(scene) if c.name != 'gear_periodic'
    ] or candidates_of(name)[:20]
    keys = [candidate.key for candidate in candidates]
    assert len(set(keys)) == len(keys)
    for candidate in candidates:
        columns = candidate.columns(scene)
        assert columns.displacement(scene).shape == (len(scene), 3, candidate.size)
        assert np.all(np.isfinite(columns.values))
        assert candidate.place in PLACES
        assert candidate.drawn_from >= 1
        assert len(set(candidate.parameters)) == candidate.size
        assert all(1 <= joint <= scene.joints for joint in candidate.joints)
        if candidate.penalty is not None:
            assert np.all(np.linalg.eigvalsh(candidate.penalty) > 0.0)


@pytest.mark.parametrize('name', EFFECTS)
def test_columns_of_some_rows_are_those_they_have_among_all(name):
    """The search of a large session works on parts of it; no column may depend on which."""
    scene = scene_of()
    rows = np.random.default_rng(5).permutation(len(scene))[: len(scene) // 3]
    part = scene.at(rows)
    for candidate in candidates_of(name):
        if candidate.name == 'gear_periodic' and candidate.label != '7':
            continue
        all_columns, part_columns = candidate.columns(scene), candidate.columns(part)
        assert all_columns.at == part_columns.at
        np.testing.assert_allclose(
            part_columns.displacement(part),
            all_columns.displacement(scene)[rows],
            rtol=1e-9,
            atol=1e-12,
        )


@pytest.mark.parametrize('name', EFFECTS)
def test_every_effect_says_what_a_technician_and_a_scientist_need(name):
    effect = EFFECTS[name]
    assert effect.name == name
    assert effect.equation
    assert effect.source
    assert effect.separate_by
    assert effect.plausible is None or effect.plausible[0] < effect.plausible[1]
    assert set(re.findall(r'{(\w+)}', effect.sentence)) <= {
        'subject',
        'other',
        'driver',
        'place',
        'when',
    }


@pytest.mark.parametrize(
    ('name', 'feature'),
    [
        ('joint_compliance', lambda s, j: s.chain.gravity_torque(s.q)[:, j]),
        ('encoder_scale', lambda s, j: s.measurements.q[:, j]),
        ('settling', lambda s, j: -np.nan_to_num(s.measurements.q - s.measurements.from_q)[:, j]),
    ],
)
def test_effects_of_an_angle_turn_the_joint_by_their_driver(name, feature):
    scene = scene_of()
    for candidate in candidates_of(name):
        joint = candidate.joints[0] - 1
        added = np.zeros_like(scene.q)
        added[:, joint] = STEP * feature(scene, joint)
        points = scene.markers[scene.marker]
        shift = CHAIN.positions(scene.q + added, points) - CHAIN.positions(scene.q, points)
        columns = candidate.columns(scene).displacement(scene)[:, :, 0]
        np.testing.assert_allclose(columns, shift / STEP, atol=3e-5 * np.abs(columns).max() + 1e-9)


@pytest.mark.parametrize('name', ['link_length', 'joint_axis_tilt'])
def test_geometry_columns_are_those_of_a_chain_built_that_way(name):
    scene = scene_of()
    for candidate in candidates_of(name):
        if candidate.size > 1:
            continue
        T_fixed = CHAIN.T_fixed.copy()
        if name == 'link_length':
            link = candidate.joints[0]
            offset = CHAIN.T_fixed[link][:3, 3]
            axis = offset / np.linalg.norm(offset) if candidate.variant == 'along' else None
            step = STEP * (np.eye(3)['xyz'.index(candidate.variant)] if axis is None else axis)
            T_fixed[link] = transform(np.eye(3), step) @ T_fixed[link]
        else:
            fixed = candidate.joints[0] - 1
            turn = rotation_vector_to_matrix(STEP * np.eye(3)['xyz'.index(candidate.variant)])
            T_fixed[fixed] = T_fixed[fixed] @ transform(turn, np.zeros(3))
        shift = moved(replace(CHAIN, T_fixed=T_fixed), scene) - moved(CHAIN, scene)
        columns = candidate.columns(scene).displacement(scene)[:, :, 0]
        np.testing.assert_allclose(columns, shift / STEP, atol=1e-5)


def test_thermal_growth_is_that_of_every_link():
    scene = scene_of()
    candidate = next(
        c for c in candidates_of('thermal_growth') if c.driver == 'temperature' and not c.joints
    )
    columns = candidate.columns(scene).displacement(scene)[:, :, 0]
    row = len(scene) // 2
    grown = CHAIN.T_fixed.copy()
    grown[:, :3, 3] *= 1.0 + STEP * scene.warming[row]
    shift = moved(replace(CHAIN, T_fixed=grown), scene) - moved(CHAIN, scene)
    np.testing.assert_allclose(columns[row], shift[row] / STEP, atol=1e-5)


def test_sensor_effects_act_in_the_frame_of_their_own_sensor():
    scene = scene_of()
    for name in ('sensor_scale', 'sensor_distortion', 'registration_drift'):
        for candidate in candidates_of(name):
            columns = candidate.columns(scene).displacement(scene)
            mine = scene.sensor == scene.sensor_names.index(candidate.subject)
            assert np.all(columns[~mine] == 0.0)
    candidate = next(
        c for c in candidates_of('sensor_scale') if c.variant == '' and c.subject == 'mocap'
    )
    mine = scene.sensor == scene.sensor_names.index('mocap')
    shift = candidate.columns(scene).displacement(scene)[mine, :, 0]
    in_sensor = np.einsum('nji,nj->ni', scene.sensor_turn[mine], shift)
    np.testing.assert_allclose(in_sensor, scene.in_sensor[mine], atol=1e-9)


def test_backlash_stays_on_the_flank_until_the_joint_moves_again():
    scene = scene_of()
    rows = scene.measurements
    q = np.zeros((5, scene.joints))
    came = np.zeros((5, scene.joints))
    q[:, 1], came[:, 1] = (0.1, 0.1, 0.0, 0.0, 0.2), (np.nan, 0.1, 0.1, 0.0, 0.0)
    few = replace(rows.select(np.arange(5)), q=q, from_q=came, stamp_s=np.arange(5.0))
    approach = replace(scene, measurements=few).approach
    np.testing.assert_array_equal(approach[:, 1], [0.0, 0.0, -1.0, -1.0, 1.0])


def test_effects_that_a_session_cannot_show_say_why():
    bare = scene_of(gravity=False)
    assert 'link masses' in EFFECTS['joint_compliance'].needs(bare)
    rows = bare.measurements
    nowhere = replace(rows, from_q=np.full_like(rows.from_q, np.nan))
    assert 'came from' in EFFECTS['backlash'].needs(replace(bare, measurements=nowhere))
    at_once = replace(rows, stamp_s=np.zeros(len(rows)))
    assert 'time' in EFFECTS['registration_drift'].needs(replace(bare, measurements=at_once))


def test_gravity_moment_about_the_axis_is_the_torque():
    scene = scene_of()
    axes = CHAIN.axes_in_base(scene.frames)
    along = np.sum(axes * scene.gravity_moment, axis=-1)
    np.testing.assert_allclose(along, scene.gravity_torque, atol=1e-9)


@pytest.mark.parametrize('name', EFFECTS)
def test_every_candidate_has_a_size_in_words_and_its_effect_a_remedy(name):
    scene, effect = scene_of(), EFFECTS[name]
    assert effect.remedy.endswith('.')
    seed = 12
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    for candidate in candidates_of(name)[::7]:
        draws = 1e-4 * (1.0 + 0.1 * rng.standard_normal((50, candidate.size)))
        text = effect.size(scene, candidate, draws)
        assert re.search('[′ ]', text), text
        assert re.search('(′|mm)', text), text
        assert '±' in text
        assert 'nan' not in text
        assert '-' not in text
        # All signs: a negative length is a shorter link, not a negative longer one.
        assert effect.size(scene, candidate, -draws)


def draws_of(*values: float, share: float = 0.02) -> np.ndarray:
    """Return 400 draws about values with standard deviations that are a share of the first."""
    rng = np.random.default_rng(13)
    return np.array(values) + share * abs(values[0]) * rng.standard_normal((400, len(values)))


def test_sizes_are_the_ones_that_were_put_in():
    scene = scene_of()

    def size(name, draws, **chosen):
        candidate = next(
            c
            for c in candidates_of(name)
            if all(getattr(c, key) == value for key, value in chosen.items())
        )
        return EFFECTS[name].size(scene, candidate, draws)

    text = size('link_length', draws_of(0.75e-3), joints=(2,), variant='along')
    assert re.fullmatch(r'link 2 is 0\.7[45]\d? mm ± 0\.01\d mm longer than the model', text), text
    assert 'shorter' in size('link_length', draws_of(-0.75e-3), joints=(2,), variant='along')
    torque = np.abs(scene.gravity_torque[:, 1]).max()
    text = size('joint_compliance', draws_of(5.0 * np.radians(1 / 60) / torque), joints=(2,))
    assert re.fullmatch(rf'joint 2 turns [45]\.\d+′ ± 0\.1\d?′ under {torque:.0f} N m', text), text
    text = size('backlash', draws_of(np.radians(1 / 60)), joints=(4,))
    assert re.match(r'joint 4 stops (2\.0|1\.9)', text), text
    text = size('sensor_scale', draws_of(-2e-3), subject='mocap', variant='')
    assert re.fullmatch(r'mocap measures 1 m [12]\.\d+ mm ± 0\.0\d mm too short', text), text
    text = size('gear_periodic', draws_of(3e-4, 4e-4), joints=(3,), variant='51')
    assert re.match(r'joint 3 errs by ±1\.7\d?′ ± 0\.\d+′, 51 times a turn', text), text
    # The wave of the cell, drawn at the angles that the joint took.
    q = scene.measurements.q[:, 1]
    wave = 1e-3 * np.sin(q)
    most = np.abs(wave - wave.mean()).max() / np.radians(1 / 60)
    text = size('encoder_eccentricity', draws_of(1e-3, 0.0, share=1e-4), joints=(2,), variant='1')
    assert abs(float(re.search(r'up to ([\d.]+)′', text)[1]) - most) < 0.01, text


def test_a_number_has_the_digits_that_its_uncertainty_leaves():
    assert number(0.7532, 0.03, ' mm') == '0.75 mm ± 0.03 mm'
    assert number(-0.7532, 0.013, ' mm') == '−0.753 mm ± 0.013 mm'
    assert number(-0.0001, 0.3, '′') == '0.0′ ± 0.3′'
    assert number(132.2, 25.0, '′') == '132′ ± 25′'


def test_splines_sum_to_one_and_repeat_straight_lines():
    seed = 5
    print(f'seed {seed}')
    x = np.random.default_rng(seed).uniform(-1.0, 2.0, 200)
    knots = knot_vector(-1.0, 2.0, 0.25)
    values = basis(x, knots)
    np.testing.assert_allclose(values.sum(axis=1), 1.0)
    np.testing.assert_allclose(values @ centers(knots), x, atol=1e-12)
    line = centers(knots)
    centered = line - line.mean()
    assert centered @ roughness(len(line)) @ centered < 0.01 * centered @ centered


@pytest.mark.parametrize('turns_over', [False, True])
@pytest.mark.parametrize('reach', [1.5, 2.0 * np.pi])
def test_a_curve_has_zero_mean_and_every_other_shape_of_its_splines(turns_over, reach):
    seed = 6
    print(f'seed {seed}')
    x = np.random.default_rng(seed).uniform(0.4, 0.4 + reach, 300)
    curve = Curve.of(x, 0.05, turns_over=turns_over)
    assert curve.closed == (turns_over and reach > 6.0)
    columns = curve.columns(x)
    np.testing.assert_allclose(columns.mean(axis=0), 0.0, atol=1e-12)
    splines = curve.splines(x)
    np.testing.assert_allclose(splines.sum(axis=1), 1.0)
    # With the constant it spans what the splines span.
    joined = np.column_stack((np.ones(len(x)), columns))
    remainder = splines - joined @ np.linalg.lstsq(joined, splines, rcond=None)[0]
    assert np.abs(remainder).max() < 1e-9
    assert columns.shape[1] == splines.shape[1] - 1 == len(curve.places) == len(curve.penalty)


def test_a_joint_that_turns_over_has_the_same_curve_a_turn_further():
    seed = 7
    print(f'seed {seed}')
    x = np.random.default_rng(seed).uniform(np.radians(-308.0), np.radians(-100.0), 200)
    curve = Curve.of(x, 0.05, turns_over=True)
    # Where most rows are as they were measured, places are the measured angles.
    np.testing.assert_allclose(curve.in_turn(x), x)
    np.testing.assert_allclose(curve.columns(x + 2.0 * np.pi), curve.columns(x), atol=1e-9)
    assert not np.allclose(Curve.of(x, 0.05).columns(x + 2.0 * np.pi), curve.columns(x))
    again = Curve.of(x + 2.0 * np.pi, 0.05, turns_over=True)
    np.testing.assert_allclose(again.columns(x), curve.columns(x), atol=1e-9)


def test_a_closed_curve_runs_into_itself():
    x = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    curve = Curve.of(x, 0.03, turns_over=True)
    edge = np.array([curve.start - 1e-9, curve.start + 1e-9])
    below, above = curve.columns(edge)
    np.testing.assert_allclose(below, above, atol=1e-7)


def test_a_joint_that_moves_in_held_out_rows_alone_is_not_tested():
    scene = scene_of()
    m = scene.measurements
    held_out = m.pose % 3 == 0
    q = m.q.copy()
    q[~held_out, 2] = 0.3
    still = replace(scene, measurements=replace(m, q=q, is_validation=held_out))
    assert 3 not in still.moving
    joints = {candidate.joints for candidate in EFFECTS['joint_error_curve'].candidates(still)}
    assert (3,) not in joints
    assert (2,) in joints


def test_a_curve_is_seen_where_it_was_measured():
    x = np.radians(np.r_[np.arange(-170.0, -100.0), np.arange(-50.0, 30.0)])
    curve = Curve.of(x, 0.0, finest=np.radians(4.0), turns_over=True)
    at = np.radians([-140.0, -102.0, -75.0, -49.0, 220.0, 100.0, 32.0, 187.0])
    expected = [True, True, False, True, True, False, True, True]
    np.testing.assert_array_equal(curve.seen(at), expected)


def test_every_named_effect_can_be_hidden():
    """In the simulation's own equations, so that a test can ask whether it is found."""
    named = {name for name, effect in EFFECTS.items() if not effect.reported_as}
    assert set(NAMED) == named - {'unnamed'}


@pytest.mark.parametrize('path', sorted(DISCOVERY.glob('*.py')), ids=lambda path: path.stem)
def test_the_search_names_no_effect(path):
    """What is special about an effect stands in its own file, as one of its attributes."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert not texts & set(EFFECTS)


@pytest.mark.parametrize('size', [1, 3])
def test_a_size_of_draws_about_zero_is_their_mean_and_spread_not_those_of_absolute_values(size):
    mean = np.array([-1.4, 0.3, 0.2])[:size]
    draws = mean + 1.3 * np.random.default_rng(5).standard_normal((4000, size))
    along = along_mean(draws)
    assert along.mean() == pytest.approx(np.linalg.norm(draws.mean(axis=0)))
    assert along.std() == pytest.approx(1.3, rel=0.05)
    assert np.linalg.norm(draws, axis=1).mean() > 1.1 * along.mean()
