# SPDX-License-Identifier: Apache-2.0
"""What the recorder says of the references: once, again where it grows, and after a restart."""

import subprocess
import sys

import numpy as np
import pytest

from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.setup_changes import SetupChanges
from remaster_ros.kinematics import transforms
from remaster_ros.session.cells.workcell import read_cell

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

    def round(self, changes):
        new = False
        for i, q in enumerate(self.references):
            readings = self.readings(q)
            self.log.append(('reference', len(self.log), readings))
            new |= changes.read(len(self.log) - 1, readings, T_R_N, i == 4)
        return new

    def other(self, changes):
        self.log.append(('other', 0, []))
        return changes.leave(T_R_N)


@pytest.fixture
def arm():
    return Arm()


def begun(arm, stop_m=5e-4):
    changes = SetupChanges(CHAIN, MARKERS, stop_m)
    for _ in range(2):
        assert not arm.round(changes)
    assert not arm.other(changes)
    assert not arm.round(changes)
    assert not arm.other(changes)
    assert (changes.describe(), changes.stops, changes.rounds) == ('', False, 3)
    return changes


def test_a_small_change_is_said_once_and_again_when_it_stops(arm):
    changes = begun(arm)
    arm.shift = np.array([0.0, 2.5e-4, 0.0])
    assert arm.round(changes)
    assert not changes.stops
    assert 'tracker or the base was moved between configurations' in changes.describe()
    assert not arm.other(changes)
    assert not arm.round(changes)
    arm.other(changes)
    arm.shift = np.array([0.0, 8e-4, 0.0])
    assert arm.round(changes)
    assert changes.stops
    assert 'more than 0.5 mm' in changes.describe()
    assert '/remaster/collect' in changes.describe()


def test_a_recorder_that_is_started_again_finds_the_same(arm):
    changes = begun(arm)
    arm.shift = np.array([2e-3, 0.0, 0.0])
    assert arm.round(changes)
    again = SetupChanges(CHAIN, MARKERS, 5e-4)
    again.take_back(arm.log, T_R_N)
    assert again.describe() == changes.describe()
    assert again.stopped_run == ''
    arm.log.append(('accepted', 0, []))
    changes.accept()
    for seen in (changes, SetupChanges(CHAIN, MARKERS, 5e-4)):
        if seen is not changes:
            seen.take_back(arm.log, T_R_N)
        assert (seen.describe(), seen.stopped_run) == ('', None)
    assert not arm.round(changes)


def test_a_round_that_ends_early_is_judged_when_the_arm_leaves(arm):
    """The last references could not be reached or read."""
    changes = begun(arm)
    arm.shift = np.array([0.0, 0.0, 3e-3])
    for i, q in enumerate(arm.references[:3]):
        assert not changes.read(100 + i, arm.readings(q), T_R_N)
    assert arm.other(changes)
    assert changes.stops


def test_nothing_stops_where_no_size_is_given(arm):
    changes = begun(arm, stop_m=0.0)
    arm.shift = np.array([5e-3, 0.0, 0.0])
    assert arm.round(changes)
    assert not changes.stops


def large(arm):
    """A change that stops the collection."""
    changes = begun(arm)
    arm.shift = np.array([2e-3, 0.0, 0.0])
    assert arm.round(changes)
    return changes


def test_a_large_change_stops_the_run_until_another_one_begins(arm):
    changes = large(arm)
    event = changes.report('a')
    assert (event.stops, event.text) == (True, changes.describe())
    assert changes.change.size_m == pytest.approx(2e-3, rel=0.3)
    assert changes.stopped_run == 'a'
    for state, run in (('running', 'a'), ('paused', ''), ('idle', ''), ('complete', '')):
        assert not changes.follow(state, run), 'a person has not looked'
    assert changes.follow('running', 'b')


def test_a_small_change_stops_no_run(arm):
    changes = begun(arm)
    arm.shift = np.array([0.0, 2.5e-4, 0.0])
    assert arm.round(changes)
    assert not changes.report('a').stops
    assert not changes.follow('running', 'b')
    changes.accept()
    assert changes.report('a') is None


@pytest.mark.parametrize(('state', 'run'), [('running', 'a'), ('paused', '')])
def test_a_recorder_that_is_started_again_takes_the_run_that_it_finds_as_stopped(arm, state, run):
    large(arm)
    again = SetupChanges(CHAIN, MARKERS, 5e-4)
    again.take_back(arm.log, T_R_N)
    assert not again.follow('idle', '')
    assert again.stopped_run == ''
    assert not again.follow(state, run)
    assert not again.follow(state, run)
    assert again.follow('running', 'b')


LOADED = f"""
import runpy, sys
scene = runpy.run_path({__file__!r})
arm = scene['Arm']()
changes = scene['SetupChanges'](scene['CHAIN'], scene['MARKERS'], 5e-4)
before = set(sys.modules)
for shift_m in (0.0, 0.0, 0.0, 3e-3):
    arm.shift[0] = shift_m
    arm.round(changes)
    arm.other(changes)
print(changes.rounds, changes.stops, sorted(set(sys.modules) - before))
"""


def test_judging_a_round_loads_nothing():
    """A library takes seconds of a busy computer, and the arm waits for the recorder."""
    done = subprocess.run(
        [sys.executable, '-c', LOADED], capture_output=True, text=True, check=False
    )
    assert done.stdout.strip().splitlines()[-1:] == ['4 True []'], done.stdout + done.stderr
