# SPDX-License-Identifier: Apache-2.0
"""Every reader of files, on spoilt files: it reads them or raises `InputError`, nothing else."""

import logging
import random
import shutil
from pathlib import Path

import pytest
from hostile.files import check_read, read_urdf, spoil_and_read

from remaster_ros.errors import InputError
from remaster_ros.kinematics.urdf import MOST_LINKS, parse_urdf
from remaster_ros.reports.fit_json import fit_content, joint_offsets_of, read_fit
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.json_records import encoded
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.session.strict_yaml import YamlError, load_yaml

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


@pytest.mark.parametrize(
    'name',
    [
        'session/session.yaml',
        'session/observations.csv',
        'session/robot.urdf',
        'robots/lwr4plus.urdf',
        'cells/demo.yaml',
        'fit.json',
    ],
)
def test_a_spoilt_file_is_read_or_refused(session, fit_result, tmp_path, rng, name):
    folder = tmp_path / 'session'
    write_session(folder, session)
    for part in ('robots', 'cells'):
        shutil.copytree(CONFIG / part, tmp_path / part)
    path, fit = tmp_path / name, tmp_path / 'fit.json'
    fit.write_bytes(encoded(fit_content(fit_result)))
    readers = {
        'session': lambda: read_session(folder),
        'robots': lambda: read_urdf(path),
        'cells': lambda: read_cell(path),
        'fit.json': lambda: joint_offsets_of(read_fit(fit), fit_result.chain),
    }
    taken, refused = spoil_and_read(path, readers[name.partition('/')[0]], rng, TIMES)
    assert refused > TIMES // 10
    assert taken > 0


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
        ('[' * 20_000, 'nested too deep'),
        ('{a: ' * 20_000, 'nested too deep'),
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
        ('<robot>' + '<a>' * 50_000, 'XML'),
        ('<a>' * 50_000 + '</a>' * 50_000, 'URDF'),
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
    """Each link's way to the root must not be walked anew, before it is refused."""
    count = MOST_LINKS
    links = [f'<link name="l{i}"/>' for i in range(count)]
    joints = [joint(i, f'l{i}', f'l{i + 1}') for i in range(count - 1)]
    assert not check_read(lambda: parse_urdf(urdf_of(links, joints)))


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
