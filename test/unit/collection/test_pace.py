# SPDX-License-Identifier: Apache-2.0
"""Time that a collection still takes, from what it took so far while it ran."""

from __future__ import annotations

from remaster_ros.collection.pace import Pace, minutes_text, progress_text


def run(pace, done, from_s, to_s, *, running=True):
    """Let the figures come twice a second, as a planner sends them."""
    for tick in range(int(2 * from_s), int(2 * to_s) + 1):
        pace.update(done, tick / 2, running=running)


def test_what_is_left_takes_as_long_as_what_is_done():
    pace = Pace()
    for done in range(11):
        run(pace, done, 6.0 * done, 6.0 * done + 6.0)
    assert abs(pace.left_s(20) - 120.0) < 2.0
    assert pace.left_s(0) == 0.0


def test_a_pause_does_not_count():
    pace = Pace()
    for done in range(6):
        run(pace, done, 6.0 * done, 6.0 * done + 6.0)
    before = pace.left_s(10)
    run(pace, 5, 36.0, 3600.0, running=False)
    for done in range(6, 10):
        run(pace, done, 3600.0 + 6.0 * (done - 6), 3606.0 + 6.0 * (done - 6))
    assert abs(pace.left_s(10) - before) < 10.0


def test_no_time_before_enough_is_done_nor_from_what_was_done_before():
    pace = Pace()
    pace.update(50, 0.0, running=True)  # Started late: how long those took is unknown.
    assert pace.left_s(20) is None
    pace.update(52, 20.0, running=True)
    assert pace.left_s(20) is None
    pace.update(53, 30.0, running=True)
    assert abs(pace.left_s(20) - 200.0) < 1e-9


def test_another_plan_begins_anew():
    pace = Pace()
    for done in range(5):
        pace.update(done, 10.0 * done, running=True)
    pace.update(0, 50.0, running=True)
    assert pace.left_s(20) is None


def test_words():
    assert minutes_text(None) == ''
    assert minutes_text(42.0) == 'about 40 s left'
    assert minutes_text(1.0) == 'about 10 s left'
    assert minutes_text(130.0) == 'about 2 min left'


def test_a_line_says_how_far_it_is():
    counts = {'phase': 'collection', 'configurations_done': 12, 'configurations': 97}
    counts |= {'poses_done': 3, 'poses': 14}
    assert progress_text(counts, 360.0) == (
        '12 of 97 configurations, 3 of 14 poses, about 6 min left'
    )
    assert progress_text(counts, None) == '12 of 97 configurations, 3 of 14 poses'
    assert progress_text(counts | {'phase': 'registration'}, 360.0) == ''
    assert progress_text(counts | {'configurations': 0}, 360.0) == ''
