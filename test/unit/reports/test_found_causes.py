# SPDX-License-Identifier: Apache-2.0
"""Causes and look-alikes of an earlier search, as plans and decisions take them."""

import json

import pytest
from worlds.discovery_files import discovery_content, effect, look_alike

from remaster_ros.discovery.decision import Named
from remaster_ros.errors import InputError
from remaster_ros.reports.found_causes import earlier_pairs, read_causes


def written(folder, *look_alikes, **more):
    session = {
        'optimization': {'observations': 1, 'configurations': 1, 'poses': 1},
        'validation': {'observations': 0, 'configurations': 0, 'poses': 0},
        'sensors': {'mocap': 'sir'}, 'created': '2026-01-01', 'exit_status': 'complete',
        'observations_sha256': 'ab',
    }  # fmt: skip
    cause = effect(confusable_with=list(look_alikes))
    path = folder / 'discovery.json'
    content = discovery_content(cause, session=session, **more)
    path.write_text(json.dumps(content), encoding='utf-8')
    return path


def test_what_nothing_separates_is_left_out(tmp_path):
    path = written(
        tmp_path,
        look_alike('base_compliance'),
        look_alike('link_length', (3,), same=True),
        look_alike('joint_error_curve', (2,), general=True),
    )
    (cause,) = read_causes(path, observations_sha256='ab')
    assert cause.look_alikes == (('base_compliance', (), 'poses'),)
    assert cause.driver == 'gravity_torque'
    assert earlier_pairs(path) == (
        (Named('joint_compliance', (2,)), Named('base_compliance', ())),
    )
    with pytest.raises(InputError, match='nothing to separate'):
        read_causes(written(tmp_path, look_alike('link_length', (3,), same=True)))


def test_a_search_of_other_observations_or_of_another_session_does_not_count(tmp_path):
    path = written(tmp_path, look_alike('base_compliance'))
    with pytest.raises(InputError, match='not of the observations that the session has now'):
        read_causes(path, observations_sha256='cd')
    assert len(earlier_pairs(path, created='2026-01-01')) == 1
    assert earlier_pairs(path, created='2026-02-01') == ()


def test_a_search_of_another_arm_is_refused(tmp_path):
    robot = {
        'name': 'arm', 'urdf_sha256': 'cd', 'joint_names': ['a', 'b'], 'base_link': 'base',
        'tip_link': 'tip',
    }  # fmt: skip
    path = written(tmp_path, look_alike('base_compliance'), robot=robot)
    for read in (read_causes, earlier_pairs):
        assert len(read(path, ('a', 'b'))) == 1
        with pytest.raises(InputError, match='joints a, b, this one has a, b, c; give'):
            read(path, ('a', 'b', 'c'))


def test_what_was_decided_is_looked_at_again(tmp_path):
    decided = {
        'cause': {'name': 'backlash', 'joints': [4]},
        'look_alike': {'name': 'settling', 'joints': [4]},
        'answer': 'open', 'log_evidence': None, 'sigma': 0.0, 'sentence': 'still open',
    }  # fmt: skip
    path = written(tmp_path, look_alike('base_compliance'), decided=[decided])
    assert earlier_pairs(path) == (
        (Named('backlash', (4,)), Named('settling', (4,))),
        (Named('joint_compliance', (2,)), Named('base_compliance', ())),
    )
