# SPDX-License-Identifier: Apache-2.0
"""A robot description against the arm of a cell: only what matters to motion is compared."""

import re

import pytest

from remaster_ros.kinematics.same_arm import difference
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import config_path

TEXT = config_path('robots/lwr4plus.urdf').read_text(encoding='utf-8')
CHAIN = SerialChain.from_urdf(TEXT, tip_link='tool')
GRIPPER = """
  <link name="hand"/><link name="finger"/>
  <joint name="hand_joint" type="fixed"><parent link="tool"/><child link="hand"/></joint>
  <joint name="finger_joint" type="prismatic"><parent link="hand"/><child link="finger"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="0.1" effort="1"/></joint>
</robot>"""


def with_gripper(text):
    return text.replace('</robot>', GRIPPER)


def on_a_table(text):
    """Another root, and the base renamed."""
    table = """
  <link name="world"/>
  <joint name="mount" type="fixed"><origin xyz="0 1 0.7" rpy="0 0 1.2"/>
    <parent link="world"/><child link="arm_base"/></joint>
</robot>"""
    return text.replace(f'"{CHAIN.base_link}"', '"arm_base"').replace('</robot>', table)


def with_rounded_numbers(text):
    """Five digits, as some exporters write them."""
    return re.sub(r'-?\d+\.\d{5,}', lambda m: f'{float(m.group()):.5f}', text)


def written_otherwise(text):
    text = re.sub(r'\s+', ' ', text).replace('> <', '>\n\n<')
    return text.replace('<robot ', '<!-- expanded by xacro --><robot ', 1)


def without_tool(text):
    """The driver's description ends at the flange."""
    text = re.sub(r'<joint name="[^"]*" type="fixed">(?:(?!</joint>).)*"tool"/>.*?</joint>', '',
                  text, flags=re.DOTALL)  # fmt: skip
    return re.sub(r'<link name="tool".*?(/>|</link>)', '', text, count=1, flags=re.DOTALL)


@pytest.mark.parametrize(
    'change',
    [str, with_gripper, on_a_table, with_rounded_numbers, written_otherwise, without_tool],
)
def test_a_description_of_the_same_arm(change):
    description = change(TEXT)
    assert change is str or description != TEXT
    assert difference(CHAIN, description) == ''


def changed(key, joint, new):
    """Return the description with an attribute of one joint replaced."""
    head, tail = TEXT.split(f'<joint name="{joint}"', 1)
    body, remainder = tail.split('</joint>', 1)
    body, count = re.subn(rf'{key}="([^"]*)"', f'{key}="{new}"', body, count=1)
    assert count
    return f'{head}<joint name="{joint}"{body}</joint>{remainder}'


J = CHAIN.joint_names


@pytest.mark.parametrize(
    ('description', 'why'),
    [
        (
            config_path('robots/iiwa7.urdf').read_text(encoding='utf-8'),
            'the axis of joint_2 is turned there by 180.00 deg',
        ),
        (changed('xyz', J[3], '0 0 0.2035'), f'the axis of {J[3]} lies 5.0 mm elsewhere'),
        # The zero of the last joint.
        (changed('xyz', J[6], r'\1" rpy="0 0 0.01'), 'tool lies elsewhere'),
        (
            TEXT.replace('<axis xyz="0 0 1"', '<axis xyz="0 0 -1"', 1),
            f'the axis of {J[0]} is turned',
        ),
        (changed('upper', J[1], '0.5'), f'{J[1]} may go from .* to 28.65 deg only'),
        (changed('velocity', J[6], '0.1'), f'{J[6]} may turn at 5.73 deg/s only'),
        (TEXT.replace(f'"{J[2]}"', '"elbow"'), f'it has no joint {J[2]}'),
        (TEXT.replace(f'"{J[2]}"', f'"{J[2]}_"'), f"{J[2]}; did you mean '{J[2]}_'"),
        ('<robot name="x"><link name="a"/></robot>', f'it has no joint {J[0]}, '),
        ('<robot', 'not well-formed'),
        ('', 'not well-formed'),
    ],
)
def test_a_description_of_another_arm(description, why):
    assert re.search(why, difference(CHAIN, description))


def test_a_cell_may_use_a_part_of_the_limits():
    low = SerialChain.from_urdf(changed('upper', J[1], '0.5'), tip_link='tool')
    assert difference(low, TEXT) == ''
