# SPDX-License-Identifier: Apache-2.0
"""Lengths and tilts off the drawing: what they do to the offsets, and the robot model of them."""

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from worlds.discovery_scenes import CHAIN, at_joint, session_with

import remaster_ros
from remaster_ros.calibration.registration import register_points
from remaster_ros.compensation.export import MODEL_FILE
from remaster_ros.compensation.file import read_compensation
from remaster_ros.discovery.discover import discover_session
from remaster_ros.discovery.geometry_model import geometry_model
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.loadable import model_text
from remaster_ros.reports.report_inputs import errors_with_model_mm
from remaster_ros.reports.result_folder import save_discovery, save_fit
from remaster_ros.types import FloatArray, Priors, Session

pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

SHARED = Path(__file__).parents[3].parent / 'shared' / 'data'
SEEDS = range(4)


def off_its_drawing(session: Session, joint: str, axis: int, off_m: float) -> Session:
    """Return a session whose URDF has a joint elsewhere than the arm that was measured."""
    root = ElementTree.fromstring(session.urdf)
    origin = next(j for j in root.findall('joint') if j.get('name') == joint).find('origin')
    assert origin is not None
    xyz = [float(value) for value in origin.attrib['xyz'].split()]
    xyz[axis] += off_m
    origin.set('xyz', ' '.join(map(repr, xyz)))
    return replace(session, urdf=ElementTree.tostring(root, encoding='unicode'))


@pytest.mark.qualify
def test_an_elbow_off_its_drawing_by_the_tolerance_is_held_by_the_wider_std() -> None:
    """The z of each offset by ``std_deg`` reaches tens; with geometry 95 % are within 1.96.

    Elbows that offsets imitate exactly leave no trace in the residuals. By chance alone the test
    fails in fewer than 1 of 1,000 runs (20 values, at most 4 outside); seeds are fixed.
    """
    given_drawing, with_geometry = [], []
    for seed in SEEDS:
        made = remaster_ros.simulate(poses=25, validation_poses=8, seed=seed)
        off_m = float(np.random.default_rng(seed).normal(0.0, 1e-4))
        chain = SerialChain.from_urdf(made.session.urdf, made.session.base_link)
        session = off_its_drawing(made.session, chain.joint_names[2], 0, off_m)
        fit = remaster_ros.fit(session)
        assert fit.found is not None
        geometry = geometry_model(fit.found)
        assert geometry is not None
        error = fit.joint_offsets - made.truth.joint_offsets
        known = fit.identifiable
        given_drawing += list(np.abs(error / fit.joint_offsets_std)[known])
        wider = geometry.offsets_std(fit.joint_offsets_std)
        with_geometry += list(np.abs(error / wider)[known])
    print(f'seeds {list(SEEDS)}: largest z {max(given_drawing):.1f}, {max(with_geometry):.1f}')
    assert max(given_drawing) > 5.0
    assert np.sum(np.array(with_geometry) > 1.96) <= 4


def test_an_elbow_that_offsets_imitate_is_within_what_a_person_is_shown() -> None:
    """At the tolerance: 0.1 mm along x of the third joint leave nothing in the residuals."""
    made = remaster_ros.simulate(poses=25, validation_poses=8, seed=3)
    chain = SerialChain.from_urdf(made.session.urdf, made.session.base_link)
    session = off_its_drawing(made.session, chain.joint_names[2], 0, 1e-4)
    rows = fit_content(remaster_ros.fit(session)).joint_offsets
    true = np.degrees(made.truth.joint_offsets)
    known = [i for i, row in enumerate(rows) if row.identifiable]
    off = [abs(rows[i].mean_deg - true[i]) for i in known]
    narrow = [rows[i].std_if_exactly_drawn_deg for i in known]
    assert max(np.divide(off, narrow)) > 5.0
    for i in known:
        low, high = rows[i].interval95_deg
        assert low < true[i] < high, rows[i].joint


@pytest.mark.qualify
def test_the_tolerance_of_the_drawing_is_a_prior() -> None:
    """Where lengths and tilts show nothing, it alone decides what they could do to offsets."""
    made = remaster_ros.simulate(poses=25, validation_poses=8, seed=0)
    wider = []
    for tolerance_m in (0.5e-4, 2e-4):
        fit = remaster_ros.fit(made.session, priors=Priors(geometry_tolerance_m=tolerance_m))
        assert fit.found is not None
        geometry = geometry_model(fit.found)
        assert geometry is not None
        assert geometry.tolerance_m == tolerance_m
        wider.append(np.linalg.norm(geometry.offset_moves, axis=1)[fit.identifiable])
    assert np.all(wider[1] > 2.0 * wider[0])


def held_out_mean(session: Session, urdf: str) -> float:
    """Return the mean held-out error of a robot model by pinocchio, m: all else fitted by it."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    tip = model.getFrameId(session.tip_link)
    measurements = session.measurements
    tools = []
    for q in measurements.q:
        pin.framesForwardKinematics(model, data, q)
        tools.append(data.oMf[tip].homogeneous.copy())
    tool = np.array(tools)
    fitted = ~measurements.is_validation
    marker = np.array(next(iter(session.markers.values())), dtype=float)
    points: FloatArray = np.zeros((0, 3))
    T = np.eye(4)
    for _ in range(200):
        points = np.einsum('nij,j->ni', tool[:, :3, :3], marker) + tool[:, :3, 3]
        T, _ = register_points(measurements.position[fitted], points[fitted])
        # The marker by least squares in turn with the registration.
        turned = np.einsum('ij,njk->nik', T[:3, :3], tool[:, :3, :3])
        differences = (
            measurements.position - np.einsum('ij,nj->ni', T[:3, :3], tool[:, :3, 3]) - T[:3, 3]
        )
        marker = np.linalg.lstsq(
            turned[fitted].reshape(-1, 3), differences[fitted].ravel(), rcond=None
        )[0]
    predicted = np.einsum('ij,nj->ni', T[:3, :3], points) + T[:3, 3]
    error = np.linalg.norm(measurements.position - predicted, axis=1)
    return float(error[measurements.is_validation].mean())


@pytest.mark.skipif(not SHARED.is_dir(), reason='../shared/data is not there')
def test_the_model_that_a_panda_loads_leaves_a_third_of_a_millimetre() -> None:
    """As an independent program reads the file; the zero-offsets alone leave 1.43 mm."""
    fit = remaster_ros.fit(remaster_ros.read_session(SHARED / 'panda_left'))
    content = fit_content(fit)
    geometry = content.geometry
    assert geometry.file == 'apply/robot_model.urdf'
    assert geometry.held_out_mean_mm < 0.33 < 1.4 < geometry.drawing_held_out_mean_mm
    assert fit.found is not None
    model = model_text(fit, geometry_model(fit.found))
    by_pinocchio = 1e3 * held_out_mean(fit.session, model)
    assert by_pinocchio < 0.34
    assert by_pinocchio == pytest.approx(geometry.held_out_mean_mm, rel=0.1)


def test_an_arm_as_drawn_is_not_told_to_load_lengths_and_tilts(tmp_path: Path) -> None:
    """Where held-out poses gain by them by chance alone the zero-offsets are what is loaded."""
    gains = []
    for seed in (5, 6, 9):
        made = remaster_ros.simulate(poses=12, validation_poses=8, seed=seed)
        fit = remaster_ros.fit(made.session)
        geometry = fit_content(fit).geometry
        gains.append(geometry.drawing_held_out_mean_mm - geometry.held_out_mean_mm)
        assert geometry.file == ''
        save_fit(fit, tmp_path, figures=False)
        assert not (tmp_path / 'apply' / MODEL_FILE).exists()
        file = read_compensation(tmp_path / 'apply' / 'compensation.json')
        assert not file.model.geometry.is_any
    # In at least one of them they did gain.
    assert max(gains) > 0.0
    assert geometry.length_std_mm >= geometry.tolerance_mm
    for row in fit_content(fit).joint_offsets:
        if row.identifiable:
            assert row.std_deg > row.std_if_exactly_drawn_deg


def bent(session: Session) -> FloatArray:
    return at_joint(2, 1.5e-3 * np.sin(2.0 * session.measurements.q[:, 1]))


def test_each_result_that_can_be_loaded_has_its_own_held_out_error(tmp_path: Path) -> None:
    """A link 3 mm off its drawing and an eccentric encoder: files leave what the table states."""
    made = session_with(43, bent, poses=18, validation=10)
    session = off_its_drawing(made, CHAIN.joint_names[3], 0, 3e-3)
    found = discover_session(session, rng=np.random.default_rng(0))
    save_discovery(found, tmp_path, figures=False)
    content = json.loads((tmp_path / 'discovery.json').read_text())
    rows = {row['result']: row for row in content['loadable']}
    assert [row['result'] for row in content['loadable']] == ['offsets', 'geometry', 'everything']
    means = [row['held_out_mean_mm'] for row in rows.values()]
    assert means[0] > 1.5 * means[1], means
    assert means[1] > 1.1 * means[2], means
    assert all(row['better'] for row in rows.values())
    held_out = session.measurements.is_validation
    for name, mean in zip(('offsets', 'geometry'), means[:2], strict=True):
        urdf = (tmp_path / rows[name]['file']).read_text()
        loaded = errors_with_model_mm(session, urdf)[held_out].mean()
        assert loaded == pytest.approx(mean, rel=0.05), name
    # What zero-offsets alone leave is least with those that were fitted alone.
    fit = remaster_ros.fit(session)
    assert means[0] == pytest.approx(
        1e3 * np.linalg.norm(fit.residuals_after[held_out], axis=1).mean(), rel=0.01
    )


def test_gross_errors_decide_over_no_robot_model() -> None:
    """Of one fit the error with the zero-offsets is one number, wherever it stands."""
    made = remaster_ros.simulate(poses=16, validation_poses=12, seed=8, outlier_share=0.08)
    content = fit_content(remaster_ros.fit(made.session))
    gross = sum(len(check.gross) for check in content.explained_by_noise.values())
    assert gross
    # Of the file: offsets that are not applied are at 0 there, and base and marker go with it.
    (shown,) = re.findall(r'to ([\d.]+) mm on poses it never fitted', content.judgement.headline)
    assert content.geometry.drawing_held_out_mean_mm == pytest.approx(float(shown), rel=0.05)
    assert abs(content.geometry.held_out_mean_mm - content.geometry.drawing_held_out_mean_mm) < 0.1
