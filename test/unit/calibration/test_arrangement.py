# SPDX-License-Identifier: Apache-2.0
"""Tables whose joints are otherwise than the robot's are recognised, and right ones left alone."""

from dataclasses import replace

import numpy as np
import pytest
from foreign.tables import measured
from worlds.measured_rows import measured_rows

from remaster_ros.calibration.arrangement import (
    Arrangement,
    arranged,
    fit_arrangement,
    search,
    some_rows,
)
from remaster_ros.types import Session

LENGTHS = (1e-3, 0.0254, 1e3, 25.4)


def scene(robot, rows, seed):
    arm = measured(robot, rows, seed)
    return Session(
        urdf=arm.urdf,
        base_link=arm.chain.base_link,
        tip_link=arm.chain.tip_link,
        markers={'m': np.zeros(3)},
        sensors={'s': 'm'},
        measurements=measured_rows(arm.q, arm.points),
        marker_std_m=0.3,
    )


def spoilt(session, q=lambda q: q, points=lambda points: points):
    m = session.measurements
    return replace(session, measurements=replace(m, q=q(m.q), position=points(m.position)))


def only_at(joints, joint, value, otherwise):
    return tuple(value if i == joint else otherwise for i in range(joints))


CHANGES = [
    (dict(q=lambda q: q * np.where(np.arange(q.shape[1]) == 2, -1, 1)), 'signs'),
    (dict(q=np.rad2deg), 'angle_scale'),
    (dict(q=np.deg2rad), 'angle_scale'),
    (dict(q=lambda q: q[:, ::-1]), 'order'),
    (dict(q=lambda q: q - np.where(np.arange(q.shape[1]) == 1, np.pi / 2, 0.0)), 'quarters'),
    (dict(q=lambda q: q - np.eye(q.shape[1])[2] * q[:, 1:2]), 'coupled'),
    (dict(points=lambda p: p * [1.0, 1.0, -1.0]), 'mirrored'),
    (dict(points=lambda p: 1e3 * p), 'length_scale'),
    (dict(q=lambda q: np.roll(q, 1, axis=0)), 'shift'),
]
# Which of them `make test` tries: two seconds each, and test_mistakes tries the others.
TRIED = {'irb120': ('coupled', 'mirrored'), 'ur5e': (), 'panda': ()}


@pytest.mark.parametrize(
    ('robot', 'change', 'found'),
    [
        pytest.param(
            robot,
            change,
            found,
            marks=() if found in TRIED[robot] else pytest.mark.qualify,
            id=f'{robot}-{found}-{number}',
        )
        for robot in ('irb120', 'ur5e', 'panda')
        for number, (change, found) in enumerate(CHANGES)
    ],
)
def test_one_change_is_found_and_nothing_else_is(robot, change, found):
    session = spoilt(scene(robot, 30, 3), **change)
    given = fit_arrangement(session, Arrangement.given(session.measurements.q.shape[1]))
    assert given.gross
    fitting = search(session, given, LENGTHS)
    best = fitting[0]
    assert best.error_m < 0.5e-3
    plain = vars(given.arrangement)
    other = {key for key, value in vars(best.arrangement).items() if value != plain[key]}
    assert other == {found}
    again = arranged(session, best.arrangement)
    assert not fit_arrangement(again, given.arrangement).gross


@pytest.mark.parametrize(
    'seed', [0, *(pytest.param(seed, marks=pytest.mark.qualify) for seed in (1, 2, 3, 4))]
)
def test_a_right_table_is_not_gross_and_nonsense_has_no_remedy(seed):
    session = scene('irb120', 30, seed)
    given = Arrangement.given(6)
    assert not fit_arrangement(session, given).gross
    rng = np.random.default_rng(seed)
    nonsense = spoilt(session, q=rng.permutation)
    fitted = fit_arrangement(nonsense, given)
    assert fitted.gross
    assert search(nonsense, fitted, LENGTHS) == []


def test_a_mirrored_arm_is_also_one_with_joints_reversed():
    """Both are returned: no data distinguish them."""
    session = spoilt(scene('irb120', 30, 0), points=lambda p: p[:, [1, 0, 2]])
    fitted = fit_arrangement(session, Arrangement.given(6))
    fitting = search(session, fitted, LENGTHS)
    assert fitting[0].arrangement == replace(Arrangement.given(6), mirrored=True)
    assert fitting[1].arrangement == replace(Arrangement.given(6), signs=(-1, 1, 1, -1, 1, -1))


def test_of_many_rows_some_are_tried_and_of_few_none():
    session = scene('irb120', 400, 1)
    part = some_rows(session).measurements
    assert len(part) == 200
    assert part.observation[[0, -1]].tolist() == [0, 399]
    few = spoilt(scene('irb120', 10, 1), q=lambda q: -q)
    assert search(few, fit_arrangement(few, Arrangement.given(6))) == []
