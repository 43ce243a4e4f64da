# SPDX-License-Identifier: Apache-2.0
"""A collection through a bridge that corrects what it commands, with real nodes."""

import hashlib
import json

import numpy as np
import pytest
import scipy.stats
from rigs.collection_rig import SEED, Cell
from rigs.command_line import remaster
from rigs.ros_rig import call
from worlds.compensation_files import save

from remaster_ros.calibration.fit import fit_session
from remaster_ros.cli.verify import visits
from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.file import read_compensation
from remaster_ros.compensation.verification import verify
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world
from remaster_ros.types import Correction

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

# Sessions of nothing wrong in which a joint's offset is outside its interval.
WRONG = 1.0 / 500.0


def true_correction(folder, share=1.0):
    """Write the compensation.json of so much of the offsets that the world of the rig hides."""
    from dataclasses import replace

    cell = read_cell('demo')
    truth = make_world(folder / 'twin', cell, SEED, 1.0).truth
    model = replace(
        ArmModel.nominal(cell.chain()),
        joint_offsets=share * truth.joint_offsets,
        T_R_N={'mocap': np.eye(4)},
        markers={name: np.array(at) for name, at in cell.markers.items()},
    )
    return save(folder, model, cell.urdf_text), truth.joint_offsets


@pytest.mark.qualify
def test_offsets_fitted_through_the_bridge_are_zero(start, client, tmp_path):
    """Of all joints together one is outside in a session of 500: seeds are fixed, moments not.

    At the reported angles the same rows have the hidden offsets again.
    """
    file, hidden = true_correction(tmp_path)
    compensator = read_compensation(file).compensator
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], candidates=8, compensation=file)
    session = cell.complete()
    cell.check(session)
    m = session.measurements
    assert session.correction == Correction(
        'robot_bridge', hashlib.sha256(file.read_bytes()).hexdigest()
    )
    assert m.correction.tolist() == [1] * len(m)
    # What was commanded is what the file makes of what was wanted, to the arm's repeatability.
    np.testing.assert_allclose(m.q, compensator.command(m.wanted), atol=1e-4)
    assert np.max(np.abs(m.q - m.wanted)) > np.deg2rad(0.2)
    assert cell.events
    assert not [e for e in cell.events if type(e).__name__ == 'ArmHalted']

    raw = fit_session(session, rng=np.random.default_rng(1), draws=400)
    known = raw.identifiable
    assert known.sum() >= 5
    # The noise is estimated from few poses, and what is left of them after base and marker.
    freedom = 3 * len(np.unique(m.pose[~m.is_validation])) - 9
    limit = scipy.stats.t.ppf(1.0 - 0.5 * WRONG / known.sum(), freedom)
    assert np.all(np.abs((raw.joint_offsets - hidden) / raw.joint_offsets_std)[known] < limit)
    assert np.max(np.abs(raw.joint_offsets / raw.joint_offsets_std)[known]) > 10.0
    corrected_fit = fit_session(
        session.through_correction(), rng=np.random.default_rng(1), draws=400
    )
    assert np.all(
        np.abs(corrected_fit.joint_offsets / corrected_fit.joint_offsets_std)[known] < limit
    )
    # Hundredths of a degree would show: the offsets that are hidden are tenths.
    assert limit * np.max(corrected_fit.joint_offsets_std[known]) < np.deg2rad(0.05)

    assert verify(compensator, visits(session, cell.session)).verdict == 'in_use'
    done = remaster('replay', cell.session, '--out', tmp_path / 'again')
    assert 'all rows are those of' in done.stdout


@pytest.mark.parametrize(
    ('share', 'verdict'), [(1.0, 'in_use'), pytest.param(-1.0, 'other', marks=pytest.mark.qualify)]
)
def test_ten_poses_with_the_correction_off_and_on_tell_whether_it_is_in_use(
    start, client, tmp_path, share, verdict
):
    """With the sign of each offset wrong, what acts is none of the correction's own states."""
    from std_msgs.msg import String

    from remaster_ros.nodes.status import LATCHED

    file, _ = true_correction(tmp_path, share)
    compensator = read_compensation(file).compensator
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], collect=False, compensation=file)
    verdicts = []
    client.create_subscription(String, 'remaster/verdict', verdicts.append, LATCHED)
    cell.until(lambda: call(client, '/remaster/verify').success, 'the bridge to be known')
    assert not call(client, '/remaster/verify').success
    session = cell.complete()
    m = session.measurements
    on = m.correction == 1
    # As they were visited: pairs of one pose, in either order.
    pairs = m.correction.reshape(10, 2)
    assert np.all(pairs.sum(axis=1) == 1)
    assert 0 < pairs[:, 0].sum() < 10
    assert m.is_validation.all()
    np.testing.assert_allclose(m.q[on], compensator.command(m.wanted[on]), atol=1e-4)
    np.testing.assert_array_equal(m.q[~on], m.wanted[~on])
    wanted = m.wanted.reshape(10, 2, -1)
    np.testing.assert_allclose(wanted[:, 0], wanted[:, 1], atol=1e-4)
    assert not [e for e in cell.events if type(e).__name__ in ('ArmHalted', 'SolutionFailed')]

    cell.until(lambda: verdicts, 'the verdict')
    found = json.loads(verdicts[0].data)
    assert found['verdict'] == verdict
    if share == 1.0:
        assert found['toggle']['verdict'] == 'in_use'
        assert found['error_mm']['on']['mean_mm'] < 0.3 < found['error_mm']['off']['mean_mm']
    done = remaster('verify', cell.session, '--compensation', file, '--json')
    assert json.loads(done.stdout) == found
    response = call(client, '/remaster/verify')
    assert response.success
    assert response.message.startswith(verdict)
    assert 'it was no calibration' in call(client, '/remaster/collect').message
