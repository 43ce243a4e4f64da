# SPDX-License-Identifier: Apache-2.0
"""A real bridge and an arm that obeys everything: nothing it commands may be what it must not be.

The arm, the man in the middle and the judge are the tests' own, in test/hostile.
Three hundred random injections take some ten minutes; HOSTILE_INJECTIONS=1000 makes
as many.
"""

import os

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
pytest.importorskip('pinocchio', reason='the judge needs pinocchio (pip install .[test])')

from hostile.campaign import in_parallel
from hostile.judge import Rules
from hostile.known import known_situations, situations
from hostile.outcomes import report

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

# The demo cell states no bound of acceleration, so that the cautious default holds, rad/s².
RULES = Rules(speed_share=0.3, cartesian_m_s=0.25, acceleration=np.full(7, 5.0))
# The other system tests take the domains below these.
DOMAINS = range(192 + 4 * (os.getpid() % 9), 196 + 4 * (os.getpid() % 9))
SEED = int(os.environ.get('HOSTILE_SEED', '9'))
INJECTIONS = int(os.environ.get('HOSTILE_INJECTIONS', '300'))


QUICK = ('emergency stop pressed and driver silent',)
SITUATIONS = [
    pytest.param(name, marks=() if name.startswith(QUICK) else pytest.mark.qualify)
    for name, *_ in situations()
]


@pytest.mark.parametrize('name', SITUATIONS)
def test_a_situation_in_which_the_first_bridge_commanded_what_must_not_be(name, tmp_path):
    (situation,) = known_situations(tmp_path, RULES, DOMAINS[0], wanted=name)
    assert not situation.outcome.wrong(RULES), situation.cells(RULES)


@pytest.mark.qualify
@pytest.mark.timeout(900 + 8 * INJECTIONS)
@pytest.mark.parametrize('curves', [False, True], ids=['lines', 'curves'])
def test_random_injections(tmp_path, curves):
    """HOSTILE_SEED=n draws others; the moments are never the same."""
    outcomes, broken = [], []
    campaign = in_parallel(SEED, INJECTIONS, tmp_path, RULES, DOMAINS, chunk=10, curves=curves)
    for chunk, error in campaign:
        outcomes += chunk
        broken += [error] if error else []
    print(f'seed {SEED}')
    print(report(outcomes, RULES))
    assert not broken
    assert len(outcomes) == INJECTIONS
    assert sum(len(outcome.judgements) for outcome in outcomes) >= INJECTIONS, (
        'hardly anything moved'
    )
    wrong = [f'{o.kind}: {"; ".join(o.wrong(RULES))}' for o in outcomes if o.wrong(RULES)]
    assert not wrong
