# SPDX-License-Identifier: Apache-2.0
"""fit.json keeps its contract, and the three ways to apply offsets do the same."""

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from rigs.command_line import remaster
from worlds.arms import planar_arm

from remaster_ros.calibration.residual_structure import ResidualStructure, StructureTest
from remaster_ros.compensation.export import (
    ZeroOffsets,
    calibrated_urdf,
    exports,
    layer_text,
    remaster_text,
    rpy_of,
)
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_quaternion_xyzw, matrix_from_rpy
from remaster_ros.reports.fit_json import fit_content, joint_offsets_of, read_fit
from remaster_ros.reports.fit_page import fit_html
from remaster_ros.reports.loadable import geometry_of
from remaster_ros.reports.result_folder import prepare_folder, save_fit
from remaster_ros.reports.result_lines import fit_lines


def test_fit_json_is_the_fit(fit_result, tmp_path):
    save_fit(fit_result, tmp_path / 'new', figures=False)
    fit = read_fit(tmp_path / 'new' / 'fit.json')
    assert fit == fit_content(fit_result)
    assert fit.format == 'remaster-fit/1'
    assert [row.joint for row in fit.joint_offsets] == list(fit_result.joint_names)
    offsets, std = joint_offsets_of(fit, fit_result.chain)
    np.testing.assert_allclose(offsets, fit_result.joint_offsets, atol=1e-14)
    known = np.where(fit_result.identifiable, fit_result.joint_offsets_std, 0.0)
    np.testing.assert_allclose(std, known, atol=1e-14)
    for i, row in enumerate(fit.joint_offsets):
        assert row.identifiable == (row.why == '') == bool(fit_result.identifiable[i])
        assert row.interval95_deg[0] <= row.mean_deg <= row.interval95_deg[1]
    assert set(fit.registration) == set(fit.noise) == set(fit_result.session.sensors)
    for sensor, frame in fit.registration.items():
        T_R_N = fit_result.T_R_N[sensor]
        np.testing.assert_allclose(frame.translation_m, T_R_N[:3, 3])
        rotation = matrix_from_quaternion_xyzw(frame.rotation_xyzw)
        np.testing.assert_allclose(rotation, T_R_N[:3, :3], atol=1e-12)
    assert set(fit.markers) == {'sir', 'smr'}
    assert fit.sampler.chains == 4
    assert fit.sampler.seconds is None  # no clock was given
    assert fit.gauge[0].fixed_by == f'{fit_result.joint_names[0]} = 0'
    assert [row.observation for row in fit.left_out] == [o for o, _ in fit_result.left_out]
    assert fit.left_out
    assert len(fit.robot.urdf_sha256) == 64


def test_what_a_person_is_shown_contains_an_arm_off_its_drawing(fit_result, tmp_path):
    """Page, terminal, files and Python's table have the wider std, and name the narrower one."""
    save_fit(fit_result, tmp_path, figures=False)
    fit = read_fit(tmp_path / 'fit.json')
    geometry = geometry_of(fit_result)
    moved = np.sqrt(2.0) * np.linalg.norm(geometry.offset_moves, axis=1)
    wider = np.degrees(np.hypot(moved, fit_result.joint_offsets_std))
    drawn = np.degrees(fit_result.joint_offsets_std)
    lines, html = fit_lines(fit), fit_html(fit_result, {})
    layer = (tmp_path / 'apply' / 'offset_layer.yaml').read_text()
    in_layer = iter(yaml.safe_load(layer)['/**']['ros__parameters']['joint_offsets_std'])
    known = np.flatnonzero(fit_result.identifiable)
    assert len(known)
    for i in known:
        row = fit.joint_offsets[i]
        assert row.std_deg == pytest.approx(wider[i])
        assert row.std_if_exactly_drawn_deg == pytest.approx(drawn[i])
        assert 2.0 * drawn[i] < wider[i]
        half = np.degrees(np.diff(fit_result.joint_offsets_interval95[i])[0]) / 2.0
        low, high = row.interval95_deg
        assert (high - low) / 2.0 == pytest.approx(half * wider[i] / drawn[i])
        assert f'± {wider[i]:.4f} deg ({drawn[i]:.4f} if the arm is exactly' in lines[i]
        assert f'<td class="n">{wider[i]:.4f}</td>' in html
        assert np.degrees(next(in_layer)) == pytest.approx(wider[i])
        assert f'{wider[i]:.4f}' in (tmp_path / 'apply' / 'remaster.txt').read_text()
    # And so has what is exported of the correction.
    file = tmp_path / 'apply' / 'compensation.json'
    remaster('export', file, '--to', 'pad', '--out', tmp_path / 'pad', '--quiet')
    pages = (tmp_path / 'pad' / 'remaster.txt').read_text()
    for joint, cells in ((line.split()[0], line.split()) for line in pages.splitlines() if line):
        if joint in fit_result.joint_names and len(cells) == 4:
            assert float(cells[2]) > 2.0 * drawn[fit_result.joint_names.index(joint)]
    assert 'std if the arm is exactly its drawing' in html
    assert 'off their drawing by 0.1 mm' in layer


def test_offsets_of_another_robot_are_refused(fit_result):
    fit = fit_content(fit_result)
    with pytest.raises(InputError, match='use the fit of this robot'):
        joint_offsets_of(fit, planar_arm(2))
    rail = replace(fit_result.chain, slides=np.arange(len(fit_result.chain)) == 2)
    with pytest.raises(InputError, match='joint_3: its offset is in deg, the robot has it in mm'):
        joint_offsets_of(fit, rail)


def test_an_offset_without_its_std_is_refused(fit_result):
    fit = fit_content(fit_result)
    fit.joint_offsets[1].std_deg = None
    with pytest.raises(InputError, match='joint_2: std_deg is missing; fit again'):
        joint_offsets_of(fit, fit_result.chain)


def test_a_file_with_the_keys_of_the_contract_alone_is_read(fit_result, tmp_path):
    """Other programs write no more; each record fills in the rest."""
    fit = msgspec.to_builtins(fit_content(fit_result))
    kept = {
        'joint_offsets': 'joint mean_deg std_deg interval95_deg identifiable why',
        'registration': 'translation_m rotation_xyzw std_m std_rad',
        'markers': 'position_m std_m',
        'noise': 'sigma_m std_m pose_sigma_m',
        'sampler': 'name chains draws r_hat_max ess_min seconds',
    }

    def only(part, keys):
        if isinstance(part, list):
            return [only(item, keys) for item in part]
        if keys[0] in part:
            return {key: part[key] for key in keys}
        return {name: only(item, keys) for name, item in part.items()}

    plain = {key: only(fit[key], keys.split()) for key, keys in kept.items()}
    plain |= {key: fit[key] for key in ('format', 'gauge', 'accuracy', 'left_out')}
    (tmp_path / 'fit.json').write_text(json.dumps(plain))
    read = read_fit(tmp_path / 'fit.json')
    assert msgspec.to_builtins(read.noise) == plain['noise']
    assert (read.sampler.method, read.sampler.precision) == ('metropolis', None)
    np.testing.assert_array_equal(
        joint_offsets_of(read, fit_result.chain)[0],
        joint_offsets_of(fit_content(fit_result), fit_result.chain)[0],
    )


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('std_deg', -0.01),
        ('std_deg', 1e30),
        ('mean_deg', -1e300),
        ('std_if_exactly_drawn_deg', -1.0),
    ],
)
def test_offsets_that_are_no_angles_are_refused(fit_result, key, value):
    fit = fit_content(fit_result)
    setattr(fit.joint_offsets[2], key, value)
    with pytest.raises(InputError, match=f'joint_3: {key} is {value:g}, not '.replace('+', r'\+')):
        joint_offsets_of(fit, fit_result.chain)


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        (lambda fit: fit.pop('joint_offsets'), 'joint_offsets'),
        (lambda fit: fit.update(format='remaster-fit/9'), 'remaster-fit/9'),
        (lambda fit: fit['joint_offsets'][1].update(mean_deg='x'), r'joint_offsets\[1\]'),
        (lambda fit: fit['noise']['mocap'].pop('sigma_m'), 'sigma_m'),
    ],
)
def test_a_wrong_fit_json_is_refused(fit_result, tmp_path, change, problem):
    path = tmp_path / 'fit.json'
    fit = msgspec.to_builtins(fit_content(fit_result))
    change(fit)
    path.write_text(json.dumps(fit))
    with pytest.raises(InputError, match=problem) as caught:
        read_fit(path)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_the_file_of_another_verb_is_called_so(tmp_path):
    (tmp_path / 'fit.json').write_text('{"format": "remaster-discovery/1", "noise": {"a": 1.0}}')
    with pytest.raises(InputError, match="format is 'remaster-discovery/1', not 'remaster-fit/1'"):
        read_fit(tmp_path / 'fit.json')


@pytest.mark.parametrize('data', [b'', b'{', b'[]', b'\xff\xfe', b'[' * 100_000])
def test_what_is_no_fit_json_is_refused(data, tmp_path):
    (tmp_path / 'fit.json').write_bytes(data)
    with pytest.raises(InputError, match=r'fit\.json'):
        read_fit(tmp_path / 'fit.json')


def test_an_output_folder_is_tried_before_the_work(tmp_path):
    prepare_folder(tmp_path / 'out', 'fit.json')
    prepare_folder(tmp_path / 'out', 'fit.json')
    assert list((tmp_path / 'out').iterdir()) == []
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='cannot be written'):
        prepare_folder(tmp_path / 'file', 'fit.json')


def test_the_calibrated_urdf_is_the_robot_with_offsets(fit_result):
    rng = np.random.default_rng(2)
    chain = fit_result.chain
    offsets = rng.normal(0, 0.02, len(chain))
    text = calibrated_urdf(fit_result.session.urdf, chain, offsets)
    calibrated = SerialChain.from_urdf(text, chain.base_link, chain.tip_link)
    q = rng.uniform(chain.lower, chain.upper, (50, len(chain)))
    np.testing.assert_allclose(
        calibrated.forward(q), chain.forward(q, offsets), rtol=0, atol=1e-12
    )
    # The arm stops in the same places: reported limit + offset = nominal limit.
    np.testing.assert_allclose(calibrated.lower + offsets, chain.lower, atol=1e-12)
    np.testing.assert_allclose(calibrated.upper + offsets, chain.upper, atol=1e-12)
    np.testing.assert_allclose(calibrated.masses, chain.masses)
    assert 'Geometry, limits and velocities' in text  # comments stay


def test_joints_without_origin_or_limits_are_calibrated_too():
    text = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
      <joint name="j1" type="continuous"><parent link="a"/><child link="b"/>
        <axis xyz="0 1 0"/></joint>
      <joint name="j2" type="revolute"><parent link="b"/><child link="c"/>
        <origin xyz="1 0 0"/><axis xyz="0 0 2"/><limit lower="-1" upper="1" velocity="1"/>
        <safety_controller soft_lower_limit="-0.9" soft_upper_limit="0.9"/></joint></robot>"""
    chain = SerialChain.from_urdf(text)
    offsets = np.array([0.1, -0.2])
    shifted = calibrated_urdf(text, chain, offsets)
    calibrated = SerialChain.from_urdf(shifted)
    q = np.array([0.3, 0.4])
    np.testing.assert_allclose(calibrated.forward(q), chain.forward(q, offsets), atol=1e-15)
    assert 'soft_upper_limit="1.1' in shifted


def test_roll_pitch_yaw_are_exact_at_and_near_the_singularity():
    rng = np.random.default_rng(4)
    for distance in (0.0, 1e-16, 1e-12, 1e-9, 1e-7, 1e-4, 1.0):
        for sign in (-1, 1):
            rpy = rng.uniform(-3, 3, 3)
            rpy[1] = sign * (np.pi / 2 - distance)
            rotation = matrix_from_rpy(rpy)
            np.testing.assert_allclose(matrix_from_rpy(rpy_of(rotation)), rotation, atol=1e-14)


def test_the_offset_layer_is_a_ros_parameter_file(fit_result):
    known = fit_result.identifiable
    assert 0 < known.sum() < len(known)
    parameters = yaml.safe_load(layer_text(ZeroOffsets.of(fit_result)))['/**']['ros__parameters']
    names = np.array(fit_result.joint_names)
    assert parameters['joint_names'] == names[known].tolist()
    assert parameters['joint_offsets'] == fit_result.joint_offsets[known].tolist()
    assert parameters['joint_offsets_std'] == fit_result.joint_offsets_std[known].tolist()
    assert parameters['left_out'] == names[~known].tolist()


def test_the_instructions_are_for_minus_the_offset(fit_result):
    text = remaster_text(ZeroOffsets.of(fit_result))
    table, _, notes = text.partition('Left out of all three')
    for i, joint in enumerate(fit_result.joint_names):
        lines = [line for line in table.splitlines() if line.split()[:1] == [joint]]
        assert len(lines) == fit_result.identifiable[i]
        if not fit_result.identifiable[i]:
            assert f'{joint}: {fit_result.why[i]}' in notes
            continue
        offset, _, drive_to = map(float, lines[0].split()[1:4])
        assert (
            offset == -drive_to == pytest.approx(np.degrees(fit_result.joint_offsets[i]), abs=6e-5)
        )


@pytest.mark.parametrize('known', [True, False])
def test_all_joints_or_none_may_be_applied(fit_result, known):
    """No list that ROS cannot read, no table without rows, and hyphens that end no comment."""
    count = len(fit_result.joint_names)
    result = replace(
        fit_result,
        identifiable=np.full(count, known),
        why=('' if known else 'joint_1 -- a <name> --->',) * count,
    )
    texts = exports(result)
    layer = yaml.safe_load(texts['offset_layer.yaml'])
    parameters = layer['/**']['ros__parameters']
    assert ('joint_names' in parameters) == ('joint_offsets' in parameters) == known
    assert ('left_out' in parameters) != known
    text = texts['remaster.txt']
    assert ('drive to, deg' in text) == known
    assert ('these data determine no offset' in text) != known
    assert ('Left out' in text) != known
    urdf = texts['robot_calibrated.urdf']
    chain = SerialChain.from_urdf(urdf, result.chain.base_link, result.chain.tip_link)
    assert np.array_equal(chain.lower, result.chain.lower) != known
    assert ('left out' in urdf) != known


def test_wider_intervals_and_their_reason_are_in_the_file(fit_result):
    """And nothing of them where the sampler is one that has no such tests."""
    tests = (StructureTest('position', True, 1e-9), StructureTest('time', True, 0.4))
    widening = np.ones(len(fit_result.joint_names))
    widening[2] = 3.0
    found = replace(fit_result, structure=ResidualStructure(tests), widening=widening)
    content = msgspec.to_builtins(fit_content(found))
    assert content['intervals'] == 'robust'
    assert [test['found'] for test in content['residual_structure']] == [True, False]
    assert content['residual_structure'][0]['driver'] == 'position'
    rows = content['joint_offsets']
    assert rows[2]['model_std_deg'] == pytest.approx(rows[2]['std_if_exactly_drawn_deg'] / 3.0)
    assert 'model_std_deg' not in rows[3]
    places = (*content['registration'].values(), *content['markers'].values())
    assert len(places) > 1
    assert all(place['std_is_lower_limit'] for place in places)
    assert 'lower limits' in fit_html(found, {})
    healthy = replace(found, structure=ResidualStructure(tests[1:]))
    assert not healthy.other_errors
    assert 'std_is_lower_limit' not in str(msgspec.to_builtins(fit_content(healthy)))
    assert 'lower limits' not in fit_html(healthy, {})
    assert 'intervals' not in msgspec.to_builtins(fit_content(replace(fit_result, structure=None)))


def test_the_approximation_and_its_check_are_in_the_file(fit_result):
    sampler = msgspec.structs.replace(
        fit_result.sampler, method='laplace', pareto_k=0.45, r_hat_max=None
    )
    content = msgspec.to_builtins(fit_content(replace(fit_result, sampler=sampler)))
    assert content['sampler']['method'] == 'laplace'
    assert content['sampler']['pareto_k'] == 0.45
    assert content['sampler']['r_hat_max'] is None
    usual = msgspec.to_builtins(fit_content(fit_result))['sampler']
    assert (usual['method'], usual['pareto_k']) == ('metropolis', None)


def test_results_of_others_are_not_replaced(fit_result, tmp_path):
    save_fit(fit_result, tmp_path / 'fit', figures=False)
    prepare_folder(tmp_path / 'fit', 'fit.json')
    with pytest.raises(InputError, match=r'holds apply, fit\.json, residuals\.csv, not written'):
        prepare_folder(tmp_path / 'fit', 'discovery.json')
    for name, words in (
        ('report.html', r'holds report\.html, not written by this command'),
        ('figures', 'holds figures, '),
        ('fit.json', r'fit\.json: is there and is no remaster-fit/1'),
        ('discovery.json', r'holds discovery\.json, '),
    ):
        folder = tmp_path / f'with_{name}'
        folder.mkdir()
        (folder / name).write_text('{"format": "mine"}')
        with pytest.raises(InputError, match=words):
            prepare_folder(folder, 'fit.json')
        assert (folder / name).read_text() == '{"format": "mine"}'
    # What the command does not write is in nobody's way.
    (tmp_path / 'notes').mkdir()
    (tmp_path / 'notes' / 'mine.txt').write_text('')
    prepare_folder(tmp_path / 'notes', 'fit.json')
