# SPDX-License-Identifier: Apache-2.0
"""Who gets the lock, who keeps it, and who is never given it; times in seconds of one clock."""

import pytest

from remaster_ros.sensors.optitrack.source_lock import (
    PROBATION_S,
    REFUSED_FOR_S,
    REMEMBERED,
    SourceLock,
    SourceVerdict,
)

SERVER, OTHER, THIRD = ('10.0.0.2', 50001), ('10.0.0.2', 50002), ('10.0.0.2', 50003)
SILENCE_S = 1.0
STEP_S = 0.03


class Stream:
    """A lock under frames of several sources, each 30 a second."""

    def __init__(self):
        self.lock = SourceLock(SILENCE_S)
        self.now = 100.0

    def frames(self, *sources, seconds=1.0):
        """Let these send in turn; return the verdicts by source."""
        verdicts = {source: [] for source in sources}
        until = self.now + seconds
        while self.now < until:
            self.now += STEP_S
            self.lock.release_if_silent(self.now)
            for source in sources:
                verdicts[source].append(self.lock.judge(source, self.now))
        return verdicts

    def silence(self, seconds=2.0):
        self.now += seconds
        return self.lock.release_if_silent(self.now)

    def begin(self, *sources):
        self.lock.answer()
        return self.frames(*(sources or (SERVER,)))


@pytest.fixture
def stream():
    return Stream()


def test_the_only_one_after_an_answer_is_believed_after_its_probation(stream):
    verdicts = stream.begin()[SERVER]
    waited = verdicts.index(SourceVerdict.BELIEVED)
    assert PROBATION_S <= waited * STEP_S < PROBATION_S + 2 * STEP_S
    assert set(verdicts[:waited]) == {SourceVerdict.PROBATION}
    assert set(verdicts[waited:]) == {SourceVerdict.BELIEVED}
    assert (stream.lock.source, stream.lock.taken) == (SERVER, 1)


def test_without_an_answer_nobody_is_believed(stream):
    assert set(stream.frames(SERVER)[SERVER]) == {SourceVerdict.PROBATION}


def test_few_frames_are_no_stream(stream):
    stream.lock.answer()
    assert stream.lock.judge(SERVER, 100.0) is SourceVerdict.PROBATION
    assert stream.lock.judge(SERVER, 100.5) is SourceVerdict.PROBATION
    assert stream.lock.judge(SERVER, 101.0) is SourceVerdict.BELIEVED


def test_a_second_source_is_foreign_and_the_first_goes_on(stream):
    stream.begin()
    verdicts = stream.frames(OTHER, SERVER, seconds=5.0)
    assert set(verdicts[OTHER]) == {SourceVerdict.FOREIGN}
    assert set(verdicts[SERVER]) == {SourceVerdict.BELIEVED}
    assert stream.lock.rivals(stream.now) == (OTHER,)
    assert stream.lock.rivals(stream.now + REFUSED_FOR_S + 1.0) == ()


def test_of_two_from_the_beginning_none_is_believed_until_one_is_silent(stream):
    verdicts = stream.begin(SERVER, OTHER)
    assert {*verdicts[SERVER], *verdicts[OTHER]} == {SourceVerdict.PROBATION}
    assert set(stream.lock.contestants(stream.now)) == {SERVER, OTHER}
    late = stream.frames(SERVER, seconds=2 * SILENCE_S)[SERVER]
    believed_after_s = late.index(SourceVerdict.BELIEVED) * STEP_S
    assert SILENCE_S - STEP_S <= believed_after_s <= SILENCE_S + 2 * STEP_S
    assert stream.lock.contestants(stream.now) == ()


def test_after_a_silence_the_lock_needs_an_answer_and_a_probation(stream):
    stream.begin()
    assert not stream.silence(SILENCE_S / 2)
    assert stream.silence()
    assert not stream.silence(), 'said once'
    assert stream.lock.source is None
    assert set(stream.frames(OTHER)[OTHER]) == {SourceVerdict.PROBATION}
    assert stream.begin(OTHER)[OTHER][-1] is SourceVerdict.BELIEVED
    assert stream.lock.taken == 2


def test_the_same_source_goes_on_after_a_silence(stream):
    stream.begin()
    stream.silence()
    assert set(stream.frames(SERVER, OTHER)[SERVER]) == {SourceVerdict.BELIEVED}
    assert stream.lock.taken == 1


def test_who_was_believed_before_the_last_one_has_no_privilege(stream):
    stream.begin()
    stream.silence()
    stream.begin(OTHER)
    stream.silence()
    assert stream.lock.judge(SERVER, stream.now) is SourceVerdict.PROBATION


def test_who_sent_beside_the_believed_source_is_no_successor(stream):
    stream.begin()
    stream.frames(SERVER, OTHER)
    stream.lock.answer()
    assert set(stream.frames(OTHER, seconds=3.0)[OTHER]) == {SourceVerdict.FOREIGN}
    stream.lock.answer()
    verdicts = stream.frames(OTHER, THIRD)
    assert set(verdicts[OTHER]) == {SourceVerdict.FOREIGN}
    assert verdicts[THIRD][-1] is SourceVerdict.BELIEVED, 'the restarted server'


def test_who_was_refused_is_forgotten_after_a_long_silence(stream):
    stream.begin()
    stream.frames(SERVER, OTHER)
    stream.silence(REFUSED_FOR_S + 1.0)
    assert stream.begin(OTHER)[OTHER][-1] is SourceVerdict.BELIEVED


def test_a_server_that_changes_its_port_within_the_silence_is_followed(stream):
    stream.begin()
    soon = stream.frames(OTHER, seconds=SILENCE_S / 2)[OTHER]
    assert set(soon) == {SourceVerdict.FOREIGN}, 'nobody can tell yet'
    stream.frames(OTHER, seconds=SILENCE_S)
    assert stream.begin(OTHER)[OTHER][-1] is SourceVerdict.BELIEVED


def test_a_forger_with_a_new_port_for_every_frame_fills_no_memory(stream):
    stream.begin()
    stream.frames(SERVER, OTHER)
    for number in range(5 * REMEMBERED):
        stream.now += 0.001
        assert stream.lock.judge(('10.0.0.2', number), stream.now) is SourceVerdict.FOREIGN
    assert len(stream.lock._others) == REMEMBERED
    assert OTHER in stream.lock.rivals(stream.now), 'who lasted is remembered longest'
    assert stream.lock.judge(SERVER, stream.now) is SourceVerdict.BELIEVED
