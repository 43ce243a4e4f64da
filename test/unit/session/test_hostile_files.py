"""Every reader of files, on spoilt files: it reads them or raises `InputError`, nothing else."""

from __future__ import annotations

import logging
import random
import shutil
from pathlib import Path

import pytest
from hostile.files import check_read, read_urdf, spoil_and_read

from remaster_ros.errors import InputError
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.reports import schemas
from remaster_ros.reports.fit_json import fit_content, joint_offsets_rad, read_fit
from remaster_ros.session.bag import BagReader
from remaster_ros.session.bag_writer import BagWriter
from remaster_ros.session.reader import read_session, write_session
from remaster_ros.session.workcell import read_cell
from remaster_ros.session.yaml_records import YamlError, load_yaml

CONFIG = Path(__file__).parents[3] / 'config'
SEED = random.SystemRandom().randrange(10**6)
TIMES = 100


@pytest.fixture(autouse=True)
def quiet(caplog):
    caplog.set_level(logging.ERROR, 'remaster_ros')


@pytest.fixture
def rng():
    print(f'seed {SEED}')
    return random.Random(SEED)


@pytest.mark.parametrize('name', ['session.yaml', 'observations.csv', 'robot.urdf'])
def test_a_spoilt_session_is_read_or_refused(session, tmp_path, rng, name):
    folder = tmp_path / 'session'
    write_session(folder, session)
    taken, refused = spoil_and_read(folder / name, lambda: read_session(folder), rng, TIMES)
    assert refused > TIMES // 10
    assert taken > 0


def test_a_spoilt_urdf_is_read_or_refused(tmp_path, rng):
    path = tmp_path / 'robot.urdf'
    shutil.copy(CONFIG / 'robots' / 'lwr4plus.urdf', path)
    _taken, refused = spoil_and_read(path, lambda: read_urdf(path), rng, TIMES)
    assert refused > TIMES // 10


def test_a_spoilt_cell_is_read_or_refused(tmp_path, rng):
    shutil.copytree(CONFIG / 'robots', tmp_path / 'robots')
    (tmp_path / 'cells').mkdir()
    path = tmp_path / 'cells' / 'demo.yaml'
    shutil.copy(CONFIG / 'cells' / 'demo.yaml', path)
    _taken, refused = spoil_and_read(path, lambda: read_cell(path), rng, TIMES)
    assert refused > TIMES // 10


def test_a_spoilt_fit_is_read_or_refused(tmp_path, rng, fit_result):
    path = tmp_path / 'fit.json'
    path.write_bytes(schemas.encode(fit_content(fit_result)))

    def read():
        joint_offsets_rad(read_fit(path), fit_result.joint_names)

    _taken, refused = spoil_and_read(path, read, rng, TIMES)
    assert refused > TIMES // 10


def test_a_spoilt_bag_is_read_or_refused(tmp_path, rng):
    folder = tmp_path / 'bag'
    with BagWriter(folder) as bag:
        for number in range(20):
            bag.write('/remaster/status', 'diagnostic_msgs/msg/DiagnosticArray', bytes(60), number)
            bag.write('/joint_states', 'sensor_msgs/msg/JointState', bytes(200), number)
    (path,) = folder.glob('*.mcap')
    _taken, refused = spoil_and_read(path, lambda: list(BagReader(folder)), rng, TIMES)
    assert refused > TIMES // 10


BOMB = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{new}: &{new} [{", ".join(["*" + old] * 9)}]\n' for old, new in zip('abcdefgh', 'bcdefghi')
)


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        (BOMB, 'aliases'),
        ('a: &a\n  b: *a\n', 'aliases'),
        ('a: !!python/object/apply:os.system ["true"]', 'tags'),
        ('a: !!binary aGk=', 'tags'),
        ('a: !!float ""', 'tags'),
        ('a: 1\na: 2', 'twice'),
        ('[' * 100_000, 'nested too deep'),
        ('{a: ' * 100_000, 'nested too deep'),
        ('a: 1\n---\nb: 2', 'correct'),
        ('? [1, 2]\n: 3', 'correct'),
        ('a: \0', 'correct'),
        ('a: ' + '9' * 10_000, 'correct'),
    ],
)
def test_yaml_that_is_no_plain_data_is_refused(text, words):
    with pytest.raises(YamlError, match=words):
        load_yaml(text)


@pytest.mark.parametrize('name', ['session.yaml', 'demo.yaml'])
def test_a_yaml_bomb_stays_small(tmp_path, session, name):
    folder = tmp_path / 'session'
    write_session(folder, session)
    (folder / name).write_text('format: remaster-session/1\n' + BOMB)
    read = read_session if name == 'session.yaml' else read_cell
    path = folder if name == 'session.yaml' else folder / name
    assert not check_read(lambda: read(path), measure_memory=True)


def urdf_of(links, joints):
    return f'<robot name="r">{"".join(links)}{"".join(joints)}</robot>'


def joint(number, parent, child):
    return (
        f'<joint name="j{number}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{child}"/><limit lower="-1" upper="1"/></joint>'
    )


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>', 'DOCT'),
        ('<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot/>', 'DOCTYPE'),
        ('<robot>' + '<a>' * 200_000, 'XML'),
        ('<a>' * 200_000 + '</a>' * 200_000, 'URDF'),
        ('<robot name="\ud800"/>', 'XML'),
        ('<robot name="&b;"/>', 'XML'),
        ('', 'XML'),
    ],
)
def test_xml_that_is_no_robot_is_refused(text, words):
    def read():
        with pytest.raises(InputError, match=words):
            parse_urdf(text)

    check_read(read, measure_memory=True)


def test_a_long_chain_takes_no_longer_than_it_is():
    """Each link's way to the root must not be walked anew."""
    count = 20_000
    links = [f'<link name="l{i}"/>' for i in range(count)]
    joints = [joint(i, f'l{i}', f'l{i + 1}') for i in range(count - 1)]
    assert check_read(lambda: parse_urdf(urdf_of(links, joints)))


@pytest.mark.parametrize('value', ['.nan', '.inf', '-.inf'])
def test_a_cell_with_a_number_that_is_none_is_refused(tmp_path, value):
    shutil.copytree(CONFIG / 'robots', tmp_path / 'robots')
    (tmp_path / 'cells').mkdir()
    path = tmp_path / 'cells' / 'demo.yaml'
    text = (CONFIG / 'cells' / 'demo.yaml').read_text()
    path.write_text(text.replace('sir: [0.1,', f'sir: [{value},'))
    with pytest.raises(InputError, match=r'markers\.sir: -?(nan|inf) is not a finite'):
        read_cell(path)


def test_a_message_that_quotes_too_much_is_one_short_line():
    with pytest.raises(InputError) as caught:
        raise InputError('file: key ' + 'x\n' * 5000 + '; correct it')
    assert len(str(caught.value)) < 1010
    assert str(caught.value).startswith('file: key x x')
    assert str(caught.value).endswith('; correct it')


@pytest.mark.parametrize('number', ['1e308', '-1e7', 'inf', 'nan'])
def test_a_length_that_no_robot_has_is_refused(number):
    links = ['<link name="a"/>', '<link name="b"/>']
    text = urdf_of(links, [joint(1, 'a', 'b')]).replace(
        '<limit', f'<origin xyz="0 {number} 0"/><limit'
    )
    with pytest.raises(InputError, match=r"origin xyz of joint 'j1' is .*, not a finite number"):
        parse_urdf(text)


def test_an_axis_too_long_to_be_measured_is_refused():
    links = ['<link name="a"/>', '<link name="b"/>']
    text = urdf_of(links, [joint(1, 'a', 'b')]).replace(
        '<limit', '<axis xyz="1e200 1e200 0"/><limit'
    )
    with pytest.raises(InputError, match='axis'):
        parse_urdf(text)
