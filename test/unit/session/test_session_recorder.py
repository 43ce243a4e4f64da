# SPDX-License-Identifier: Apache-2.0
"""What became of configurations that the arm did not get to is in the session's journal too."""

import numpy as np
import pytest
from msgspec.structs import replace

from remaster_ros.collection.events import EventRecord, PoseAnnounced, SolutionFailed
from remaster_ros.collection.recording import EndedReading, SettledArm
from remaster_ros.session import session_recorder
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.session_journal import SessionJournal, read_outcomes

CELL, Q = read_cell('demo'), np.zeros((3, 7))
POSE = PoseAnnounced(
    stamp='7.0', pose=4, split='optimization', ids=(3, 1, 0), unreached=(2,), plan='a'
)


class Bench(session_recorder.Outlet):
    """A recorder, and its keeper that can be without room; counts the states published."""

    def __init__(self, folder):
        self.full, self.states = '', 0
        p = session_recorder.Parameters(session=str(folder))
        self.journal = SessionJournal(folder, session_recorder.session_header(CELL, p.settle_s))
        self.recorder = session_recorder.SessionRecorder(CELL, p, self, self)

    def write(self, write):
        write()

    def state(self):
        self.states += 1

    def take(self, body):
        self.recorder.take_record(EventRecord(node=f'/{body.sender}', body=body))
        self.recorder.look()

    def announce(self, **change):
        self.take(replace(POSE, **change))
        self.recorder.recording.take_solutions(change.get('stamp', POSE.stamp), Q)
        self.recorder.look()

    def fail(self, solution, stamp='7.0'):
        self.take(SolutionFailed(stamp=stamp, solution=solution, reason='no way'))

    def reject(self, solution, stamp):
        settled = SettledArm(Q[0], 1.0, replace(POSE, stamp=stamp), solution)
        self.recorder._write_outcome(EndedReading(settled, None, [], [], [], {}, 2.0, None))

    def ends(self):
        return self.journal.outcomes.poses.get(4, ('', {}))[1]


@pytest.fixture
def bench(tmp_path):
    made = Bench(tmp_path / 'session')
    yield made
    made.journal.close('stopped')


def test_what_has_no_way_and_what_fails_is_written_down_once(bench):
    bench.full = 'no space'
    bench.fail(0)
    bench.announce()
    assert (bench.ends(), bench.journal.plan_id) == ({}, '')
    bench.full = ''
    for solution, stamp in ((1, '7.0'), (1, '7.0'), (7, '7.0'), (2, '6.0')):
        bench.fail(solution, stamp)
    assert bench.ends() == {2: 'no_free_path', 3: 'failed', 1: 'failed'}
    assert bench.states == 3, 'by each of them the planner goes on'
    assert read_outcomes(bench.journal.folder).poses == bench.journal.outcomes.poses
    # Nothing of another plan.
    bench.journal.observations = 1
    bench.announce(plan='b', unreached=(0,))
    assert len(bench.ends()) == 3
    bench.journal.observations = 0


def test_what_is_taken_back_or_announced_again_has_no_outcome_unless_it_is_recorded(bench):
    assert bench.journal.follow('a')
    bench.journal.write(pose=4, solution=2, split='optimization', result='recorded', reason='')
    bench.fail(0)
    bench.announce(stamp='8.0')
    bench.recorder.recording.take_solutions('', Q[:0])
    bench.fail(0, '8.0')
    bench.reject(1, '7.0')
    bench.reject(2, '8.0')
    assert bench.ends() == {2: 'recorded'}
    bench.announce(stamp='9.0')
    bench.reject(2, '9.0')
    assert bench.ends() == {2: 'recorded', 0: 'rejected'}
