# SPDX-License-Identifier: Apache-2.0
"""A correction that is made of every command: held against the arm, and where the arm then is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from worlds.compensation_files import arm, save
from worlds.hidden_tours import robot
from worlds.sliding_cells import rail

from remaster_ros.compensation.arm_model import ArmModel, Function, Geometry, JointTerm
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.in_use import KNOWN_OFFSET_RAD, CorrectionInUse
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain

URDF = robot('iiwa7')
CHAIN = SerialChain.from_urdf(URDF, 'base_link', 'tool')


def soft_arm(seed: int, times: float = 1.0) -> ArmModel:
    """Return an arm with offsets, waves, joints and bearings so soft, lengths and tilts."""
    print('seed', seed)
    rng = np.random.default_rng(seed)
    k = len(CHAIN)
    terms = tuple(
        JointTerm(j, 'x', Function(driver, form, j, order), size * rng.standard_normal(1))
        for j in range(k)
        for driver, form, order, size in (
            ('angle', 'sin', 1, 5e-4),
            ('gravity_torque', 'linear', 0, 3e-5 * times),
        )
    )
    return arm(
        URDF,
        joint_offsets=np.radians(0.3) * rng.standard_normal(k),
        joint_terms=terms,
        geometry=Geometry(
            3e-4 * rng.standard_normal((k + 1, 3)), 5e-4 * rng.standard_normal((k + 1, 3))
        ),
        lateral_compliance=np.abs(3e-6 * times * rng.standard_normal(k)),
    )


def in_use(path, chain=CHAIN, urdf=URDF):
    return CorrectionInUse(str(path), chain, urdf, 'the_cell.urdf')


def configurations(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(CHAIN.lower, CHAIN.upper, (count, len(CHAIN)))


@pytest.mark.parametrize(('driver', 'size'), [('angle', 1.2), ('gravity_torque', 0.5)])
def test_a_file_whose_terms_no_command_takes_off_is_refused(tmp_path, driver, size):
    def read(coefficient):
        form, order = ('sin', 1) if driver == 'angle' else ('linear', 0)
        wave = JointTerm(1, 'x', Function(driver, form, 1, order), np.array([coefficient]))
        return in_use(save(tmp_path, arm(URDF, joint_terms=(wave,)), URDF))

    with pytest.raises(InputError, match=r'joints change an angle by up to .* rad per rad'):
        read(size)
    read(1e-3 * size)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_the_true_arm_is_within_the_clearance_of_the_one_that_is_checked(tmp_path, seed):
    """All links at fresh configurations, by the rule of the clearances: levers from the axes."""
    model = soft_arm(seed, 5.0)
    correction = in_use(save(tmp_path, model, URDF))
    q = configurations(500, 10 + seed)
    there = model.state(q).frames[..., :3, 3]
    checked = correction.true_arm.frames(q)
    off = np.linalg.norm(there - checked[..., :3, 3], axis=-1)
    unknown = correction.joint_angle_bound(np.deg2rad(1.0))
    axes, used = CHAIN.axes_in_base(checked), []
    for link in range(1, len(CHAIN)):
        arms = checked[:, link, None, :3, 3] - checked[:, :link, :3, 3]
        levers = np.linalg.norm(np.linalg.norm(np.cross(axes[:, :link], arms), axis=-1), axis=-1)
        is_far = levers > 0.05
        used += [*(off[is_far, link] / (unknown * levers[is_far]))]
    assert 0.3 < np.max(used) < 1.0
    # What is left of the offsets alone would not do.
    assert np.max(used) * unknown > 1.5 * KNOWN_OFFSET_RAD


def test_lengths_and_tilts_are_built_in(tmp_path):
    model = replace(soft_arm(4), joint_terms=(), lateral_compliance=np.zeros(len(CHAIN)))
    correction = in_use(save(tmp_path, model, URDF))
    q = configurations(50, 5)
    np.testing.assert_allclose(correction.true_arm.forward(q), model.state(q).tool, atol=1e-12)
    assert correction.joint_angle_bound(1.0) == pytest.approx(KNOWN_OFFSET_RAD, abs=1e-7)


def test_limits_are_shifted_by_the_least_and_the_largest(tmp_path):
    model = soft_arm(4)
    correction = in_use(save(tmp_path, model, URDF))
    q = configurations(500, 5)
    added = model.state(q).angles - q
    least, largest = correction.shifts
    spread = largest - least
    assert np.all(spread > 1e-4)
    assert np.all(added > least - 0.05 * spread)
    assert np.all(added < largest + 0.05 * spread)


def test_commands_are_those_of_the_file_whatever_becomes_of_it(tmp_path):
    model = soft_arm(6)
    path = save(tmp_path, model, URDF)
    correction = in_use(path)
    path.write_text('something else')
    wanted = configurations(40, 7)
    done = correction.commands(wanted)
    expected = Compensator(model).correct(wanted)
    np.testing.assert_allclose(done.command, expected.command, atol=1e-9)
    np.testing.assert_allclose(done.command - done.change, wanted, atol=1e-12)
    assert not done.refused
    remarks = [f'solution {row} is near a singularity' for row in np.flatnonzero(done.incomplete)]
    assert np.array_equal(done.incomplete, expected.incomplete)
    assert remarks
    assert [note.split(':')[0] for note in done.notes] == remarks
    # A stop of the planner.
    assert len(correction.commands(wanted[:0]).command) == 0


def test_rows_that_are_no_numbers_or_too_far_are_refused_each_by_itself(tmp_path, monkeypatch):
    correction = in_use(save(tmp_path, soft_arm(8), URDF))
    wanted = configurations(3, 9)
    wanted[1, 2] = np.nan
    done = correction.commands(wanted)
    assert done.refused == {1: 'it is no finite number'}
    assert np.all(np.isfinite(done.command[[0, 2]]))
    # What is refused cannot be commanded by mistake.
    assert np.all(np.isnan(done.command[1]))
    largest = np.degrees(np.abs(done.change[[0, 2]]).max(axis=1))
    monkeypatch.setattr(correction, '_most_deg', float(np.mean(largest)))
    beyond = [0, 2][int(np.argmax(largest))]
    done = correction.commands(wanted)
    refused = done.refused
    assert np.all(np.isnan(done.command[[1, beyond]]))
    assert set(refused) == {1, beyond}
    assert f'by {largest.max():.2f} degrees' in refused[beyond].replace('-', '')


def test_what_is_not_of_this_arm_or_too_large_is_one_line(tmp_path):
    path = save(tmp_path, soft_arm(11), URDF)

    def refused(words, *given):
        with pytest.raises(InputError, match=words) as caught:
            in_use(*given)
        assert '\n' not in str(caught.value)
        assert 'compensation.json' in str(caught.value)

    refused(r'another URDF \(checksum .* than the_cell.urdf', path, CHAIN, URDF + '<!-- -->')
    refused('its tip link', path, replace(CHAIN, tip_link='flange'))
    renamed = ('other', *CHAIN.joint_names[1:])
    refused('its joints', path, replace(CHAIN, joint_names=renamed))
    refused('compensation.json', tmp_path / 'no' / 'compensation.json')
    offsets = np.zeros(len(CHAIN))
    offsets[3] = np.radians(-2.1)
    far = save(tmp_path, arm(URDF, joint_offsets=offsets), URDF)
    refused(rf'would change {CHAIN.joint_names[3]} by up to 2\.1\d degrees, and 2 are', far)
    offsets[3] = np.radians(1.9)
    correction = in_use(save(tmp_path, arm(URDF, joint_offsets=offsets), URDF))
    assert correction.remarks == []


@pytest.mark.parametrize(
    ('std_deg', 'known', 'unknown_deg'),
    [(0.01, True, 0.1), (0.2, True, 0.6), (0.01, False, 1.3)],
)
def test_the_clearance_covers_what_is_still_unknown(tmp_path, std_deg, known, unknown_deg):
    """Of an offset that could not be identified as much as before is unknown."""
    model = arm(URDF, joint_offsets=np.full(len(CHAIN), 0.01))
    identifiable = [True] * (len(CHAIN) - 1) + [known]
    path = save(tmp_path, model, URDF, np.radians(std_deg), identifiable)
    assert in_use(path).joint_angle_bound(np.radians(1.3)) == pytest.approx(
        np.radians(unknown_deg)
    )


def test_what_must_hold_for_it_is_told(tmp_path):
    path = save(tmp_path, soft_arm(12), URDF)
    content = json.loads(path.read_text())
    for form, count in (('pad', 1), ('robot_bridge', 0)):
        content['state'] = {'correction': {'form': form, 'sha256': ''}}
        path.write_text(json.dumps(content))
        remarks = in_use(path).remarks
        assert len(remarks) == count
        assert all('(pad), which must still be on' in line for line in remarks)


def test_no_node_corrects_what_an_arm_that_slides_is_commanded(tmp_path):
    """Its bounds are of angles."""
    path = save(tmp_path, arm(rail()), rail())
    with pytest.raises(InputError, match="joint 'rail' slides, and no node corrects what"):
        CorrectionInUse(str(path))
