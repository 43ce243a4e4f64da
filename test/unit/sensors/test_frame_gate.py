# SPDX-License-Identifier: Apache-2.0
"""Which frames give a reading of the marker, and why the others do not."""

import math

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack.frame_gate import Dropped, GateCounts, MarkerChoice, MarkerGate
from remaster_ros.sensors.optitrack.natnet_frame import NOT_LIVE, Frame, LabeledMarker

MARKER_ID = 3 << 16 | 2
MEASURED_ASSET, STRAY = 0x0A, 0x12


def marker(marker_id=MARKER_ID, x=0.5, params=MEASURED_ASSET):
    return LabeledMarker(marker_id, (x, 0.25, 2.0), 0.01, params, 2e-4)


def frame(number, *markers, **fields):
    return Frame(number, fields.pop('timestamp', number * 0.01), markers, **fields)


def gate_for(**choice):
    gate = MarkerGate(MarkerChoice(**({'marker_id': MARKER_ID} | choice)), GateCounts())
    return gate, lambda f, received_s=50.0: gate.admit(f, received_s, 10_000_000)


def test_a_measured_marker_is_a_reading():
    gate, admit = gate_for()
    sample = admit(
        frame(1, marker(99, 9.0, STRAY), marker(), mid_exposure=20_000_000, transmitted=20_100_000)
    )
    assert sample is not None
    np.testing.assert_array_equal(sample.position, [0.5, 0.25, 2.0])
    assert (sample.frame_number, sample.timestamp_s, sample.received_s) == (1, 0.01, 50.0)
    assert sample.age_s == pytest.approx(0.01)
    assert (gate.counts.frames, gate.counts.accepted, gate.counts.last_reason) == (1, 1, None)
    assert not any(gate.counts.dropped.values())


def test_without_a_mid_exposure_clock_the_frame_time_remains():
    _gate, admit = gate_for()
    sample = admit(frame(1, marker(), data_received=10_000_000, transmitted=10_050_000))
    assert sample.age_s == pytest.approx(0.005)
    old = MarkerGate(MarkerChoice(marker_id=MARKER_ID), GateCounts()).admit(
        frame(1, marker()._replace(residual=None), software_latency=0.004), 50.0, 0
    )
    assert old.age_s == 0.004


def test_a_marker_that_repeats_itself_to_the_last_bit_is_frozen():
    gate, admit = gate_for()
    taken = [admit(frame(number, marker())) is not None for number in range(1, 31)]
    assert taken == [True] * 10 + [False] * 20
    assert gate.counts.dropped[Dropped.FROZEN] == 20
    assert admit(frame(31, marker(x=0.5 + 1e-7))) is not None


@pytest.mark.parametrize(
    ('bad', 'reason'),
    [
        (frame(2, marker(params=0x09)), Dropped.OCCLUDED),
        (frame(2, marker(params=0x0D)), Dropped.OCCLUDED),
        (frame(2, marker(params=0x0C)), Dropped.MODEL_FILLED),
        (frame(2, marker(params=0x0E)), Dropped.MODEL_FILLED),
        (frame(2, marker(params=STRAY)), Dropped.UNLABELLED),
        (frame(2, marker(77)), Dropped.NOT_PRESENT),
        (frame(2), Dropped.NOT_PRESENT),
        (frame(2, marker(), marker()), Dropped.AMBIGUOUS),
        (frame(2, marker(), params=NOT_LIVE), Dropped.NOT_LIVE),
        (frame(1, marker()), Dropped.DUPLICATE),
        (frame(0, marker()), Dropped.OUT_OF_ORDER),
        (frame(2, marker(), timestamp=0.01), Dropped.STALE),
        (frame(2, marker(x=0.7)), Dropped.JUMP),
    ],
)
def test_everything_else_is_counted_with_its_reason(bad, reason):
    gate, admit = gate_for()
    assert admit(frame(1, marker())) is not None
    assert admit(bad) is None
    assert gate.counts.last_reason == reason
    assert {r: n for r, n in gate.counts.dropped.items() if n} == {reason: 1}
    assert admit(frame(3, marker())) is not None, 'the next good frame is taken'
    assert (gate.counts.frames, gate.counts.accepted) == (3, 2)


@pytest.mark.parametrize('flag', range(16))
def test_occluded_or_model_filled_never_passes_whatever_else_is_set(flag):
    for hidden in (1, 4, 5):
        _gate, admit = gate_for()
        assert admit(frame(1, marker(params=hidden | 1 << flag))) is None


def test_lost_frames_are_counted_and_a_restarted_stream_is_followed():
    gate, admit = gate_for()
    for number in (100, 101, 105):
        assert admit(frame(number, marker())) is not None
    assert gate.counts.lost == 3
    assert admit(frame(1, marker(x=0.9)), 51.0) is not None, 'frame numbers began again'
    assert admit(frame(2, marker(x=0.9), timestamp=5.0), 51.01) is not None
    assert admit(frame(3, marker(x=0.1), timestamp=0.0), 52.0) is not None, 'the time began again'
    assert (gate.counts.restarts, gate.counts.lost) == (2, 3)


def test_a_damaged_number_does_not_carry_the_marker_away():
    """It looks like a restart, across which the marker was taken to be anywhere."""
    gate, admit = gate_for()
    for number in range(500, 510):
        assert admit(frame(number, marker(x=0.5 + 1e-6 * number)), 0.01 * number) is not None
    # The frame that is damaged, and the next one, which goes on where the stream was.
    assert admit(frame(7, marker(x=48.0)), 5.0905) is None
    assert gate.counts.last_reason == Dropped.JUMP
    assert admit(frame(510, marker(x=0.5002)), 5.10) is not None
    assert admit(frame(511, marker(x=0.5)), 5.11) is not None
    # A clock of this host that was set back tells nothing of how long ago the last reading was.
    assert admit(frame(1, marker(x=0.9)), -1000.0) is not None


def test_a_first_reading_that_cannot_be_keeps_no_later_one_out():
    gate, admit = gate_for()
    assert admit(frame(1, marker(x=3e38))) is None
    old = frame(2, marker(), mid_exposure=1, transmitted=2**63)
    assert admit(old) is None, 'it says that it took thousands of years'
    assert gate.counts.dropped[Dropped.IMPLAUSIBLE] == 2
    assert admit(frame(3, marker())) is not None


def test_a_damaged_frame_number_is_not_taken_for_lost_frames():
    gate, admit = gate_for()
    for number in (1, 2, 2**31 - 1, 3, 5):
        admit(frame(number, marker(), timestamp=0.01 * min(number, 3)))
    assert gate.counts.lost == 1
    assert gate.counts.restarts == 2


def test_a_fast_but_possible_move_is_no_jump():
    _gate, admit = gate_for(max_speed_m_s=5.0)
    assert admit(frame(1, marker(x=0.50))) is not None
    assert admit(frame(2, marker(x=0.54))) is not None
    assert admit(frame(3, marker(x=0.62))) is None
    assert admit(frame(10, marker(x=0.62))) is not None, 'by then it can have moved there'


@pytest.mark.parametrize(
    ('choice', 'assets', 'expected'),
    [
        ({}, {'tool': 3}, 3 << 16 | 1),
        ({'member': 2}, {'tool': 3}, 3 << 16 | 2),
        ({'rigid_body': 'tool'}, {'tool': 3, 'base': 4}, 3 << 16 | 1),
        ({'marker_id': 55}, {}, 55),
        ({}, {'tool': 3, 'base': 4}, 'several rigid bodies (base, tool): set rigid_body'),
        ({'rigid_body': 'tol'}, {'tool': 3}, "no rigid body 'tol'; the server streams: tool"),
        ({'rigid_body': 'tol'}, {}, "no rigid body 'tol'; the server streams: none"),
        ({}, {}, 'create one from the markers in Motive'),
    ],
)
def test_the_marker_is_found_by_name_and_member(choice, assets, expected):
    gate = MarkerGate(MarkerChoice(**choice), GateCounts())
    gate.name_assets(assets)
    if isinstance(expected, int):
        assert (gate.counts.marker_id, gate.counts.problem) == (expected, '')
    else:
        assert gate.counts.marker_id is None
        assert expected in gate.counts.problem


def test_an_unknown_marker_is_unresolved_until_its_body_is_named():
    gate = MarkerGate(MarkerChoice(member=2), GateCounts())
    assert gate.admit(frame(1, marker()), 0.0, 0) is None
    assert gate.counts.last_reason == Dropped.UNRESOLVED
    gate.name_assets({'tool': 3})
    assert gate.admit(frame(2, marker()), 0.0, 0) is not None


def test_a_lone_marker_is_taken_only_while_it_is_alone():
    gate, admit = gate_for(lone_marker=True)
    hidden = marker(5, 8.0, 0x09)
    assert admit(frame(1, marker(99, params=STRAY), hidden)) is not None
    assert admit(frame(2, marker(99, params=STRAY), marker(98, 3.0, STRAY))) is None
    assert gate.counts.last_reason == Dropped.AMBIGUOUS
    assert admit(frame(3)) is None
    assert gate.counts.last_reason == Dropped.NOT_PRESENT


@pytest.mark.parametrize('bad', [{'member': 0}, {'member': 65536}, {'max_speed_m_s': 0.0},
                                 {'max_speed_m_s': math.nan}])  # fmt: skip
def test_a_choice_that_can_never_match_is_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        MarkerChoice(**bad)
