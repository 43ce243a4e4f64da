"""The discovery on small sessions: the cause by name, or nothing; each figure of a statistic."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibration_scenes import CHAIN, MARKERS, URDF, random_poses, sensors
from discovery_scenes import at_joint, discovered, residuals_of, session_with

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.noise import NoiseModel
from remaster_ros.calibration.outliers import robust_noise
from remaster_ros.discovery import discover, packed
from remaster_ros.discovery.discover import discover_session
from remaster_ros.discovery.effects.base import Design
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import _System, solve
from remaster_ros.discovery.screening import Catalogue, screen
from remaster_ros.errors import InsufficientDataError
from remaster_ros.simulation.simulated_workcell import simulate_session
from remaster_ros.types import Session

ARC_MINUTE = np.radians(1.0 / 60.0)


def torques(session: Session) -> np.ndarray:
    return CHAIN.gravity_torque(session.measurements.q)


def sagging(session: Session) -> np.ndarray:
    """Joints 2 and 4 give way: the pair that a greedy search takes for a coupling."""
    tau = torques(session)
    return at_joint(2, 4e-5 * tau[:, 1]) + at_joint(4, 6e-5 * tau[:, 3])


@cache
def sagging_session() -> Session:
    return session_with(21, sagging)


def test_two_joints_that_sag_together_are_named_with_their_compliances():
    found = discovered(sagging_session())
    assert [(e.name, e.joints) for e in found.effects] == [('joint_compliance', (2, 4))]
    for parameter, truth in zip(found.effects[0].parameters, (4e-5, 6e-5), strict=True):
        assert abs(parameter.value - truth) < 4.0 * parameter.std
        assert parameter.unit == 'rad/(N m)'


@pytest.mark.qualify
def test_backlash_and_a_sensor_scale_are_found_beside_each_other():
    def backlash(session: Session) -> np.ndarray:
        m = session.measurements
        side, sides = 0.0, []
        for move in np.nan_to_num(m.q - m.from_q)[:, 3]:
            # A joint that stands still stays on its flank.
            side = side if abs(move) < 1e-9 else np.sign(move)
            sides.append(side)
        return at_joint(4, 2.0 * ARC_MINUTE * np.array(sides))

    def scale(session: Session) -> np.ndarray:
        return 3e-3 * session.measurements.position

    found = discovered(session_with(22, backlash, scale))
    assert {(e.name, e.joints) for e in found.effects} == {
        ('backlash', (4,)),
        ('sensor_scale', ()),
    }
    by_name = {e.name: e.parameters[0] for e in found.effects}
    assert abs(by_name['backlash'].value - 2.0 * ARC_MINUTE) < 4 * by_name['backlash'].std
    assert abs(by_name['sensor_scale'].value - 3e-3) < 4.0 * by_name['sensor_scale'].std


def test_an_error_of_any_shape_is_a_curve_of_its_joint():
    def curve(session: Session) -> np.ndarray:
        q = session.measurements.q[:, 1]
        return at_joint(2, 4 * ARC_MINUTE * (np.exp(-((q - 0.3) ** 2) / 0.02) + np.cos(7.3 * q)))

    session = session_with(23, curve)
    found = discover_session(session, rng=np.random.default_rng(0))
    assert ('joint_error_curve', (2,)) in {(e.name, e.joints) for e in found.effects}
    # The curve is no constant: the zero-offset beside it stays measured.
    plain = fit_session(session, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(found.fit.identifiable, plain.identifiable)
    assert found.fit.identifiable[1]
    assert found.fit.joint_offsets_std[1] < 2.0 * plain.joint_offsets_std[1]


def test_an_unnamed_cause_is_located():
    def creeping(session: Session) -> np.ndarray:
        m = session.measurements
        return at_joint(4, 6e-5 * CHAIN.gravity_torque(m.q)[:, 1])

    found = discovered(session_with(24, creeping))
    first = found.effects[0]
    assert (first.name, first.joints) == ('unnamed', (4, 2))
    assert first.place == 'joint_angle'
    assert first.driver == 'gravity_torque_of_joint_2'


@pytest.mark.parametrize(
    'seed', [31, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (32, 33))]
)
def test_nothing_is_found_where_nothing_is(seed):
    # A false claim at 1 % each: all three pass in 97 % of seeds; these are fixed.
    found = discovered(session_with(seed, sensor=None, outlier_share=0.03))
    assert found.effects == ()


@pytest.mark.parametrize(
    'seed', [34, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (35, 36, 37))]
)
def test_few_poses_are_enough_for_a_large_cause_and_show_none_where_none_is(seed):
    # The signs of 6 poses have 32 patterns, too few for a p-value of 1 %.
    few = {'poses': 6, 'validation': 4}

    def sagging_once(session: Session) -> np.ndarray:
        return at_joint(2, 1e-4 * torques(session)[:, 1])

    found = discovered(session_with(seed, sagging_once, **few))
    assert ('joint_compliance', (2,)) in {(e.name, e.joints) for e in found.effects}
    # A false claim at 1 % each: all four pass in 96 % of seeds; these are fixed.
    assert discovered(session_with(seed, **few)).effects == ()


def test_what_a_marker_moved_further_than_allowed_is_said():
    session = session_with(25)
    markers = dict(session.markers)
    markers['sir'] = markers['sir'] + np.array([0.0, 0.0, 6e-3])
    found = discovered(replace(session, markers=markers))
    (effect,) = found.effects
    assert effect.name == 'marker_offset'
    z = effect.parameters[2]
    # The true marker is itself 0.5 mm from where the session has it.
    assert abs(z.value + 6e-3) < 3 * 0.5e-3


def test_causes_that_the_poses_do_not_determine_are_left_out_with_the_reason(monkeypatch):
    """The offsets alone can be fitted: the answer is theirs, and the units are not blamed."""

    def refusing(session, *, extension, **options):
        if extension is not None:
            raise InsufficientDataError('the observations hardly determine effect.compliance_2')
        return fit_session(session, extension=None, **options)

    monkeypatch.setattr(discover, 'fit_session', refusing)
    found = discover_session(sagging_session(), rng=np.random.default_rng(3))
    assert found.verdict == 'unexplained'
    assert found.effects == ()
    left = found.unexplained[0]
    assert 'joint compliance' in left.next
    assert 'hardly determine effect.compliance_2' in left.next
    assert left.size_m == pytest.approx(found.gain.held_out_rms_before_m, rel=0.3)

    def broken(session, **options):
        raise InsufficientDataError('too few poses')

    monkeypatch.setattr(discover, 'fit_session', broken)
    with pytest.raises(InsufficientDataError, match='too few poses'):
        discover_session(sagging_session(), rng=np.random.default_rng(3))


def test_the_extended_model_is_sampled_and_gains_on_held_out_poses():
    found = discover_session(sagging_session(), rng=np.random.default_rng(0))
    assert found.verdict == 'effects'
    assert found.gain.held_out_rms_after_m is not None
    assert found.gain.held_out_rms_before_m is not None
    assert found.gain.held_out_rms_after_m < found.gain.held_out_rms_before_m
    assert found.gain.held_out_rms_after_m < 1.25 * found.gain.noise_floor_m
    assert found.fit.theta_names == ('compliance_2', 'compliance_4')
    for parameter, mean, std in zip(
        found.effects[0].parameters, found.fit.theta, found.fit.theta_std, strict=True
    ):
        assert (parameter.value, parameter.std) == (mean, std)
    assert [e.share for e in found.effects] == [pytest.approx(1.0)]


@cache
def residuals():
    return residuals_of(session_with(26, poses=20, sensor_count=2))


def cells_named(name: str):
    return list(EFFECTS[name].cells(residuals().context))


@pytest.mark.parametrize('split', [(), (0,)])
@pytest.mark.parametrize('name', ['joint_compliance', 'joint_error_curve'])
def test_restricted_likelihood_has_the_gradient_it_says(name, split):
    data = residuals()
    model = NoiseModel.of(data.rows, data.context.T_R_N, split)
    cells = tuple(cells_named(name)[1:3])
    columns = data.columns(cells)
    scale = np.sqrt(np.sum(columns**2, axis=(0, 1)))
    scale[scale == 0.0] = scale.max()
    joined = np.concatenate((data.base, columns / scale, data.errors[:, :, None]), axis=2)
    grams = model.gram(lambda _, where: joined[where], joined.shape[2])
    p = data.base.shape[2]
    unit = np.concatenate((np.ones(p), scale))
    noise = model.of_sensors(*robust_noise(data.rows, data.errors, np.ones(len(data), bool)))
    ridge = np.where(np.arange(len(unit)) < p, 0.0, 0.5)
    grams = packed.of_rows(grams, 0)
    system = _System(model, grams, noise, cells, data.base_precision, unit, ridge)
    eta, _, _ = system._start(None)
    gradient, information = system.derivatives(eta)
    for i in range(len(eta)):
        step = np.zeros(len(eta))
        step[i] = 1e-5
        numeric = (system.value(eta + step) - system.value(eta - step)) / 2e-5
        assert gradient[i] == pytest.approx(numeric, rel=1e-3, abs=1e-3)
    # The average of observed and expected information has no negative direction.
    assert np.linalg.eigvalsh(information).min() > -1e-9 * np.trace(information)


def test_a_curve_has_a_plausible_size_where_the_data_leave_it_open():
    data = residuals()
    cell = cells_named('joint_error_curve')[1]
    # Displacements of nanometres: the rows do not show the curve.
    blind = replace(
        cell,
        columns=lambda context: Design(1, 1e-6 * cell.columns(context).values),
    )
    fit = solve(data, (blind,))
    assert fit is not None
    std = np.sqrt(np.diag(fit.covariance))
    assert std.max() <= 1.001 * cell.largest
    assert np.abs(fit.parameters).max() < 3.0 * cell.largest


def test_screening_scores_agree_with_a_least_squares_fit_of_each_cell():
    data = residuals()
    cells = [
        c for n in ('encoder_scale', 'encoder_eccentricity', 'backlash') for c in cells_named(n)
    ]
    empty = solve(data, ())
    assert empty is not None
    scores = screen(data, Catalogue.of(data, cells), empty)
    base = data.noise_model.whitened(data.base, empty.noise).reshape(3 * len(data), -1)
    errors = data.noise_model.whitened(data.errors, empty.noise).ravel()
    n = 3 * len(data) - base.shape[1]

    def squares(columns: np.ndarray) -> float:
        solution = np.linalg.lstsq(columns, errors, rcond=None)[0]
        return float(np.sum((errors - columns @ solution) ** 2))

    compared = 0
    for cell, score in zip(cells, scores, strict=True):
        alone = solve(data, (cell,))
        if alone is None or alone.unphysical():
            continue
        compared += 1
        white = data.noise_model.whitened(data.columns([cell]), empty.noise)
        white = white.reshape(3 * len(data), -1)
        white /= np.maximum(np.linalg.norm(white, axis=0), 1e-30)
        left = white - base @ np.linalg.lstsq(base, white, rcond=None)[0]
        # Of joint 3, which takes three angles only, sines and cosines are partly one and the same.
        if np.linalg.svd(left, compute_uv=False)[-1] < 2e-3:
            continue
        ratio = squares(base) / squares(np.concatenate((base, white), axis=1))
        expected = 0.5 * n * np.log(ratio) - 0.5 * cell.size * np.log(n) - np.log(cell.drawn_from)
        assert score == pytest.approx(expected, abs=0.05)
    assert compared > len(cells) // 2


def test_a_joint_that_moves_only_in_gross_errors_suggests_nothing():
    """Its columns are zero in all rows that are searched; a warning would end this test."""
    print('seed', seed := 5)
    rng = np.random.default_rng(seed)
    poses = [pose[:3] for pose in random_poses(30, rng)]
    for pose in poses[1:]:
        pose[:, 4] = 0.0
    session, _ = simulate_session(
        CHAIN, URDF, rng, poses=poses, sensors=sensors(rng, 1, 0.1e-3, 0.0), markers=MARKERS
    )
    position = session.measurements.position.copy()
    moved = session.measurements.q[:, 4] != 0.0
    position[moved] += 0.02 * rng.standard_normal((moved.sum(), 3))
    spoilt = replace(session, measurements=replace(session.measurements, position=position))
    found = discovered(spoilt)
    assert not np.isin(np.flatnonzero(moved), found.residuals.rows.source).any()
    assert not found.effects


@pytest.mark.parametrize(
    'seed', [2, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (4, 10))]
)
def test_held_out_poses_decide_where_the_model_of_all_kinds_does_not_hold(seed):
    """Five poses do not tell a soft joint from a soft base; the name alone predicts others."""

    def soft(session: Session) -> np.ndarray:
        return at_joint(2, 4e-5 * CHAIN.gravity_torque(session.measurements.q)[:, 1])

    few = {'poses': 5, 'validation': 3, 'sigma_m': 0.01e-3, 'pose_sigma_m': 0.02e-3}
    found = discovered(session_with(seed, soft, **few))
    assert [(effect.name, effect.joints) for effect in found.effects] == [
        ('joint_compliance', (2,))
    ]
    # With all kinds 0.077, 0.114 and 0.159 mm.
    assert found.gain.held_out_rms_after_m < 0.065e-3
    assert {cell.name for cell in found.solution.cells} == {'joint_compliance'}
