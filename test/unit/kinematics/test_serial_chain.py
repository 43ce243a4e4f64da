# SPDX-License-Identifier: Apache-2.0
"""The serial chain, judged by pinocchio (kinematics, gravity) and finite differences."""

import numpy as np
import pytest
from worlds.random_arm import random_arm_urdf

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply

SEEDS = range(5)
TIP_POINT = np.array([0.1, -0.02, 0.03])


def pinocchio_model(urdf):
    pin = pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')
    model = pin.buildModelFromXML(urdf)
    return pin, model, model.createData()


def random_chain(seed):
    rng = np.random.default_rng(seed)
    urdf = random_arm_urdf(rng)
    return rng, urdf, SerialChain.from_urdf(urdf, tip_link='tool')


@pytest.mark.parametrize('seed', SEEDS)
def test_frames_and_tool_pose_agree_with_pinocchio(seed):
    rng, urdf, chain = random_chain(seed)
    pin, model, data = pinocchio_model(urdf)
    for q in rng.uniform(-3, 3, (20, len(chain))):
        pin.framesForwardKinematics(model, data, q)
        tool = data.oMf[model.getFrameId('tool')].homogeneous
        np.testing.assert_allclose(chain.forward(q), tool, atol=1e-13)
        links = [data.oMf[model.getFrameId(f'link_{i}')].homogeneous for i in range(1, 7)]
        np.testing.assert_allclose(chain.frames(q), links, atol=1e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_gravity_torque_is_minus_pinocchios_holding_torque(seed):
    rng, urdf, chain = random_chain(seed)
    pin, model, data = pinocchio_model(urdf)
    gravity = rng.normal(0, 6, 3)
    model.gravity.linear = gravity
    q = rng.uniform(-3, 3, (20, len(chain)))
    holding = [pin.computeGeneralizedGravity(model, data, row).copy() for row in q]
    np.testing.assert_allclose(chain.gravity_torque(q, gravity), -np.array(holding), atol=1e-11)


def test_gravity_torque_is_positive_where_gravity_turns_the_joint_its_own_way():
    # A 2 kg pendulum along +X on an axis +Y: positive turns move it down.
    urdf = """<robot name="pendulum"><link name="base"/><link name="arm"><inertial>
        <origin xyz="0.5 0 0"/><mass value="2"/></inertial></link>
        <joint name="j" type="continuous"><parent link="base"/><child link="arm"/>
        <axis xyz="0 1 0"/></joint></robot>"""
    chain = SerialChain.from_urdf(urdf)
    assert chain.has_inertials
    np.testing.assert_allclose(chain.gravity_torque([0.0]), [2 * 9.81 * 0.5])
    assert chain.forward([0.1])[2, 3] == 0.0
    assert chain.positions([0.1], [0.5, 0, 0])[2] < 0.0


@pytest.mark.parametrize('seed', SEEDS)
def test_positions_broadcast_offsets_over_configurations(seed):
    rng, _, chain = random_chain(seed)
    q = rng.uniform(-3, 3, (7, len(chain)))
    offsets = rng.normal(0, 0.1, (4, 1, len(chain)))
    fast = chain.positions(q, TIP_POINT, offsets)
    assert fast.shape == (4, 7, 3)
    np.testing.assert_allclose(fast, apply(chain.forward(q + offsets), TIP_POINT), atol=1e-13)
    np.testing.assert_allclose(chain.frames(q, offsets), chain.frames(q + offsets), atol=1e-13)
    many_points = rng.normal(size=(4, 7, 3))
    np.testing.assert_allclose(
        chain.positions(q, many_points, offsets),
        apply(chain.forward(q + offsets), many_points),
        atol=1e-13,
    )
    last = len(chain) - 1
    turns = {0: rng.normal(0, 0.1, 7), last: rng.normal(0, 0.1, (4, 7))}
    angles = q + offsets
    angles[..., 0] += turns[0]
    angles[..., last] += turns[last]
    expected = apply(chain.forward(angles), many_points)
    given = many_points.copy()
    turned = chain.positions(q, given, offsets, turns)
    np.testing.assert_allclose(turned, expected, atol=1e-13)
    np.testing.assert_array_equal(given, many_points)
    for point in (TIP_POINT, TIP_POINT.tolist()):
        np.testing.assert_allclose(
            chain.positions(q, point, turns=turns),
            chain.positions(angles - offsets, point),
            atol=1e-13,
        )


@pytest.mark.parametrize('seed', SEEDS)
def test_jacobian_agrees_with_central_differences(seed):
    rng, _, chain = random_chain(seed)
    q, offsets = rng.uniform(-3, 3, (2, 5, len(chain)))
    points = rng.normal(0, 0.2, (5, 3))
    step = 1e-6
    columns = [
        (
            chain.positions(q + step * unit, points, offsets)
            - chain.positions(q - step * unit, points, offsets)
        )
        / (2 * step)
        for unit in np.eye(len(chain))
    ]
    jacobian = chain.position_jacobian(q, points, offsets)
    assert jacobian.shape == (5, 3, len(chain))
    np.testing.assert_allclose(jacobian, np.stack(columns, axis=-1), atol=1e-8)


@pytest.mark.parametrize('axis', ['0 0 1', '0 0 -1', '0 -2 0', '-1 0 0'])
def test_positions_for_axes_along_the_coordinate_axes(axis):
    urdf = f"""<robot name="one"><link name="a"/><link name="b"/>
        <joint name="j" type="continuous"><parent link="a"/><child link="b"/>
        <origin xyz="0.1 0.2 0.3"/><axis xyz="{axis}"/></joint></robot>"""
    chain = SerialChain.from_urdf(urdf)
    q = np.array([[0.7]])
    np.testing.assert_allclose(
        chain.positions(q, TIP_POINT), apply(chain.forward(q), TIP_POINT), atol=1e-15
    )


def test_a_part_of_the_arm_can_be_the_chain():
    urdf = random_arm_urdf(np.random.default_rng(3))
    full_chain = SerialChain.from_urdf(urdf, 'base_link', 'tool')
    part = SerialChain.from_urdf(urdf, 'link_2', 'link_5')
    assert part.joint_names == ('joint_3', 'joint_4', 'joint_5')
    q = np.linspace(-1, 1, 6)
    frames = full_chain.frames(q)
    np.testing.assert_allclose(frames[1] @ part.forward(q[2:5]), frames[4], atol=1e-13)


def test_limits():
    chain = random_chain(0)[2]
    assert list(chain.within_limits([[3.0] * 6, [3.001] + [0] * 5])) == [True, False]
    assert chain.within_limits([3.001] + [0] * 5, tolerance=0.01)
    np.testing.assert_array_equal(chain.velocity_limits, 2.0)


def test_wrong_number_of_joints_is_refused():
    with pytest.raises(ValueError, match='last size must be 6'):
        random_chain(0)[2].forward(np.zeros((4, 7)))


def arm(joint='', limit='<limit lower="-1" upper="1" velocity="1"/>', kind='revolute', more=''):
    return f"""<robot name="r"><link name="base_link"/><link name="link_1"/><link name="tool"/>
        <joint name="joint_1" type="{kind}"><parent link="base_link"/><child link="link_1"/>
        {limit}{joint}</joint>
        <joint name="tool_joint" type="fixed"><parent link="link_1"/><child link="tool"/></joint>
        {more}</robot>"""


def fixed(name, parent, child, link=''):
    """Return a fixed joint, behind its child where that is new."""
    return (
        f'{link}<joint name="{name}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/></joint>'
    )


def test_a_robot_without_masses_says_so():
    chain = SerialChain.from_urdf(arm())
    assert not chain.has_inertials
    np.testing.assert_array_equal(chain.gravity_torque([0.3]), [0.0])
    assert (chain.base_link, chain.tip_link, chain.joint_names) == (
        'base_link',
        'tool',
        ('joint_1',),
    )


def test_unknown_velocity_and_continuous_limits_are_infinite():
    chain = SerialChain.from_urdf(arm(kind='continuous', limit=''))
    assert (chain.lower[0], chain.upper[0], chain.velocity_limits[0]) == (-np.inf, np.inf, np.inf)


def test_a_fixed_joint_has_no_axis_and_an_expanded_xacro_may_say_where_it_is_from():
    text = arm(
        more='<link name="flange"/><joint name="j" type="fixed"><parent link="tool"/>'
        '<child link="flange"/><axis xyz="0 0 0"/></joint>'
    ).replace('<robot', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    assert SerialChain.from_urdf(text).tip_link == 'flange'


LOOP = '<link name="b"/><link name="c"/>' + fixed('j', 'b', 'c') + fixed('k', 'c', 'b')
HEAVY = '<link name="x"><inertial><mass value="-1"/></inertial></link>'
BAD = {
    'planar': (arm(kind='planar'), "'joint_1' is planar"),
    'mimic': (arm(joint='<mimic joint="x"/>'), "'joint_1' mimics"),
    'no limit': (arm(limit=''), "'joint_1' has no position limits"),
    'reversed limits': (arm(limit='<limit lower="1" upper="-1"/>'), "'joint_1' has limits 1"),
    'negative velocity': (
        arm(limit='<limit lower="-1" upper="1" velocity="-1"/>'),
        "velocity limit of joint 'joint_1' is negative",
    ),
    'zero axis': (arm(joint='<axis xyz="0 0 0"/>'), "axis of joint 'joint_1' has length 0"),
    'two numbers': (arm(joint='<axis xyz="0 0"/>'), "axis of joint 'joint_1' is '0 0'"),
    'no number': (arm(joint='<origin xyz="0 0 a"/>'), "xyz of joint 'joint_1' is 'a'"),
    'nan': (arm(joint='<origin rpy="0 0 nan"/>'), "rpy of joint 'joint_1' is 'nan'"),
    'xacro': (arm(joint='<origin xyz="0 0 ${d}"/>'), 'run xacro on the file first'),
    'xacro macros': (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m" params="p">'
        '<link name="${p}a"/></xacro:macro><xacro:m p=""/></robot>',
        'this is xacro, from which',
    ),
    'xacro without namespace': ('<robot><xacro:include filename="x"/></robot>', 'this is xacro'),
    'mimic factor': (
        arm(joint='<mimic joint="x" multiplier="two"/>'),
        "multiplier of joint 'joint_1' is 'two'",
    ),
    'soft limit': (
        arm(joint='<safety_controller soft_lower_limit="low"/>'),
        "soft_lower_limit of joint 'joint_1' is 'low'",
    ),
    'malformed': ('<robot><link', 'not well-formed XML'),
    'empty': ('', 'not well-formed XML'),
    'other XML': ('<sdf/>', 'outermost element is <sdf>'),
    'doctype': ('<!DOCTYPE robot [<!ENTITY a "b">]>' + arm(), 'declares a DOCTYPE'),
    'missing child': (arm(more=fixed('j', 'tool', 'x')), "joint 'j' names link 'x'"),
    'no parent': (arm(more='<joint name="j" type="fixed"/>'), "joint 'j' has no <parent>"),
    'no type': (
        arm(more='<joint name="j"><parent link="tool"/><child link="link_1"/></joint>'),
        "joint 'j' has no attribute 'type'",
    ),
    'two parents': (
        arm(more=fixed('j', 'tool', 'link_1')),
        "link 'link_1' hangs on two joints, 'joint_1' and 'j'",
    ),
    'loop': (f'<robot name="r"><link name="a"/>{LOOP}</robot>', "link 'b' is part of a loop"),
    'no root': (f'<robot name="r">{LOOP}</robot>', 'found none, the links form a loop'),
    'two roots': (arm(more='<link name="loose"/>'), 'found base_link, loose'),
    'link twice': (arm(more='<link name="tool"/>'), "two links are named 'tool'"),
    'joint twice': (
        arm(more=fixed('joint_1', 'tool', 'x', '<link name="x"/>')),
        "two joints are named 'joint_1'",
    ),
    'two ends': (
        arm(more=fixed('j', 'link_1', 'x', '<link name="x"/>')),
        'several ends (tool, x)',
    ),
    'no mass': (
        arm(more=fixed('j', 'tool', 'x', '<link name="x"><inertial/></link>')),
        "link 'x' has <inertial> without <mass>",
    ),
    'negative mass': (arm(more=fixed('j', 'tool', 'x', HEAVY)), "mass of link 'x' is -1.0 kg"),
}


@pytest.mark.parametrize('case', BAD)
def test_bad_urdf_is_refused_with_one_line_that_names_the_culprit(case):
    urdf, message = BAD[case]
    with pytest.raises(InputError) as error:
        SerialChain.from_urdf(urdf)
    assert message in str(error.value)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('base', 'tip', 'message'),
    [
        ('world', 'tool', "no link 'world'; it has base_link, link_1, tool"),
        ('base_link', 'hand', "no link 'hand'"),
        ('tool', 'base_link', "'base_link' does not hang on link 'tool'"),
        ('link_1', 'tool', 'no joint moves'),
    ],
)
def test_links_that_make_no_chain_are_refused(base, tip, message):
    with pytest.raises(InputError, match=message):
        SerialChain.from_urdf(arm(), base, tip)


def test_offsets_built_in_are_offsets_added():
    """Frames of reported angles where the true ones are; limits where the true stops are."""
    rng, _, chain = random_chain(5)
    q, offsets = rng.uniform(-3, 3, (4, len(chain))), rng.normal(0, 0.3, len(chain))
    arm = chain.with_offsets(offsets)
    np.testing.assert_allclose(arm.frames(q), chain.frames(q, offsets), atol=1e-12)
    np.testing.assert_allclose(arm.forward(q), chain.forward(q, offsets), atol=1e-12)
    np.testing.assert_allclose(arm.lower + offsets, chain.lower)
    np.testing.assert_allclose(arm.upper + offsets, chain.upper)
    assert arm.joint_names == chain.joint_names
