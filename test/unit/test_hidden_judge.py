# SPDX-License-Identifier: Apache-2.0
"""The judge of hidden causes: by hand-made discoveries, without any search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from judges.hidden_effects import judge, part_of
from worlds.hidden_tours import visits, world
from worlds.hidden_world import HiddenTruth, HiddenWorld, Noise

from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.hidden_effects import true_parameters

STEP = HiddenEffect('slipped_joint', (3,), np.array([1e-3]), {'moment_s': 500.0})
BENT = HiddenEffect(
    'range_distortion', (), np.array([0.01]), {'sensor': 'mocap', 'distance_m': 2.0}
)
SCALE = HiddenEffect('encoder_scale', (2,), np.array([1e-3]))


@pytest.fixture(scope='module')
def six() -> HiddenWorld:
    return world('six', np.random.default_rng(5), tour=visits('six', 0, 20))


def truth_of(six: HiddenWorld, *effects: HiddenEffect, noise: Noise | None = None) -> HiddenTruth:
    return six.measure(effects, noise or Noise(), np.random.default_rng(7))[1]


def claim(name: str, place: str, driver: str, joints: tuple[int, ...] = (), **more: Any) -> Any:
    parameters = [
        SimpleNamespace(name=key, value=value, std=abs(value) / 10) for key, value in more.items()
    ]
    return SimpleNamespace(
        name=name,
        place=place,
        driver=driver,
        joints=joints,
        parameters=parameters,
        confusable_with=(),
    )


def discovery(*effects: Any, unexplained: tuple[tuple[str, str], ...] = ()) -> Any:
    entries = [
        SimpleNamespace(where=where, driver=driver, next=f'Errors follow each other ({where}).')
        for where, driver in unexplained
    ]
    return SimpleNamespace(effects=effects, unexplained=entries)


def test_a_cell_without_a_name_is_found_by_whatever_is_at_its_place(six: HiddenWorld) -> None:
    truth = truth_of(six, STEP)
    for name in ('unnamed', 'joint_offset_step'):
        found = discovery(claim(name, 'joint_angle', 'time', (3,), step_3=1e-3))
        assert judge(six, truth, found).outcome == 'right'
    for wrong in (
        claim('unnamed', 'joint_angle', 'time', (4,), step_4=1e-3),
        claim('unnamed', 'joint_angle', 'temperature', (3,), step_3=1e-3),
        claim('encoder_scale', 'joint_angle', 'joint_angle', (3,), scale_3=1e-3),
    ):
        judgement = judge(six, truth, discovery(wrong))
        assert (judgement.outcome, judgement.named_right) == ('wrong', False)


def test_an_answer_counts_by_its_name_and_sensor(six: HiddenWorld) -> None:
    truth = truth_of(six, BENT)
    bent, scale = (
        claim(f'sensor_{name}', 'sensor_frame', 'position', (), **{f'{name}_mocap': 1e-3})
        for name in ('distortion', 'scale')
    )
    assert judge(six, truth, discovery(bent)).outcome == 'right'
    assert judge(six, truth, discovery(bent, scale)).outcome == 'wrong'
    elsewhere = claim('sensor_distortion', 'sensor_frame', 'position', (), radial_tracker=1e-3)
    assert judge(six, truth, discovery(elsewhere)).outcome == 'wrong'


@pytest.mark.parametrize(
    ('where', 'driver', 'outcome'),
    [
        ('residuals', 'time', 'unexplained'),
        ('sensor_frame', 'position', 'elsewhere'),
        ('held_out_poses', 'unknown', 'elsewhere'),
    ],
)
def test_unexplained_counts_at_the_right_place(
    six: HiddenWorld, where: str, driver: str, outcome: str
) -> None:
    found = discovery(unexplained=((where, driver),))
    assert judge(six, truth_of(six, STEP), found).outcome == outcome
    assert judge(six, truth_of(six, STEP), discovery()).outcome == 'none'


def test_a_wrong_name_beside_the_right_place_is_wrong(six: HiddenWorld) -> None:
    named = claim('encoder_scale', 'joint_angle', 'joint_angle', (3,), scale_3=1e-3)
    found = discovery(named, unexplained=(('residuals', 'time'),))
    assert judge(six, truth_of(six, STEP), found).outcome == 'wrong'


def test_one_of_two_is_partly_right_unless_the_other_place_is_told(six: HiddenWorld) -> None:
    truth = truth_of(six, STEP, SCALE)
    named = claim('encoder_scale', 'joint_angle', 'joint_angle', (2,), scale_2=1e-3)
    assert judge(six, truth, discovery(named)).outcome == 'partly'
    assert judge(six, truth, discovery(named, unexplained=(('residuals', 'time'),))).outcome == (
        'unexplained'
    )
    step = claim('unnamed', 'joint_angle', 'time', (3,), joint_3_by_time=1e-3)
    assert judge(six, truth, discovery(named, step)).outcome == 'right'


@pytest.mark.parametrize(
    ('noise', 'where'),
    [
        (Noise(memory=0.9), 'serial correlation'),
        (Noise(degrees_of_freedom=3.0), 'tails'),
        (Noise(mispaired_share=0.1), 'pairing'),
    ],
)
def test_readings_that_err_have_a_place_of_their_own(
    six: HiddenWorld, noise: Noise, where: str
) -> None:
    truth = truth_of(six, noise=noise)
    right = judge(six, truth, discovery(unexplained=((where, 'order'),)))
    assert right.outcome == 'unexplained'
    assert judge(six, truth, discovery(unexplained=(('position', ''),))).outcome == 'elsewhere'
    assert judge(six, truth, discovery()).outcome == 'none'
    named = claim('encoder_scale', 'joint_angle', 'joint_angle', (3,), scale_3=1e-3)
    assert judge(six, truth, discovery(named)).outcome == 'wrong'


def test_sizes_are_compared_by_the_names_of_the_kind(six: HiddenWorld) -> None:
    truth = truth_of(six, SCALE)
    near_claim, far = (
        claim('encoder_scale', 'joint_angle', 'joint_angle', (2,), scale_2=value)
        for value in (1.1e-3, 2e-3)
    )
    assert judge(six, truth, discovery(near_claim)).size_right is True
    assert judge(six, truth, discovery(far)).size_right is False


def test_the_moment_of_a_step_is_compared(six: HiddenWorld) -> None:
    truth = truth_of(six, STEP)
    for moment, right in ((505.0, True), (900.0, False)):
        step = claim('unnamed', 'joint_angle', 'time', (3,), joint_3_step=1e-3, moment=moment)
        step.parameters[1].std = 2.0
        judgement = judge(six, truth, discovery(step))
        assert judgement.outcome == 'right'
        assert judgement.size_right is right


def test_parts_undo_the_names_of_parameters() -> None:
    """Each parameter of an effect of several is that effect with its value alone."""
    waves = HiddenEffect('encoder_eccentricity', (4,), np.arange(1.0, 5.0), {'orders': (1, 2)})
    sag = HiddenEffect('joint_compliance', (2, 4), np.array([3e-5, 5e-5]))
    assert true_parameters(waves) == {'sin1_4': 1.0, 'cos1_4': 2.0, 'sin2_4': 3.0, 'cos2_4': 4.0}
    assert true_parameters(sag) == {'compliance_2': 3e-5, 'compliance_4': 5e-5}
    for effect in (waves, sag):
        for name in true_parameters(effect):
            part = part_of(name)
            assert part is not None
            assert true_parameters(part) == {name: 1.0}
    assert part_of('radial_sphere_mocap') is None
