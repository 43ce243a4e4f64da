# SPDX-License-Identifier: Apache-2.0
"""Sag or a base that yields: decided by what separates them, in a world of its own."""

import numpy as np
import pytest

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from worlds.hidden_pairs import measured_further, pair_session, separating, verdict, visits_of

from remaster_ros.discovery.decision import Named, decisions
from remaster_ros.discovery.discover import discover_session
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import MOST_ADDED

pytestmark = pytest.mark.timeout(600)


@pytest.mark.qualify
def test_a_sag_that_looks_like_a_base_that_yields_is_decided():
    # One that the search leaves open, and whose look-alikes it names.
    number = 49
    print('session', number)
    pair = pair_session(number)
    assert (pair.true, pair.other) == (('joint_compliance', (2,)), ('base_compliance', ()))
    before = discover_session(pair.session, rng=np.random.default_rng(number))
    assert verdict(before, pair, pair.world, pair.truth) in ('open', 'wrong')
    causes = [FoundCause.of(effect) for effect in before.effects]
    design = separating(pair, causes)
    assert 0 < len(design.order) <= MOST_ADDED
    session, world, truth = measured_further(pair, visits_of(pair, design))
    after = discover_session(session, rng=np.random.default_rng(number))
    assert verdict(after, pair, world, truth) == 'right'
    (decision,) = decisions(after, [(Named(*pair.true), Named(*pair.other))])
    assert decision.answer == 'cause'
    assert decision.sigma > 1.6
    # What was measured first is as it was, and the rest is behind it.
    rows = session.measurements
    n = len(pair.session.measurements)
    np.testing.assert_array_equal(rows.position[:n], pair.session.measurements.position)
    assert rows.stamp_s[n] - rows.stamp_s[n - 1] > 100.0
    assert len(rows) == n + len(design.order)
