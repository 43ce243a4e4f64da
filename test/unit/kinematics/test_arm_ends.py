"""The ends of an arm are found in descriptions as their makers ship them."""

from __future__ import annotations

import pytest
from robot_descriptions import ROBOTS, Joint, arm, document, link, xarm7

from remaster_ros.errors import InputError
from remaster_ros.kinematics.arm_ends import likely_base, likely_tips
from remaster_ros.kinematics.urdf import parse_urdf


@pytest.mark.parametrize(
    ('robot', 'base', 'tips'),
    [
        ('ur5e', 'base_link', ['tool0', 'flange', 'ft_frame', 'wrist_3_link']),
        ('irb120', 'base_link', ['tool0', 'flange', 'link_6']),
        ('panda', 'panda_link0', ['panda_hand', 'panda_link7_sc', 'panda_link8', 'panda_link7']),
        ('iiwa14', 'lbr_link_0', ['lbr_link_ee', 'lbr_link_7']),
    ],
)
def test_the_ends_of_known_arms(robot, base, tips):
    model = parse_urdf(ROBOTS[robot]().urdf)
    assert likely_base(model) == base
    found = likely_tips(model, base)
    assert found[0] == tips[0]
    assert set(found) == set(tips)


def test_a_base_without_an_arm_is_refused():
    model = parse_urdf(xarm7().urdf)
    with pytest.raises(InputError, match="there is no link 'nowhere'; it has link_base, link1"):
        likely_tips(model, 'nowhere')
    with pytest.raises(InputError, match="no joint turns behind link 'link_eef'"):
        likely_tips(model, 'link_eef')


def test_two_arms_are_asked_for():
    arms = []
    for side in ('left', 'right'):
        links = ['base_link', f'{side}_1', f'{side}_2']
        joints = [
            Joint(f'{name}_joint', (0, 0, 1), (0, 0, 0), (0, 1, 0), -1, 1) for name in links[1:]
        ]
        arms += [*map(link, links[1:]), arm(joints, links)]
    model = parse_urdf(document('two_arms', link('base_link'), *arms))
    with pytest.raises(InputError, match=r'several arms of 2 joints .*; name the tip link'):
        likely_tips(model, 'base_link')
