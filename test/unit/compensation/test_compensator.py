# SPDX-License-Identifier: Apache-2.0
"""The correction against what each effect is defined to do, and its behaviour at its limits."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from worlds.calibration_scenes import scene
from worlds.compensation_files import arm as arm_of
from worlds.discovery_scenes import residuals_of
from worlds.hidden_tours import robot
from worlds.sliding_cells import rail, telescope

from remaster_ros.compensation.arm_model import ArmModel, Function, Geometry, JointTerm
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.of_result import slots_of
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.kinematics.transforms import apply, matrix_to_rotation_vector

SLIDING = {'rail': rail, 'telescope': telescope}


def arm(name: str, **more: object) -> ArmModel:
    """Return an arm as drawn, but for what is given."""
    urdf = SLIDING[name]() if name in SLIDING else robot(name)
    return arm_of(urdf, **{'reference_c': 20.0, 'mean_c': 20.0, **more})


def erring(name: str, seed: int) -> ArmModel:
    """Return an arm with offsets of 0.3°, waves, compliances, lengths and tilts."""
    rng = np.random.default_rng(seed)
    k = len(arm(name).chain)
    terms = [
        JointTerm(j, 'x', Function(driver, form, j, order), 2e-4 * rng.standard_normal(1) * unit)
        for j in range(k)
        for driver, form, order, unit in (
            ('angle', 'sin', 1, 1.0),
            ('angle', 'cos', 2, 1.0),
            ('gravity_torque', 'linear', 0, 0.1),
        )
    ]
    geometry = Geometry(
        3e-4 * rng.standard_normal((k + 1, 3)), 5e-4 * rng.standard_normal((k + 1, 3))
    )
    offsets = np.radians(0.3) * rng.standard_normal(k) * arm(name).chain.per_radian
    return arm(name, joint_offsets=offsets, joint_terms=tuple(terms), geometry=geometry)


def configurations(model: ArmModel, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = np.maximum(model.chain.lower, -2.5), np.minimum(model.chain.upper, 2.5)
    return rng.uniform(low, high, (count, model.joints))


@pytest.fixture(scope='module')
def context():
    """Effects of every kind can be tested in it: masses, times, moves and temperatures."""
    session, _ = scene(3, poses=12, validation=4)
    m = session.measurements
    warm = 20.0 + 8.0 * (m.stamp_s - m.stamp_s.min()) / np.ptp(m.stamp_s)
    session = replace(session, measurements=replace(m, temperature_c=warm))
    return residuals_of(session).context


def the_candidates(context):
    """Give a cell of each effect for each place, driver, form and size that it has."""
    for effect in EFFECTS.values():
        if effect.needs(context):
            continue
        seen = set()
        for candidate in effect.candidates(context):
            driver = candidate.driver.rstrip('0123456789')
            key = candidate.place, driver, candidate.form, candidate.size, bool(candidate.curve)
            if key not in seen and not candidate.of_measurement:
                seen.add(key)
                yield candidate


def test_each_candidate_moves_the_arm_as_its_effect_defines(context):
    """What the file says of an effect is what the fit meant, for all that the registry has."""
    chain, m = context.chain, context.measurements
    nothing = arm('iiwa7', chain=chain, joint_offsets=context.joint_offsets)
    first = m.temperature_c[np.argmin(m.stamp_s)]
    nothing = replace(nothing, reference_c=first, mean_c=first)
    corrected, leftovers = set(), set()
    for candidate in the_candidates(context):
        slots = list(slots_of(candidate, chain))
        if not slots:
            leftovers.add((candidate.name, candidate.place, candidate.driver.partition('_of_')[0]))
            continue
        corrected.add(candidate.name)
        design = candidate.columns(context)
        expected = design.displacement(context)
        for parameter in range(0, candidate.size, max(1, candidate.size // 4)):
            size = 1e-5 / max(1e-12, np.abs(expected[:, :, parameter]).max())
            model = nothing
            for slot, matrix in slots:
                value = size * matrix[:, parameter]
                model = with_slot(model, slot, value)
            points = [
                apply(variant.state(m.q, m.temperature_c).tool, context.markers[context.marker])
                for variant in (model, nothing)
            ]
            moved = points[0] - points[1]
            if candidate.happened:
                # As it is since.
                after = design.values[:, parameter] == 1.0
                moved, wanted = moved[after], size * expected[after, :, parameter]
            else:
                wanted = size * expected[:, :, parameter]
            np.testing.assert_allclose(
                moved, wanted, rtol=0, atol=2e-9, err_msg=str(candidate.key)
            )
    assert {
        *('joint_compliance', 'encoder_eccentricity', 'encoder_scale', 'gear_periodic'),
        *('joint_error_curve', 'joint_coupling', 'link_length', 'joint_axis_tilt'),
        *('thermal_growth', 'base_compliance', 'lateral_compliance', 'step', 'unnamed'),
    } == corrected
    # What remains depends on what no controller is told, is at the marker, or is to be mended.
    uncorrected_effects = {
        (name, driver) for name, place, driver in leftovers if place != 'marker'
    }
    assert uncorrected_effects - {
        ('base_tipping', 'gravity_moment'),
        ('thermal_growth', 'temperature'),
    } <= {
        (name, driver)
        for name, driver in uncorrected_effects
        if driver in ('approach', 'last_move', 'time')
    }, leftovers


def with_slot(model, slot, value):
    from remaster_ros.compensation.arm_model import BaseTerm

    if slot.kind == 'joint':
        term = JointTerm(slot.joint, slot.effect, slot.function, value)
        return replace(model, joint_terms=(*model.joint_terms, term))
    if slot.kind == 'base':
        term = BaseTerm(slot.effect, slot.function, value)
        return replace(model, base_terms=(*model.base_terms, term))
    if slot.kind == 'lateral':
        return replace(model, lateral_compliance=model.lateral_compliance + value * one_at(slot))
    shifts, turns = np.zeros((2, model.joints + 1, 3))
    shifts[slot.joint], turns[slot.joint] = value[:3], value[3:]
    before = getattr(model, slot.kind)
    changed = Geometry(before.shifts + shifts, before.turns + turns)
    return replace(model, **{slot.kind: changed})


def one_at(slot):
    unit = np.zeros(7)
    unit[slot.joint] = 1.0
    return unit


@pytest.mark.parametrize('name', ['six', 'lwr4plus', *SLIDING])
def test_derivative_is_that_of_the_model(name):
    model = erring(name, 2)
    q = configurations(model, 5, 1)
    derivative = model.derivative(model.state(q), 'mocap', 'sir')
    rng = np.random.default_rng(3)
    step = 1e-7 * rng.standard_normal(derivative.shape[2])
    units = np.array([1e-3 if 'growth' in name else 1.0 for name in model.parameter_names])
    moved = model.with_step(step * units)
    change = moved.in_sensor(moved.state(q), 'mocap', 'sir') - model.in_sensor(
        model.state(q), 'mocap', 'sir'
    )
    # That torques change with the offsets is left out: a ten-thousandth.
    np.testing.assert_allclose(change, derivative @ (step * units), rtol=0, atol=4e-10)


BUDGET_RAD = np.radians(2.0)
# What a pose that is reached may be off, m and rad.
REACHED = 1e-5


def pose_errors(model: ArmModel, q: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return shift, m, and turn, rad, of the tool from that of the nominal robot, (n, 2)."""
    wanted, reached = model.chain.forward(q), model.state(command).tool
    turn = reached[:, :3, :3] @ np.swapaxes(wanted[:, :3, :3], 1, 2)
    shift = reached[:, :3, 3] - wanted[:, :3, 3]
    both = (shift, matrix_to_rotation_vector(turn))
    return np.stack([np.linalg.norm(errors, axis=1) for errors in both], axis=1)


@pytest.mark.parametrize('name', ['six', 'lwr4plus', 'iiwa14', *SLIDING])
def test_the_tool_is_where_the_nominal_robot_has_it(name):
    """Wherever two degrees a joint suffice; elsewhere what is left is stated."""
    model = erring(name, 4)
    compensator, unit = Compensator(model), model.chain.per_radian
    q = configurations(model, 400, 5)
    found = compensator.correct(q)
    off, before = pose_errors(model, q, found.command), pose_errors(model, q, q)
    np.testing.assert_allclose(found.residual_m, off[:, 0], atol=1e-12)
    np.testing.assert_allclose(found.residual_rad, off[:, 1], atol=1e-9)
    assert np.array_equal(found.incomplete, off.max(axis=1) > REACHED)
    # By a fade of singular directions 0.96 of an LWR's were left.
    assert found.incomplete.mean() < 0.2
    rms = [np.sqrt(np.mean(pose_error[:, 0] ** 2)) for pose_error in (off, before)]
    assert rms[0] < 0.1e-3 < 0.03 * rms[1]
    errors = np.abs(compensator.angle_errors(q) / unit)
    most = np.abs((found.command - q) / unit).max(axis=1)
    assert np.all(most <= np.maximum(BUDGET_RAD, errors.max(axis=1)) + 1e-9)
    is_complete = ~found.incomplete
    # But for poses out of reach: an arm is not stretched further by more motion.
    assert np.mean(most[~is_complete] > 0.99 * BUDGET_RAD) > 0.5
    back = compensator.true(found.command)
    np.testing.assert_allclose(back[is_complete], q[is_complete], rtol=0, atol=5e-5)
    # The way back of what is not reached: the nominal robot where the tool then is.
    difference = model.chain.forward(back) @ np.linalg.inv(model.state(found.command).tool)
    assert np.mean(np.abs(difference - np.eye(4)).max(axis=(1, 2)) < REACHED) > 0.8


@pytest.mark.parametrize('budget_deg', [2.0, 0.5])
def test_on_the_bound_there_is_no_better_pose(budget_deg):
    """Against a general solver, of another method, from the found point and from others."""
    model, rng = erring('lwr4plus', 4), np.random.default_rng(9)
    compensator = Compensator(model, np.radians(budget_deg))
    q = configurations(model, 300, 5)
    found = compensator.correct(q)
    errors = compensator.angle_errors(q)
    bound = np.maximum(np.radians(budget_deg), np.abs(errors))
    frames = model.chain.frames(model.sampled_angles())
    lever = np.linalg.norm(
        model.chain.velocities(frames, (frames[:, -1] @ model.chain.T_fixed[-1])[:, :3, 3]), axis=1
    ).max()

    def weighted(change, row):
        wanted = model.chain.forward(q[row])
        reached = model.state((q[row] + change)[None]).tool[0]
        turn = matrix_to_rotation_vector(reached[:3, :3] @ wanted[:3, :3].T)
        return np.concatenate(((reached - wanted)[:3, 3] / lever, 0.05 * turn))

    rows = np.flatnonzero(found.incomplete)[:12]
    assert len(rows) == 12
    for row in rows:
        here = found.command[row] - q[row]
        error = np.linalg.norm(weighted(here, row))
        for start in (0.999 * here, rng.uniform(-0.5, 0.5, 7) * bound[row]):
            other = scipy.optimize.least_squares(
                weighted, start, bounds=(-bound[row], bound[row]), args=(row,)
            )
            assert error <= np.sqrt(2.0 * other.cost) * 1.02 + 1e-8


def geometric_jacobian(chain, q):
    frames = chain.frames(q)
    axes = chain.axes_in_base(frames)
    arms = chain.forward(q)[:, None, :3, 3] - frames[..., :3, 3]
    turning = np.concatenate((np.cross(axes, arms), axes), axis=2)
    # A quarter of a metre of what slides counts as a radian.
    sliding = np.concatenate((0.25 * axes, 0.0 * axes), axis=2)
    return np.where(chain.slides[:, None], sliding, turning).swapaxes(1, 2)


def test_seven_joints_change_no_more_than_they_must():
    model = erring('lwr4plus', 6)
    q = configurations(model, 200, 7)
    found = Compensator(model).correct(q)
    null = np.linalg.svd(geometric_jacobian(model.chain, found.command), full_matrices=True)[2]
    along = np.abs(np.sum(null[:, -1] * (found.command - q), axis=1))
    assert along[~found.incomplete].max() < 1e-3


def test_beyond_the_range_of_a_curve_its_end_holds_and_the_row_is_marked():
    knots = np.concatenate((np.full(3, -1.0), np.linspace(-1.0, 1.0, 6), np.full(3, 1.0)))
    curve = Function('angle', 'bspline', 1, knots=knots, degree=3)
    heights = np.linspace(-1e-3, 2e-3, 8)
    model = arm('six', joint_terms=(JointTerm(1, 'x', curve, heights),))
    q = np.zeros((4, 6))
    q[:, 1] = (-1.4, 0.0, 0.99, 1.7)
    found = Compensator(model).correct(q)
    assert found.outside_range.tolist() == [True, False, False, True]
    np.testing.assert_allclose(model.state(q).angles[[0, 3], 1] - q[[0, 3], 1], [-1e-3, 2e-3])


def test_temperatures_are_per_row_and_that_of_the_measurements_where_none_is_given():
    shifts = np.zeros((7, 3))
    shifts[:, 2] = 1e-5
    growth = Geometry(shifts, np.zeros((7, 3)))
    compensator = Compensator(arm('six', growth=growth, reference_c=20.0, mean_c=25.0))
    q = configurations(compensator.model, 3, 1)
    rows = compensator.command(q, [20.0, 25.0, 30.0])
    assert np.array_equal(rows[0], q[0])
    np.testing.assert_array_equal(rows[1], compensator.command(q[1]))
    np.testing.assert_array_equal(rows[2], compensator.command(q, 30.0)[2])


def test_any_shape_and_no_rows():
    compensator = Compensator(erring('lwr4plus', 1))
    q = configurations(compensator.model, 6, 2)
    every = compensator.command(q)
    np.testing.assert_array_equal(compensator.command(q.reshape(2, 3, 7)), every.reshape(2, 3, 7))
    np.testing.assert_allclose(compensator.command(q[0]), every[0], rtol=0, atol=1e-14)
    assert compensator.command(np.zeros((0, 7))).shape == (0, 7)
    with pytest.raises(ValueError, match='7'):
        compensator.command(np.zeros(6))
    with pytest.raises(ValueError, match='finite'):
        compensator.command(np.full(7, np.nan))


@pytest.mark.parametrize('name', ['six', 'lwr4plus'])
def test_a_quarter_of_an_arm_is_commanded_as_the_whole_one(name):
    """Singularities are those of an arm's shape, whatever its size; errors a tenth of a degree."""
    model = replace(erring(name, 4), joint_terms=())
    slight = Geometry(0.1 * model.geometry.shifts, 0.1 * model.geometry.turns)
    origins = model.chain.T_fixed.copy()
    origins[:, :3, 3] *= 0.25
    small = replace(
        model,
        chain=replace(model.chain, T_fixed=origins),
        geometry=Geometry(0.25 * slight.shifts, slight.turns),
    )
    q = configurations(model, 200, 5)
    full_correction = Compensator(replace(model, geometry=slight)).correct(q)
    part = Compensator(small).correct(q)
    np.testing.assert_allclose(part.command, full_correction.command, atol=1e-9)
    np.testing.assert_allclose(part.residual_m, 0.25 * full_correction.residual_m, atol=1e-9)
    # Most directions are those of a tool that goes where it is wanted.
    assert np.median(full_correction.residual_m) < 1e-5


@pytest.mark.parametrize(('name', 'wrist'), [('six', 4), ('lwr4plus', 5)])
@pytest.mark.parametrize('warmer_k', [0.0, 40.0])
def test_an_arm_that_only_grows_is_not_sent_astray_at_a_singularity(name, wrist, warmer_k):
    """Cold it has no error at all; at a singularity a direction has no size."""
    model = arm(name)
    turns = np.zeros((model.joints + 1, 3))
    share = np.random.default_rng(1).uniform(0.0, 2.4e-5, (model.joints + 1, 1))
    model = replace(model, growth=Geometry(share * model.chain.T_fixed[:, :3, 3], turns))
    q = configurations(model, 2000, 2)
    q[:1000, wrist] *= 1e-4
    q[0, wrist] = 0.0
    compensator, warm = Compensator(model), model.reference_c + warmer_k
    found = compensator.correct(q, warm)
    before = compensator.tool(q, warm)[:, :3, 3] - model.chain.forward(q)[:, :3, 3]
    most = np.abs(found.command - q).max()
    assert most <= (BUDGET_RAD + 1e-12 if warmer_k else np.radians(1e-6))
    assert found.residual_m.max() < 1e-9 + np.linalg.norm(before, axis=1).max()
    if warmer_k:
        assert np.median(found.residual_m) < 0.1 * np.median(np.linalg.norm(before, axis=1))
