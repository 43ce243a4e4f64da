# SPDX-License-Identifier: Apache-2.0
"""The ends of an arm are found in descriptions as their makers ship them."""

from __future__ import annotations

import pytest
from worlds.robot_descriptions import ROBOTS, Joint, arm, document, link, xarm7

from remaster_ros.errors import InputError
from remaster_ros.kinematics.arm_ends import likely_base, likely_tip, likely_tips, moving_before
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
    with pytest.raises(InputError, match="no joint moves behind link 'link_eef'"):
        likely_tips(model, 'link_eef')


def two_arms():
    arms = []
    for side in ('left', 'right'):
        links = ['base_link', f'{side}_1', f'{side}_2']
        joints = [
            Joint(f'{name}_joint', (0, 0, 1), (0, 0, 0), (0, 1, 0), -1, 1) for name in links[1:]
        ]
        arms += [*map(link, links[1:]), arm(joints, links)]
    return parse_urdf(document('two_arms', link('base_link'), *arms))


def test_two_arms_are_asked_for():
    message = r'several arms of 2 joints .*; name the tip link, --tip-link left_2 or right_2$'
    with pytest.raises(InputError, match=message):
        likely_tips(two_arms(), 'base_link')


@pytest.mark.parametrize('side', ['left', 'right'])
def test_of_two_arms_it_is_the_one_whose_joints_are_named(side):
    names = {'time', f'{side}_1_joint', f'{side}_2_joint'}
    assert likely_tips(two_arms(), 'base_link', names) == [f'{side}_2']


def moving(name, parent, child, kind='revolute'):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )


def tree(*joints):
    """Return the model of (joint, parent, child, kind) each."""
    links = dict.fromkeys(name for joint in joints for name in joint[1:3])
    return parse_urdf(document('tree', *map(link, links), *(moving(*joint) for joint in joints)))


FIVE = [(f'j{i}', f'l{i}', f'l{i + 1}') for i in range(5)]


@pytest.mark.parametrize(
    'gripper',
    [
        [('gripper', 'l5', 'moving_jaw')],
        [('left_finger_joint', 'l5', 'a'), ('right_finger_joint', 'l5', 'b')],
        # A hand whose joints are not named so: it branches.
        [('x1', 'l5', 'a1'), ('x2', 'a1', 'a2'), ('y1', 'l5', 'b1'), ('y2', 'b1', 'b2')],
        [('drive_joint', 'l5', 'outer_knuckle')],
    ],
)
def test_the_jaws_of_a_gripper_are_no_joints_of_the_arm(gripper):
    model = tree(*FIVE, *gripper, ('at', 'l5', 'tcp', 'fixed'))
    assert likely_base(model) == 'l0'
    assert set(likely_tips(model, 'l0')) == {'l5', 'tcp'}
    assert likely_tip(model, 'l0') == 'tcp'


def test_a_joint_that_turns_the_whole_gripper_is_one_of_the_arm():
    model = tree(*FIVE, ('gripper_roll', 'l5', 'gripper_base'), ('jaw', 'gripper_base', 'jaw'))
    assert likely_tips(model, 'l0') == ['gripper_base']


def test_the_arm_on_a_lift_of_a_mobile_base_starts_behind_the_lift():
    model = tree(
        ('wheel_left', 'base_footprint', 'wl', 'continuous'),
        ('wheel_right', 'base_footprint', 'wr', 'continuous'),
        ('lift', 'base_footprint', 'torso', 'prismatic'),
        ('pan', 'torso', 'head'),
        ('mount', 'torso', 'l0', 'fixed'),
        *FIVE,
        ('finger', 'l5', 'f', 'prismatic'),
    )
    assert likely_base(model) == 'torso'
    assert likely_tips(model, 'torso') == ['l5']
    assert moving_before(model, 'torso') == ['lift']


SCARA = (
    ('j1', 'base', 'l1'),
    ('j2', 'l1', 'l2'),
    ('j3', 'l2', 'l3', 'prismatic'),
    ('j4', 'l3', 'tool0'),
)


def test_an_arm_that_slides_in_its_midst_goes_on_behind_it():
    model = tree(*SCARA)
    assert likely_base(model) == 'base'
    assert likely_tip(model, 'base') == 'tool0'
    assert likely_tip(model, 'base', ('j1', 'j2', 'j3', 'j4')) == 'tool0'
    # A table that names the others only is of something else.
    with pytest.raises(InputError, match=r"joint 'j3' of the arm slides, .* with 'j4'"):
        likely_tip(model, likely_base(model), ('j1', 'j2'))


def test_a_rail_is_of_the_arm_where_what_it_carries_is_none_or_a_base_says_so():
    gantry = (('x', 'hall', 'a', 'prismatic'), ('y', 'a', 'b', 'prismatic'), ('c', 'b', 'tool0'))
    assert likely_base(tree(*gantry)) == 'hall'
    assert likely_tips(tree(*gantry), 'hall') == ['tool0']
    on_rail = tree(('rail', 'hall', 'l0', 'prismatic'), *FIVE)
    assert likely_base(on_rail) == 'l0'
    assert likely_tips(on_rail, 'hall') == ['l5']
    # What slides behind a whole arm is its tool's.
    pusher = tree(*FIVE, ('push', 'l5', 'plunger', 'prismatic'))
    assert likely_tips(pusher, 'l0') == ['l5']


def seven_joints(extra):
    """Return an arm of seven joints, and what else moves on it: (parent, child) of each."""
    links = ['base_link', *(f'link_{i}' for i in range(1, 8))]
    names = [f'joint_{i}' for i in range(1, 8)]
    joints = [Joint(name, (0, 0, 1), (0, 0, 0), (0, 0, 0.2), -2, 2) for name in names]
    branches = [
        part
        for parent, child in extra
        for part in (
            link(child),
            arm(
                [Joint(f'{child}_joint', (0, 0, 1), (0, 0, 0), (0.1, 0, 0), -1, 1)],
                [parent, child],
            ),
        )
    ]
    return parse_urdf(document('seven', *map(link, links), arm(joints, links), *branches))


@pytest.mark.parametrize(
    'extra',
    [
        [('link_6', 'camera')],
        [('link_6', 'pan'), ('pan', 'tilt')],
        [('link_7', 'changer')],
        [('link_5', 'pan'), ('pan', 'tilt'), ('tilt', 'zoom')],
    ],
)
def test_seven_joints_that_are_named_decide_the_tip_against_a_branch(extra):
    model = seven_joints(extra)
    names = {'time', *(f'joint_{i}' for i in range(1, 8))}
    assert likely_tip(model, likely_base(model, names), names) == 'link_7'
