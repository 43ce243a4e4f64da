# SPDX-License-Identifier: Apache-2.0
"""Arms with a joint that slides: kinematics against pinocchio, offsets in m, refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.arms import STANFORD
from worlds.arms import jointed_arm as arm

from remaster_ros.calibration.fit import fit_session
from remaster_ros.compensation.export import calibrated_urdf
from remaster_ros.compensation.mastering import mastering
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Priors

pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

MARKER = np.array([0.03, -0.02, 0.12])
NOISE_M = 3e-5


SCARA = arm(
    ('revolute', '0 0 1', '0 0 0.2', '0 0 0'),
    ('revolute', '0 0 1', '0.35 0 0', '0 0 0'),
    ('prismatic', '0 0 -1', '0.25 0 0', '0 0 0'),
    ('revolute', '0 0 1', '0 0 0', '0 0 0'),
)
SLIDE = 2


def chain_of(urdf: str) -> SerialChain:
    return SerialChain.from_urdf(urdf)


def poses(urdf: str, q: np.ndarray) -> np.ndarray:
    """Return the tool's poses by pinocchio, (n, 4, 4)."""
    model = pin.buildModelFromXML(urdf)
    data, frame = model.createData(), model.getFrameId('tool0')
    result = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        result.append(data.oMf[frame].homogeneous.copy())
    return np.array(result)


def drawn(urdf: str, rng: np.random.Generator, rows: int = 80) -> tuple[np.ndarray, np.ndarray]:
    chain = chain_of(urdf)
    q = rng.uniform(chain.lower + 0.02, chain.upper - 0.02, (rows, len(chain)))
    std = np.where(chain.slides, 2e-3, np.radians(0.4))
    return q, rng.normal(0.0, std)


@pytest.mark.parametrize('urdf', [STANFORD, SCARA])
def test_positions_and_derivatives_are_those_of_pinocchio(urdf):
    rng = np.random.default_rng(3)
    chain = chain_of(urdf)
    q, offsets = drawn(urdf, rng)
    points = rng.normal(0.0, 0.1, (len(q), 3))
    T = poses(urdf, q + offsets)
    expected = np.einsum('nij,nj->ni', T[:, :3, :3], points) + T[:, :3, 3]
    assert np.allclose(chain.forward(q, offsets), T, atol=1e-12)
    assert np.allclose(chain.positions(q, points, offsets), expected, atol=1e-12)
    assert np.allclose(chain.with_offsets(offsets).forward(q), T, atol=1e-12)
    batch = chain.positions(q, points, np.stack((offsets, 0.0 * offsets))[:, None, :])
    assert np.allclose(batch[0], expected, atol=1e-12)
    by_q, step = chain.position_jacobian(q, points, offsets), 1e-6
    for joint, unit in enumerate(np.eye(len(chain))):
        moved = [chain.positions(q, points, offsets + s * step * unit) for s in (1, -1)]
        assert np.allclose(by_q[..., joint], (moved[0] - moved[1]) / (2 * step), atol=1e-8)


def test_the_calibrated_model_slides_where_the_arm_does():
    q, offsets = drawn(STANFORD, np.random.default_rng(5))
    text = calibrated_urdf(STANFORD, chain_of(STANFORD), offsets)
    assert np.allclose(poses(text, q), poses(STANFORD, q + offsets), atol=1e-9)
    lower = chain_of(text).lower
    assert np.allclose(lower, chain_of(STANFORD).lower - offsets)


def test_a_slide_is_set_in_mm_within_its_travel():
    chain = chain_of(STANFORD)
    offsets = np.array([0.0, 0.002, 0.0015, 0.0, 0.0, 0.0])
    known = np.ones(len(chain), bool)
    steps = [step for (step,) in mastering(None, chain, offsets, np.full(6, 1e-5), known)]
    assert steps[SLIDE].unit == 'mm'
    assert steps[SLIDE].offset == pytest.approx(1.5)
    assert steps[SLIDE].set_to - steps[SLIDE].drive_to == pytest.approx(1.5)
    assert 100.0 <= steps[SLIDE].drive_to <= 500.0


@pytest.fixture(scope='module')
def measured(tmp_path_factory):
    """A table in degrees and mm of a Stanford arm, imported, and the offsets that made it."""
    seed = 11
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp('slider')
    q, offsets = drawn(STANFORD, rng)
    T = poses(STANFORD, q + offsets)
    turn = pin.exp3(rng.normal(0.0, 1.0, 3))
    points = (T[:, :3, :3] @ MARKER + T[:, :3, 3]) @ turn.T + np.array([2.0, -1.0, 0.8])
    points += rng.normal(0.0, NOISE_M, points.shape)
    shown = np.degrees(q)
    shown[:, SLIDE] = 1e3 * q[:, SLIDE]
    table = np.column_stack((shown, 1e3 * points))
    head = 'j1,j2,j3,j4,j5,j6,x,y,z'
    np.savetxt(folder / 't.csv', table, '%.5f', ',', header=head, comments='')
    (folder / 'arm.urdf').write_text(STANFORD)
    given = ['--urdf', folder / 'arm.urdf', '--marker-mm', *(1e3 * MARKER)]
    remaster('import', folder / 't.csv', *given, '--out', folder / 's', '--quiet')
    return folder, offsets


def test_an_offset_in_mm_is_recovered_from_a_table(measured, tmp_path):
    """Each of the inner joints within 4.5 of its standard deviations: 1 of 30,000 tests fails."""
    folder, offsets = measured
    text = (folder / 's' / 'observations.csv').read_text()
    assert ',q3_m,' in text.partition('\n')[0]
    out = tmp_path / 'fit'
    remaster('fit', folder / 's', '--out', out, '--quiet', '--no-figures')
    rows = json.loads((out / 'fit.json').read_text())['joint_offsets']
    slide = rows[SLIDE]
    assert slide['identifiable']
    assert slide['unit'] == 'mm'
    assert slide['mean_deg'] is None
    drawn = slide['std_if_exactly_drawn_mm']
    assert drawn < 0.1
    assert drawn < slide['std_mm']
    assert abs(slide['mean_mm'] - 1e3 * offsets[SLIDE]) < 4.5 * drawn
    for joint in (1, 3, 4):
        error = rows[joint]['mean_deg'] - np.degrees(offsets[joint])
        assert abs(error) < 4.5 * rows[joint]['std_if_exactly_drawn_deg']
    page = (out / 'apply' / 'remaster.txt').read_text()
    assert f'{slide["mean_mm"]:+.4f} mm' in page


def test_the_zero_of_a_slide_at_a_fixed_direction_is_the_registrations(tmp_path):
    """All axes of a SCARA are parallel: its lift's zero is a shift of the sensor."""
    rng = np.random.default_rng(2)
    q, offsets = drawn(SCARA, rng)
    T = poses(SCARA, q + offsets)
    points = T[:, :3, :3] @ MARKER + T[:, :3, 3] + rng.normal(0.0, NOISE_M, (len(q), 3))
    shown = np.degrees(q)
    shown[:, SLIDE] = q[:, SLIDE]
    head = 'j1,j2,j3 [m],j4,x_m,y_m,z_m'
    np.savetxt(
        tmp_path / 't.csv', np.column_stack((shown, points)), '%.7f', ',', header=head, comments=''
    )
    (tmp_path / 'arm.urdf').write_text(SCARA)
    given = ['--urdf', tmp_path / 'arm.urdf', '--marker-mm', *(1e3 * MARKER)]
    session = tmp_path / 's'
    remaster('import', tmp_path / 't.csv', *given, '--out', session, '--quiet')
    result = fit_session(read_session(session), rng=rng)
    assert result.identifiable.tolist() == [False, True, False, False]
    assert 'a shift of the sensor registration along its axis' in result.why[SLIDE]
    assert abs(result.joint_offsets[1] - offsets[1]) < 4.5 * result.joint_offsets_std[1]


@pytest.mark.parametrize(
    'verb',
    [
        ['fit', 'SESSION', '--sampler', 'paper', '--out', 'OUT'],
        ['import', 'SESSION', '--out', 'OUT'],
    ],
)
def test_what_supposes_angles_refuses_a_slide_in_one_line(verb, measured, tmp_path):
    names = {'SESSION': measured[0] / 's', 'OUT': tmp_path / 'out'}
    error = refusal(*(names.get(word, word) for word in verb))
    assert 'j3' in error
    assert 'slides' in error


def test_a_session_that_has_rad_for_a_slide_is_refused(measured, tmp_path):
    for file in (measured[0] / 's').iterdir():
        (tmp_path / file.name).write_text(file.read_text().replace('q3_m', 'q3_rad'))
    with pytest.raises(InputError, match='joint 3 of the URDF slides, so its column is q3_m'):
        read_session(tmp_path)


def test_what_is_known_of_a_slide_is_a_length(measured):
    session = read_session(measured[0] / 's')
    known = Priors({'j3': (4e-3, 1e-6)}, in_m=frozenset({'j3'}))
    fit = fit_session(session, rng=np.random.default_rng(1), priors=known)
    assert abs(fit.joint_offsets[SLIDE] - 4e-3) < 1e-5
    for wrong, words in (
        (
            Priors({'j3': (4e-3, 1e-6)}),
            "joint 'j3' is an angle, but that joint slides; write mean_mm",
        ),
        (
            replace(known, joint_offsets={'j2': (0.0, 1.0)}, in_m=frozenset({'j2'})),
            'is a length, but',
        ),
    ):
        with pytest.raises(InputError, match=words):
            fit_session(session, rng=np.random.default_rng(1), priors=wrong)
