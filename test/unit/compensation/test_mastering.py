# SPDX-License-Identifier: Apache-2.0
"""Where a joint is driven to and what is set there: within its limits, in the pad's digits."""

import numpy as np
import pytest
from worlds.robot_descriptions import ROBOTS

from remaster_ros.compensation.mastering import mastering
from remaster_ros.kinematics.pad_angles import PadAngles
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import Controller, PadJoint


@pytest.fixture
def panda():
    description = ROBOTS['panda']()
    return SerialChain.from_urdf(description.urdf, description.base_link, description.tip_link)


def test_a_joint_that_cannot_reach_zero_is_set_where_it_can_be(panda):
    """Joint 4 of a Panda is at least 4 degrees from its zero; the others are set there."""
    offsets = np.radians([0.3, -0.2, 0.1, 0.4, -0.1, 0.2, 0.3])
    k = len(panda)
    groups = mastering(None, panda, offsets, np.full(k, 1e-5), np.ones(k, bool))
    assert [len(group) for group in groups] == [1] * k
    steps = [group[0] for group in groups]
    for step, offset, lower, upper in zip(
        steps, np.degrees(offsets), panda.lower, panda.upper, strict=True
    ):
        assert np.degrees(lower) <= step.drive_to <= np.degrees(upper)
        assert step.set_to - step.drive_to == pytest.approx(offset, abs=1e-9)
    assert [step.set_to == 0.0 for step in steps] == [
        low < -0.01 and high > 0.01 for low, high in zip(panda.lower, panda.upper)
    ]
    assert not all(step.set_to == 0.0 for step in steps)
    # Nobody is told to drive such a joint to its zero.
    assert [step.zero_in_reach for step in steps] == [step.set_to == 0.0 for step in steps]


def test_a_zero_of_the_pad_that_is_within_the_limits_may_be_driven_to(panda):
    pads = {name: PadJoint(name) for name in panda.joint_names}
    pads[panda.joint_names[1]] = PadJoint('A2', zero_deg=90.0)
    pads[panda.joint_names[4]] = PadJoint('A5', zero_deg=179.0)
    k = len(panda)
    groups = mastering(
        Controller(pads), panda, np.full(k, 0.01), np.full(k, 1e-5), np.ones(k, bool)
    )
    steps = {step.pad_name: step for group in groups for step in group}
    assert steps['A2'].set_to != 0.0
    assert steps['A2'].zero_in_reach
    assert not steps['A5'].zero_in_reach


@pytest.mark.parametrize('seed', range(20))
def test_any_coupling_is_set_in_an_order_in_which_no_zero_moves_another(panda, seed):
    """Of random signs, zeros, units and couplings, one joint added to any of those before it."""
    print(f'seed {seed}')
    rng = np.random.default_rng(seed)
    names, joints = rng.permutation(panda.joint_names).tolist(), {}
    for i, name in enumerate(names):
        added = {names[j]: int(rng.choice([-1, 1])) for j in range(i) if rng.random() < 0.3}
        unit = str(rng.choice(['deg', 'rad', 'gon']))
        joints[name] = PadJoint(
            f'P{name}', unit, int(rng.choice([-1, 1])), float(rng.integers(-180, 181)), added
        )
    controller = Controller({name: joints[name] for name in panda.joint_names})
    offsets = rng.normal(0.0, 0.01, len(panda))
    known = rng.random(len(panda)) < 0.7
    groups = mastering(controller, panda, offsets, np.full(len(panda), 1e-5), known)
    order = [step.joint for group in groups for step in group]
    assert len(set(order)) == len(order)
    change = dict.fromkeys(panda.joint_names, 0.0)
    per_rad = {'deg': 180 / np.pi, 'rad': 1.0, 'gon': 200 / np.pi}
    for group in groups:
        for i, step in enumerate(group):
            change[step.joint] = (step.set_to - step.drive_to) / per_rad[step.unit]
            later = [other.joint for other in group[i + 1 :]]
            assert not set(joints[step.joint].coupling) & set(later)
    # Joints that are set and coupled directly are in one group.
    of = {step.joint: n for n, group in enumerate(groups) for step in group}
    for name in order:
        assert all(of[name] == of[other] for other in joints[name].coupling if other in of)
    # The URDF's angles of any configuration change by the offsets, those of the others by nothing.
    pad = PadAngles.of(controller, panda.joint_names)
    shown = rng.uniform(-2.0, 2.0, len(panda))
    after = shown + [change[name] for name in panda.joint_names]
    np.testing.assert_allclose(
        pad.to_urdf(after) - pad.to_urdf(shown), np.where(known, offsets, 0.0), atol=2e-5
    )
