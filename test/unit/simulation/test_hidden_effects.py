# SPDX-License-Identifier: Apache-2.0
"""Effects hidden in the fakes: over time in a World, on a stage, and as they are asked for."""

import json

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN, random_poses

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import transform
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.yaml_records import from_plain, to_plain
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.chain_arm import ChainArm
from remaster_ros.simulation.effect_sampling import RANDOM, EffectSpec, hide
from remaster_ros.simulation.hidden_arm import TrueArm
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.hidden_effects import NAMED, UNNAMED
from remaster_ros.simulation.setup import make_world
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor, Warming
from remaster_ros.simulation.world import World
from remaster_ros.simulation.world_model import Round, WorldModel

SEED = 5
WARMING = Warming(5.0, 100.0, 0.0)


@pytest.fixture(scope='module')
def stage():
    """An LWR 4+ before a sensor, on a round of 12 poses."""
    rng = np.random.default_rng(SEED)
    q = np.concatenate(random_poses(12, rng))
    time_s = 12.0 * np.arange(1, len(q) + 1)
    sensor = SimulatedSensor('sir', transform(np.eye(3), (0.1, 0.2, -2.0)))
    return WorldModel(
        ChainArm(CHAIN),
        Round(q, np.full(7, 0.1), time_s, WARMING.at(time_s)),
        {'mocap': sensor},
        {'sir': np.array([0.1, 0.0, 0.02])},
        0.005 * rng.standard_normal(7),
    )


@pytest.mark.parametrize('kind', [*NAMED, *UNNAMED])
def test_over_time_the_arm_errs_as_on_the_stage(stage, kind):
    """Where each motion has ended, the sensor sees what it sees on a stage."""
    print(f'seed {SEED}')
    effects = hide(stage, [EffectSpec(kind, size_m=0.5e-3)], np.random.default_rng(SEED))
    truth = SessionTruth(stage.joint_offsets, stage.markers, stage.sensors, WARMING, effects)
    arm = TrueArm(CHAIN, truth, 0.0, stage.visited.home)
    expected = stage.seen(effects)
    here = stage.visited.home
    for i, (time_s, q) in enumerate(zip(stage.visited.time_s, stage.visited.q)):
        arm.move(time_s - 5.0, here, time_s, q)
        here = q
        found = arm.marker_in_sensor('mocap', time_s + 1.0, q)
        # What follows the temperature goes on while the arm stands.
        atol = 1e-5 if kind == 'lagging_growth' else 1e-9
        np.testing.assert_allclose(found, expected[i], rtol=0, atol=atol)
    assert np.max(np.abs(expected - stage.seen())) > 0.2e-3


def test_while_it_moves_the_error_passes_over(stage):
    scale = HiddenEffect('encoder_scale', (2,), np.array([1e-3]))
    start, end = np.zeros(7), np.full(7, 1.0)
    truth = SessionTruth(np.zeros(7), stage.markers, stage.sensors, WARMING, (scale,))
    arm = TrueArm(CHAIN, truth, 0.0, start)
    arm.move(10.0, start, 20.0, end)
    angles = [arm.deviation(t).angle[0, 1] for t in (0.0, 10.0, 12.0, 15.0, 18.0, 20.0, 99.0)]
    assert angles[0] == angles[1] == 0.0
    assert np.all(np.diff(angles[1:6]) > 0.0)
    assert angles[3] == pytest.approx(0.5e-3)
    assert angles[5] == angles[6] == pytest.approx(1e-3)


def test_an_effect_survives_its_file(stage):
    for kind in (*NAMED, *UNNAMED):
        (effect,) = hide(stage, [EffectSpec(kind)], np.random.default_rng(SEED))
        again = from_plain(json.loads(json.dumps(to_plain(effect))), HiddenEffect)
        np.testing.assert_array_equal(stage.seen([again]), stage.seen([effect]))


def test_it_has_the_joint_and_the_size_asked_for(stage):
    (effect,) = hide(stage, [EffectSpec.parse('backlash@4:0.3')], np.random.default_rng(SEED))
    assert (effect.kind, effect.joints) == ('backlash', (4,))
    assert stage.size_m(effect) == pytest.approx(0.3e-3)


def test_random_draws_all_of_those_with_a_name(stage):
    rng = np.random.default_rng(SEED)
    drawn = {hide(stage, [EffectSpec(RANDOM)], rng)[0].kind for _ in range(120)}
    # Each of the sixteen is missed in 120 draws with a probability of 4e-4.
    assert drawn == set(NAMED)


@pytest.mark.parametrize(
    'text', ['nonsense', 'backlash@', 'backlash:', 'backlash@0', 'backlash:0', 'backlash@2:-1', '']
)
def test_what_cannot_be_hidden_is_refused(text):
    with pytest.raises(InputError, match=r'NAME|joints count'):
        EffectSpec.parse(text)


def test_a_guide_is_hidden_only_where_a_joint_slides(stage):
    with pytest.raises(InputError, match='crooked_guide: no joint of this arm slides'):
        hide(stage, [EffectSpec.parse('crooked_guide')], np.random.default_rng(SEED))


def test_a_joint_that_cannot_show_it_is_refused(stage):
    with pytest.raises(InputError, match='backlash@9: the arm has 7 joints; give 1 to 7'):
        hide(stage, [EffectSpec.parse('backlash@9')], np.random.default_rng(SEED))


def test_a_world_keeps_what_is_hidden_in_it(tmp_path):
    """Another process that opens the World sees the same, and the reported angles are right."""
    requests = [EffectSpec.parse('joint_compliance:0.4'), EffectSpec.parse('sensor_scale')]
    cell = read_cell('demo')
    made = make_world(tmp_path, cell, SEED, 20.0, requests)
    plain = make_world(tmp_path / 'plain', cell, SEED, 20.0)
    opened = World.open(tmp_path)
    assert [effect.kind for effect in opened.truth.effects] == [r.kind for r in requests]
    end = made.start_q + 0.2
    for world in (made, plain):
        world.begin_motion(101.0, [ServoPoint(2.0, end, np.zeros(7))])
    for sensor in made.truth.sensors:
        seen = made.marker_in_sensor(sensor, 110.0)
        np.testing.assert_array_equal(opened.marker_in_sensor(sensor, 110.0), seen)
        moved = np.linalg.norm(seen - plain.marker_in_sensor(sensor, 110.0))
        assert 1e-5 < moved < 0.05
    np.testing.assert_allclose(opened.reported(110.0)[0], end, atol=1e-9)
    for world in (made, plain, opened):
        world.close()


def test_no_effect_larger_than_is_plausible_is_hidden_at_a_joint(stage):
    with pytest.raises(InputError, match='one of a plausible size leaves'):
        hide(stage, [EffectSpec.parse('encoder_eccentricity@3:500')], np.random.default_rng(SEED))
