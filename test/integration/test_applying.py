# SPDX-License-Identifier: Apache-2.0
"""Each applied form, used, leaves nothing to correct, on descriptions as makers ship them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rigs.command_line import remaster
from worlds import robot_descriptions

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.reports.fit_json import joint_offsets_of, read_fit
from remaster_ros.session.records.reader import write_session
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import Session

MARKERS = {'sir': np.array([0.1, 0.0, 0.02]), 'smr': np.array([-0.1, 0.03, 0.02])}


def simulated(robot: robot_descriptions.Description, seed: int) -> Session:
    """Visit random configurations, four to a pose, with offsets of some 0.3 degrees."""
    chain = SerialChain.from_urdf(robot.urdf, robot.base_link, robot.tip_link)
    rng = np.random.default_rng(seed)
    low, high = np.maximum(chain.lower, -2.5), np.minimum(chain.upper, 2.5)

    def poses(count: int) -> list[np.ndarray]:
        return [rng.uniform(low, high, (4, len(chain))) for _ in range(count)]

    turn = rotation_vector_to_matrix(rng.standard_normal(3))
    session, _ = simulate_session(
        chain,
        robot.urdf,
        rng,
        poses=poses(20),
        validation_poses=poses(8),
        sensors={
            'mocap': SimulatedSensor('sir', transform(turn, (2.0, 0.3, 1.0))),
            'tracker': SimulatedSensor('smr', transform(turn.T, (3.0, -1.0, 0.2))),
        },
        markers=MARKERS,
        joint_offset_std=np.radians(0.3),
    )
    return session


def fitted(session: Session, folder: Path) -> Path:
    write_session(folder / 'session', session)
    out = folder / 'fit'
    remaster('fit', folder / 'session', '--out', out, '--no-figures', '--quiet')
    return out


def shifted(session: Session, shift: np.ndarray) -> Session:
    """Return the session as it would be recorded were ``shift`` added to what is reported."""
    m = session.measurements
    # A limit of the nominal robot may be passed by a fraction of a degree.
    return replace(
        session, measurements=replace(m, q=m.q + shift, from_q=np.full_like(m.q, np.nan))
    )


def chain_of(session: Session) -> SerialChain:
    return SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)


def through_the_urdf(session: Session, apply: Path) -> Session:
    return replace(session, urdf=(apply / 'robot_calibrated.urdf').read_text(encoding='utf-8'))


def through_the_layer(session: Session, apply: Path) -> Session:
    """Read as a ROS node reads its parameters."""
    content = yaml.safe_load((apply / 'offset_layer.yaml').read_text(encoding='utf-8'))
    layer = content['/**']['ros__parameters']
    by_name = dict(zip(layer['joint_names'], layer['joint_offsets'], strict=True))
    chain = chain_of(session)
    return shifted(session, np.array([by_name.get(name, 0.0) for name in chain.joint_names]))


def through_the_pad(session: Session, apply: Path) -> Session:
    """Read as a person does: a joint is driven to an angle, and set to show another, or zero."""
    chain = chain_of(session)
    shift = np.zeros(len(chain))
    for line in (apply / 'remaster.txt').read_text(encoding='utf-8').splitlines():
        words = line.split()
        if len(words) == 8 and words[1] in chain.joint_names:
            name, drive_to, set_to = words[1], float(words[4]), float(words[6])
        elif len(words) == 4 and words[0] in chain.joint_names:
            name, drive_to, set_to = words[0], float(words[3]), 0.0
        else:
            continue
        shift[chain.joint_names.index(name)] = np.radians(set_to - drive_to)
    return shifted(session, shift)


FORMS = {'urdf': through_the_urdf, 'layer': through_the_layer, 'pad': through_the_pad}


# With one robot of six joints, and the pad in test_on_the_pad; `make qualify` has the rest.
FIRST, SEVEN = 'ur5e', 'panda'
ROBOTS = [
    pytest.param(robot, marks=() if robot in (FIRST, SEVEN) else pytest.mark.qualify)
    for robot in robot_descriptions.ROBOTS
]


@pytest.fixture(scope='module', params=ROBOTS)
def before(request, tmp_path_factory):
    """Return the session of a robot, its fit's folder, and the fit's offsets and stds, rad."""
    robot = robot_descriptions.ROBOTS[request.param]()
    session = simulated(robot, seed=5)
    out = fitted(session, tmp_path_factory.mktemp(request.param))
    fit = read_fit(out / 'fit.json')
    offsets, std = joint_offsets_of(fit, chain_of(session))
    known = np.array([row.identifiable for row in fit.joint_offsets])
    # What is to be corrected is there, and the outer two joints are not to be told.
    assert np.abs(offsets[known]).max() > 10 * std[known].max()
    assert not known[0]
    assert known[1:-1].all()
    return session, out, fit, known, std


COMBINATIONS = [
    pytest.param(
        robot,
        form,
        marks=() if robot == FIRST and form != 'pad' else pytest.mark.qualify,
    )
    for robot in robot_descriptions.ROBOTS
    for form in FORMS
]


@pytest.mark.parametrize(('before', 'form'), COMBINATIONS, indirect=['before'])
def test_a_refit_after_applying_finds_nothing(before, form, tmp_path):
    session, out, _, known, std = before
    again = read_fit(fitted(FORMS[form](session, out / 'apply'), tmp_path) / 'fit.json')
    offsets, _ = joint_offsets_of(again, chain_of(session))
    # The same measurements: what is left is the draws' error and the rounding of four digits.
    assert np.all(np.abs(offsets[known]) < 0.3 * std[known] + np.radians(1e-4)), np.degrees(
        offsets
    )


def test_joints_that_are_not_identifiable_are_named_in_each_file_and_corrected_in_none(before):
    session, out, fit, known, _ = before
    apply = out / 'apply'
    unknown = {row.joint: row.why for row in fit.joint_offsets if not row.identifiable}
    assert unknown
    nominal = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    calibrated = through_the_urdf(session, apply)
    corrected = SerialChain.from_urdf(calibrated.urdf, calibrated.base_link, calibrated.tip_link)
    for i, name in enumerate(nominal.joint_names):
        same = nominal.lower[i] == corrected.lower[i]
        assert same == (name in unknown), name
    layer = (apply / 'offset_layer.yaml').read_text(encoding='utf-8')
    parameters = yaml.safe_load(layer)['/**']['ros__parameters']
    assert parameters['left_out'] == list(unknown)
    assert not set(parameters['joint_names']) & set(unknown)
    assert len(parameters['joint_offsets']) == len(parameters['joint_names']) == known.sum()
    text = (apply / 'remaster.txt').read_text(encoding='utf-8')
    comments = calibrated.urdf
    for name, why in unknown.items():
        for content in (layer, text, comments):
            assert f'{name}: {why}' in content


def elements(urdf: str, *, but: str) -> list[tuple[str, list[tuple[str, str]], str]]:
    """Return every element outside the robot's own joints, in order."""
    root = ElementTree.fromstring(urdf)
    return [
        (e.tag, sorted(e.attrib.items()), (e.text or '').strip())
        for child in root
        if child.tag != but
        for e in child.iter()
    ]


def test_only_the_joints_of_the_arm_are_changed(before):
    """What names them again, for drivers and simulators, is as it was."""
    session, out, fit, _, _ = before
    urdf = (out / 'apply' / 'robot_calibrated.urdf').read_text(encoding='utf-8')
    assert elements(urdf, but='joint') == elements(session.urdf, but='joint')
    old = {j.get('name'): j for j in ElementTree.fromstring(session.urdf).findall('joint')}
    new = {j.get('name'): j for j in ElementTree.fromstring(urdf).findall('joint')}
    assert list(new) == list(old)
    changed = {n for n in old if ElementTree.tostring(old[n]) != ElementTree.tostring(new[n])}
    applied = {row.joint for row in fit.joint_offsets if row.identifiable}
    assert changed - {'joint_2_cover'} == applied
    if 'joint_2_cover' in old:
        offset = next(r.mean_deg for r in fit.joint_offsets if r.joint == 'joint_2')
        mimic = new['joint_2_cover'].find('mimic')
        assert mimic is not None
        # Half the true angle of joint 2, backwards; what joint 2 reports lacks the offset.
        expected = 0.1 - 0.5 * np.radians(offset)
        assert float(mimic.attrib['offset']) == pytest.approx(expected, abs=1e-12)
