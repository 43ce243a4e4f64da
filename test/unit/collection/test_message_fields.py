# SPDX-License-Identifier: Apache-2.0
"""Joint positions by name: in any order, among others, and never of a joint that stands twice."""

from types import SimpleNamespace

import numpy as np
import pytest

from remaster_ros.collection.message_fields import JointOrder, correction_asked, solutions_of
from remaster_ros.errors import InputError

ARM = ('a', 'b')


def states(names, positions):
    return SimpleNamespace(name=list(names), position=list(positions))


def solutions(names, *points):
    return SimpleNamespace(
        joint_names=list(names), points=[SimpleNamespace(positions=list(p)) for p in points]
    )


def test_the_arms_joints_are_taken_from_among_others():
    """Also where another device has a joint twice: it is not moved by this program."""
    order = JointOrder(ARM)
    message = states(['finger', 'b', 'finger', 'a'], [0.1, 2.0, 0.2, 1.0])
    np.testing.assert_array_equal(order.positions(message), [1.0, 2.0])


@pytest.mark.parametrize(
    ('names', 'repeated'),
    [(['a', 'b', 'a', 'b'], 'a, b'), (['a', 'b', 'b'], 'b'), (['a', 'finger', 'a', 'b'], 'a')],
)
def test_a_joint_that_stands_twice_is_refused_by_name(names, repeated):
    order = JointOrder(ARM)
    np.testing.assert_array_equal(order.positions(states('ab', [1.0, 2.0])), [1.0, 2.0])
    words = f'has {repeated} more than once: are two arms merged in it'
    for _ in range(2):
        with pytest.raises(InputError, match=f'joint_states {words}'):
            order.positions(states(names, range(len(names))))
    with pytest.raises(InputError, match=f'joint_solutions {words}'):
        solutions_of(solutions(names, range(len(names))), ARM)
    # And what comes right again is taken again.
    np.testing.assert_array_equal(order.positions(states('ab', [1.0, 2.0])), [1.0, 2.0])


@pytest.mark.parametrize(
    ('names', 'asked'),
    [
        (['a', 'b'], ''),
        (['corrected/b', 'corrected/a'], 'on'),
        (['uncorrected/a', 'uncorrected/b'], 'off'),
    ],
)
def test_solutions_tell_whether_they_are_to_be_corrected(names, asked):
    message = solutions(names, [1.0, 2.0])
    assert correction_asked(message) == asked
    first = 0 if names[0].endswith('a') else 1
    assert solutions_of(message, ARM)[0, first] == 1.0


@pytest.mark.parametrize('names', [['corrected/a', 'b'], ['corrected/a', 'uncorrected/b']])
def test_solutions_of_which_some_are_to_be_corrected_are_refused(names):
    message = solutions(names, [1.0, 2.0])
    assert correction_asked(message) == ''
    with pytest.raises(InputError, match='they are for corrected/a'):
        solutions_of(message, ARM)
