# SPDX-License-Identifier: Apache-2.0
"""Readings of an arm with a joint that slides: what counts as still, frozen, slipped and known."""

import json

import numpy as np
import pytest
from pairing_feed import STREAM, Q, run
from worlds.sliding_cells import rail, scara, sliding_cell, telescope

from remaster_ros import simulate
from remaster_ros.collection.events import PoseAnnounced
from remaster_ros.collection.pairing import PairedReading, Pairing, Rejection
from remaster_ros.collection.plausibility import Plausibility
from remaster_ros.collection.recording import Recording
from remaster_ros.collection.reference_watch import ReferenceReading, ReferenceWatch
from remaster_ros.collection.stopping_rule import StoppingGoal, StoppingRule
from remaster_ros.kinematics.same_arm import difference
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.planning.reference_choice import Place, causes
from remaster_ros.reports.live_view import LiveView
from remaster_ros.reports.precision_json import precision_json
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.robot import ENCODER_RAD, REPEATABILITY_RAD, FakeArm
from remaster_ros.simulation.setup import make_world

UNITS = JointUnits((True, False, False))


def chain_of(urdf):
    return SerialChain.from_urdf(urdf, 'base_link', 'tool')


@pytest.mark.parametrize(
    ('way', 'detail'),
    [
        ([2e-4, 0.0, 0.0], 'a joint moved 0.200 mm (allowed 0.125)'),
        ([1e-4, 7e-4, 0.0], 'a joint moved 7.00e-04 rad (allowed 5.0e-04)'),
        ([1e-4, 4e-4, 0.0], ''),
    ],
)
def test_an_arm_that_slides_during_the_dwell(way, detail):
    pairing = run(Pairing(10.0, Q, (STREAM,), units=UNITS), offset=np.array(way))
    found = pairing.decided['mocap']
    assert (found.detail if isinstance(found, Rejection) else '') == detail


def test_where_an_arm_that_slides_has_settled():
    recording = Recording((STREAM,), 5e-4, 'all', None, units=UNITS)
    recording.announced = PoseAnnounced(
        stamp='1', pose=0, split='optimization', ids=(0, 1), plan='a'
    )
    recording.take_solutions('1', np.array([Q, Q + [0.012, 0.0, 0.0]]))
    assert recording.take_settled(10.0, Q + [0.0115, 0.01, 0.0])
    assert recording.next().solution == 1
    assert not recording.take_settled(11.0, Q + [0.006, 0.0, 0.0])


def test_an_instrument_that_repeats_itself_while_a_slide_moves():
    """A marker on the axis of the last joint does not move with it; 3 mm of a slide count."""
    chain = chain_of(scara())
    judge = Plausibility(chain, {'sir': np.zeros(3)})
    place = np.array([1.0, 0.0, 0.5])

    def read(q):
        return judge.judge(PairedReading('mocap', 'sir', 1.0, np.array(q), place), None)

    assert isinstance(read([0.1, 0.2, 0.0, 0.0]), PairedReading)
    # It moves the marker by less than a millimetre, but that is no reading of its own either.
    assert isinstance(read([0.1, 0.2, 0.0, 0.009]), PairedReading)
    assert read([0.1, 0.2, 0.0, 0.02]).reason == 'frozen'
    assert read([0.1, 0.2, 0.003, 0.009]).reason == 'frozen'


def test_the_encoder_of_a_slide_slips_by_a_shift():
    chain = chain_of(rail())
    rng = np.random.default_rng(1)
    low, high = chain.usual_range
    places = [
        Place(q, 'mocap', 'sir', np.array([0.1, 0.0, 0.0]))
        for q in rng.uniform(0.5 * low, 0.5 * high, (4, len(chain)))
    ]
    found = {cause.subject: cause for cause in causes(chain, places)}
    slipped = found['the encoder of rail slipped']
    assert slipped.shifts == 1
    np.testing.assert_allclose(slipped.jacobian[:, :, 0], np.tile([0.0, 1.0, 0.0], (4, 1)))
    assert found['the encoder of joint_2 slipped'].shifts == 0


def test_references_of_an_arm_that_slides_are_told_apart_by_millimetres():
    chain = chain_of(rail())
    watch = ReferenceWatch(chain, {'sir': np.array([0.1, 0.0, 0.0])})

    def read(q):
        return ReferenceReading('mocap', 'sir', 1.0, q, np.zeros(3), configuration=0)

    at = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    watch.add(read(at))
    # 15 mm further is another reference, 4 mm further the same.
    watch.add(read(at + [0.015, *6 * [0.0]]))
    assert watch.rounds == 1
    watch.add(read(at + [0.004, *6 * [0.0]]))
    assert watch.rounds == 2


@pytest.fixture(scope='module')
def measured(tmp_path_factory):
    """Return an arm of which one joint slides, and a session of it."""
    folder = tmp_path_factory.mktemp('telescope')
    options = {'held_joint': 'joint_3', 'held_values_m': [-0.05, 0.0, 0.05]}
    cell = sliding_cell(folder, telescope(), **options)
    return cell, simulate(cell, poses=10, validation_poses=0, seed=1)


def test_what_is_known_of_a_slide_is_in_millimetres(measured):
    _, made = measured
    rule = StoppingRule(StoppingGoal(), planned=40, every=20)
    look = rule.look(made.session, 20, None, np.random.default_rng(0))
    assert look.sliding == ('joint_3',)
    known = json.loads(precision_json(rule, [look]))['looks'][0]
    assert 'joint_3' not in known['joint_std_deg']
    assert known['joint_std_mm'] == {'joint_3': pytest.approx(1e3 * look.joint_std['joint_3'])}
    assert '(4.36 mm count as one)' in rule.describe(look)
    stds = [
        std / (0.25 if name == 'joint_3' else 1.0)
        for name, std in look.joint_std.items()
        if std is not None
    ]
    assert look.joint_rms == pytest.approx(np.sqrt(np.mean(np.square(stds))))


def test_the_live_page_has_the_offset_of_a_slide_in_millimetres(measured):
    cell = read_cell(measured[0])
    chain = cell.chain()
    view = LiveView(chain, {'mocap': {'sir': np.array(cell.markers['sir'])}})
    means = dict.fromkeys(chain.joint_names, 1e-3)
    view.take_offsets(means, dict.fromkeys(chain.joint_names, 2e-4))
    rows = view.view(0.0)['result']['joints']
    assert rows[2] == {'joint': 'joint_3', 'unit': 'mm', 'mean_mm': 1.0, 'std_mm': 0.2}
    assert rows[1]['mean_deg'] == pytest.approx(np.degrees(1e-3), abs=1e-6)
    # 5 degrees, and 22 mm, are what nothing but the prior holds.
    view.take_offsets(means, dict.fromkeys(chain.joint_names, 0.03))
    rows = view.view(0.0)['result']['joints']
    assert rows[2]['std_mm'] is None
    assert rows[1]['std_deg'] is not None


def test_the_fakes_begin_amid_the_way_of_a_slide_and_repeat_to_micrometres(measured, tmp_path):
    cell = read_cell(measured[0])
    world = make_world(tmp_path / 'world', cell, 3, 10.0)
    chain, rng = world.chain, np.random.default_rng(0)
    assert world.start_q[2] == 0.0
    np.testing.assert_allclose(np.degrees(world.start_q[[0, 3]]), [5.0, 112.0])
    offsets = np.array(
        [make_world(tmp_path / 'w', cell, s, 10.0).truth.joint_offsets for s in range(40)]
    )
    expected = np.deg2rad(0.3) * chain.per_radian
    np.testing.assert_allclose(np.sqrt(np.mean(offsets**2, axis=0)), expected, rtol=0.4)
    fake = FakeArm(world, rng)
    ends = []
    for _ in range(40):
        fake.command(fake.names, [ServoPoint(0.01, world.start_q, np.zeros(7))])
        ends.append(json.loads((world.folder / 'motion.jsonl').read_text().splitlines()[-1]))
    off = np.array([end[1][-1]['q'] for end in ends]) - world.start_q
    wanted = REPEATABILITY_RAD * chain.per_radian
    np.testing.assert_allclose(np.std(off, axis=0), wanted, rtol=0.4)
    assert ENCODER_RAD < REPEATABILITY_RAD
    hidden = [EffectSpec.parse('backlash@3:0.2')]
    (effect,) = make_world(tmp_path / 'w', cell, 3, 10.0, hidden, candidates=20).truth.effects
    # Of a slide, in m.
    assert 1e-4 < effect.values[0] < 1.1e-3


@pytest.mark.parametrize(
    ('change', 'why'),
    [
        (('"-0.6" upper="0.6"', '"-0.6" upper="0.5"'), 'rail may go from -600.00 mm to 500.00 mm'),
        (('velocity="0.5"', 'velocity="0.2"'), 'rail may slide at 200.00 mm/s only there'),
        (('name="rail" type="prismatic"', 'name="rail" type="revolute"'), 'rail turns there'),
        (('<axis xyz="0 1 0"/><limit lower="-0.6"', '<axis xyz="0 -1 0"/><limit lower="-0.6"'),
         'the axis of rail is turned there by 180.00 deg'),
        (('"prismatic"><parent link="base_link"/><child link="carriage"/><origin xyz="0 0 0"/>',
          '"prismatic"><parent link="base_link"/><child link="carriage"/><origin xyz="0.1 0 0"/>'),
         'the axis of joint_1 lies 100.0 mm elsewhere there'),
    ],
)  # fmt: skip
def test_a_description_of_another_rail(change, why):
    chain = chain_of(rail())
    assert difference(chain, rail()) == ''
    other = rail().replace(*change)
    assert other != rail()
    assert why in difference(chain, other)
