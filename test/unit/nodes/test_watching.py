"""What the recorder says of the references: once, again where it grows, and after a restart."""

import numpy as np
import pytest

from remaster_ros.collection.pairing import PairedReading
from remaster_ros.kinematics import transforms
from remaster_ros.nodes.watching import Watching
from remaster_ros.session.workcell import read_cell

CELL = read_cell('demo')
CHAIN = CELL.chain()
MARKERS = {name: np.array(place) for name, place in CELL.markers.items()}
T_R_N = {
    'tracker': transforms.transform(transforms.looking_at([2.0, 0, 1], [0, 0, 1]), [2.0, 0, 1])
}
SEED = 6


class Arm:
    def __init__(self):
        print('seed', SEED)
        self.rng = np.random.default_rng(SEED)
        self.references = self.rng.uniform(-1.2, 1.2, (5, len(CHAIN)))
        self.shift, self.log, self.time_s = np.zeros(3), [], 0.0

    def readings(self, q):
        self.time_s += 5.0
        point = CHAIN.positions(q, MARKERS['smr']) + self.shift
        position = transforms.apply(transforms.inverse(T_R_N['tracker']), point)
        position = position + self.rng.normal(0, 2e-5, 3)
        return [PairedReading('tracker', 'smr', self.time_s, q, position, None, 1)]

    def round(self, watching):
        new = False
        for i, q in enumerate(self.references):
            readings = self.readings(q)
            self.log.append(('reference', len(self.log), readings))
            new |= watching.read(len(self.log) - 1, readings, T_R_N, i == 4)
        return new

    def other(self, watching):
        self.log.append(('other', 0, []))
        return watching.leave(T_R_N)


@pytest.fixture
def arm():
    return Arm()


def begun(arm, stop_m=5e-4):
    watching = Watching(CHAIN, MARKERS, stop_m)
    for _ in range(2):
        assert not arm.round(watching)
    assert not arm.other(watching)
    assert not arm.round(watching)
    assert not arm.other(watching)
    assert (watching.describe(), watching.stops, watching.rounds) == ('', False, 3)
    return watching


def test_a_small_change_is_said_once_and_again_when_it_stops(arm):
    watching = begun(arm)
    arm.shift = np.array([0.0, 2.5e-4, 0.0])
    assert arm.round(watching)
    assert not watching.stops
    assert 'tracker or the base was moved between configurations' in watching.describe()
    assert not arm.other(watching)
    assert not arm.round(watching)
    arm.other(watching)
    arm.shift = np.array([0.0, 8e-4, 0.0])
    assert arm.round(watching)
    assert watching.stops
    assert 'more than 0.5 mm' in watching.describe()
    assert '/remaster/collect' in watching.describe()


def test_a_recorder_that_is_started_again_finds_the_same(arm):
    watching = begun(arm)
    arm.shift = np.array([2e-3, 0.0, 0.0])
    assert arm.round(watching)
    again = Watching(CHAIN, MARKERS, 5e-4)
    again.take_back(arm.log, T_R_N)
    assert again.describe() == watching.describe()
    assert again.stopped_run == ''
    arm.log.append(('accepted', 0, []))
    watching.accept()
    for seen in (watching, Watching(CHAIN, MARKERS, 5e-4)):
        if seen is not watching:
            seen.take_back(arm.log, T_R_N)
        assert (seen.describe(), seen.stopped_run) == ('', None)
    assert not arm.round(watching)


def test_a_round_that_ends_early_is_judged_when_the_arm_leaves(arm):
    """The last references could not be reached or read."""
    watching = begun(arm)
    arm.shift = np.array([0.0, 0.0, 3e-3])
    for i, q in enumerate(arm.references[:3]):
        assert not watching.read(100 + i, arm.readings(q), T_R_N)
    assert arm.other(watching)
    assert watching.stops


def test_nothing_stops_where_no_size_is_given(arm):
    watching = begun(arm, stop_m=0.0)
    arm.shift = np.array([5e-3, 0.0, 0.0])
    assert arm.round(watching)
    assert not watching.stops
