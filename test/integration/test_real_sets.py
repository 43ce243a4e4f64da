# SPDX-License-Identifier: Apache-2.0
"""Two real robots measured by others; the figures to reach are those of an independent fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from remaster_ros import read_compensation
from remaster_ros.calibration.fit import FitResult, fit_session
from remaster_ros.compensation.compensator import MOST_RAD, ROUNDING_RAD, Compensator
from remaster_ros.compensation.controller_forms import form_content
from remaster_ros.discovery.discover import discover_session
from remaster_ros.reports.discovery_json import predictions_of, read_discovery
from remaster_ros.reports.loadable import compensation_of, compensation_text, geometry_of
from remaster_ros.reports.result_folder import save_discovery
from remaster_ros.reports.sentences import load_words
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Session

DATA = Path(__file__).parents[3] / 'shared/data'


def real(name: str) -> Session:
    if not (DATA / name).is_dir():
        pytest.skip(f'the real data set {name} is not beside this repository (../shared/data)')
    return read_session(DATA / name)


def fit(name: str) -> tuple[FitResult, np.ndarray]:
    session = real(name)
    result = fit_session(session, rng=np.random.default_rng(1))
    held_out = result.residuals_after[session.measurements.is_validation]
    return result, np.linalg.norm(held_out, axis=1)


def test_ur10_with_two_solutions() -> None:
    result, held_out = fit('ur10_two_solutions')
    print(f'held-out mean {held_out.mean() * 1e3:.3f} mm')
    assert len(held_out) == 508
    assert held_out.mean() <= 1.02e-3
    # Unmodelled errors of a millimetre are the robot's, not outliers.
    assert len(result.left_out) <= 5
    assert result.sampler.converged, result.sampler.message
    # Its marker lies on the last axis within half a millimetre.
    assert result.identifiable.tolist() == [False, True, True, True, True, False]
    relative = result.accuracy['validation']['relative']
    # 1.73 with one noise for all directions; here the one along the line of sight differs.
    assert result.noise['tracker'].directions
    assert relative['after']['mean_mm'] <= 1.75


def test_irb120_with_three_points() -> None:
    result, held_out = fit('irb120_three_points')
    print(f'held-out mean {held_out.mean() * 1e3:.3f} mm')
    assert len(held_out) == 10
    assert held_out.mean() <= 0.64e-3
    assert result.left_out == ()
    assert result.sampler.converged, result.sampler.message
    assert result.identifiable.tolist() == [False, True, True, True, True, False]
    # Three markers whose nominal places say nothing, 10 mm and more apart.
    p1, p2, p3 = (result.marker_positions[name] for name in ('p1', 'p2', 'p3'))
    for a, b in ((p1, p2), (p2, p3), (p3, p1)):
        assert 0.01 < np.linalg.norm(a - b) < 0.05
    assert result.accuracy['validation']['relative']['before'] is None


def test_errors_that_no_cause_stands_out_of_are_never_nothing() -> None:
    """Half of the poses of a small arm: names come and go, what is there is more than noise."""
    session = real('meca500_repeats')
    pose = session.measurements.pose
    half = np.random.default_rng(1001).permutation(np.unique(pose))[: len(np.unique(pose)) // 2]
    found = discover_session(session.select(np.isin(pose, half)), rng=np.random.default_rng(1))
    assert found.effects == ()
    assert found.verdict == 'unexplained'
    (error,) = found.unexplained
    assert error.size_m < 0.05e-3
    # The model that has it does no harm.
    assert found.gain.held_out_rms_after_m < found.gain.held_out_rms_before_m


def test_what_can_be_loaded_of_a_panda(tmp_path: Path) -> None:
    """Its kinds of errors have many terms at each joint: the file is read as it was meant."""
    found = discover_session(real('panda_left'), rng=np.random.default_rng(0))
    save_discovery(found, tmp_path, figures=False)
    file = read_compensation(tmp_path / 'apply/compensation.json')
    memory = Compensator(compensation_of(found, predictions_of(found).widening).model)
    q = found.residuals.context.measurements.q
    tools = [
        compensator.tool(compensator.command(q)) for compensator in (memory, file.compensator)
    ]
    assert np.abs(tools[0] - tools[1]).max() < 1e-9
    covariances = [compensator.uncertainty(q) for compensator in (memory, file.compensator)]
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=1e-4, atol=1e-18)
    # A URDF holds lengths and tilts: those beside its soft base would leave 1.16 mm.
    content = form_content(file, 'urdf', np.random.default_rng(0))
    # Bearings that tip, which no such form holds, are most of it.
    assert content.rms_mm < 1.0
    assert 'export that one' in content.better_file
    loadable = json.loads((tmp_path / 'discovery.json').read_text())['loadable']
    offsets, geometry, everything = (row['held_out_mean_mm'] for row in loadable)
    assert offsets > 1.0
    assert geometry < 0.33
    # As commanded: two degrees a joint suffice at nearly all of these poses.
    assert everything < 0.9 * geometry
    m = found.residuals.context.measurements
    commanded = file.model.state(file.command(m.q)).tool
    wanted = file.model.chain.forward(m.q)
    (place,) = file.model.markers.values()
    missed = (commanded - wanted) @ [*place, 1.0]
    missed_mm = 1e3 * np.linalg.norm(missed[m.is_validation, :3], axis=1).mean()
    # By a fade of singular directions it was 0.3 mm.
    assert missed_mm < 0.05
    row = read_discovery(tmp_path / 'discovery.json').loadable[2]
    assert load_words(row)[1].startswith('apply/compensation.json')


@pytest.mark.parametrize('name', ['meca500_repeats', 'irb120_three_points'])
def test_a_fit_commands_lengths_and_tilts_of_a_small_arm_as_of_a_large_one(name):
    """A robot model with them is better on both, and a command gets there on both."""
    fit = fit_session(real(name), rng=np.random.default_rng(0), draws=400)
    assert geometry_of(fit).is_better
    content = json.loads(compensation_text(fit, ''))
    assert content['geometry']['origins']


@pytest.mark.qualify
@pytest.mark.parametrize(
    ('name', 'most_mm'), [('ur10_iso_cubes', 0.15), ('ur10_two_solutions', 0.15)]
)
def test_everything_can_be_loaded_where_the_reflector_is_near_an_axis(
    name: str, most_mm: float, tmp_path: Path
) -> None:
    """It lies 1 and 0.4 mm from joint 6's: no degrees of that joint explain tenths of a mm."""
    found = discover_session(real(name), rng=np.random.default_rng(0))
    save_discovery(found, tmp_path, figures=False)
    offsets, _, everything = read_discovery(tmp_path / 'discovery.json').loadable
    assert everything.file
    assert everything.held_out_mean_mm < most_mm < 0.3 * offsets.held_out_mean_mm
    file = read_compensation(tmp_path / 'apply/compensation.json')
    q = found.residuals.context.measurements.q
    # An arm whose errors were larger than the budget of a joint would be given more.
    change = np.abs(file.compensator.command(q) - q)
    assert change.max() <= MOST_RAD + ROUNDING_RAD
    assert {'link_length', 'joint_error_curve'} <= {e.name for e in found.effects if e.is_certain}
    assert all(effect.size_m >= 0.5e-6 for effect in found.effects)
    # From one half on a cause is named; below 0.95 it says so, and its remedy is put off.
    for effect in found.effects:
        assert effect.probability >= 0.5
        is_doubtful = effect.probability < 0.95
        assert ('Not certain: its probability is' in effect.cause) == is_doubtful, effect
        assert effect.remedy.startswith('Measure more poses first') == is_doubtful, effect
