# SPDX-License-Identifier: Apache-2.0
"""What begins or ends in mid-session is named with its moment, and loaded as it was at the end."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.changing_sessions import changing_session
from worlds.hidden_sessions import Recipe

from remaster_ros.compensation.of_result import arm_of_effects
from remaster_ros.discovery.discover import discover_session

WITHIN = 0.05
"""Share of a session within which the moment is found, and is stated to be."""
MULTIPLE = 6.0
"""Of the size that can be detected in a whole session; each case alone is missed in one of some
fifty (benchmarks/bench_changes.py)."""


@pytest.mark.parametrize(
    ('kind', 'share', 'ends'),
    [
        ('joint_compliance', 0.5, False),
        ('joint_compliance', 0.5, True),
        pytest.param('backlash', 0.3, True, marks=pytest.mark.qualify),
        pytest.param('settling', 0.7, False, marks=pytest.mark.qualify),
        pytest.param('sensor_scale', 0.5, False, marks=pytest.mark.qualify),
        pytest.param('registration_drift', 0.5, False, marks=pytest.mark.qualify),
        pytest.param('base_compliance', 0.5, True, marks=pytest.mark.qualify),
    ],
)
def test_the_cause_is_named_with_its_moment(kind: str, share: float, ends: bool) -> None:
    seed = 20261129
    print(f'seed {seed}')
    hidden = changing_session(Recipe(seed, (kind,), MULTIPLE), share, ends=ends)
    found = discover_session(hidden.session, rng=np.random.default_rng(seed))
    (effect,) = found.effects
    assert effect.name == kind
    assert {*effect.joints} <= {*hidden.joints} or not hidden.joints
    assert effect.moment_s == pytest.approx(hidden.moment_s, abs=WITHIN * hidden.duration_s)
    assert ('It ended' if ends else 'It began') in effect.cause
    assert ('until' if ends else 'from') in effect.title
    assert 'Find what was changed at that moment' in effect.remedy
    # What ended is not loaded.
    candidates = [candidate for group in found.groups for candidate in group]
    terms = arm_of_effects(found.fit, candidates, found.residuals).model.joint_terms
    loaded = ['gravity_torque'] if kind == 'joint_compliance' and not ends else []
    if kind in ('joint_compliance', 'backlash'):
        assert [term.function.driver for term in terms] == loaded


def test_a_session_without_times_has_no_moments() -> None:
    hidden = changing_session(Recipe(20261129, ('backlash',), MULTIPLE), 0.5)
    session = replace(hidden.session, timed=False)
    found = discover_session(session, rng=np.random.default_rng(0))
    assert all(effect.moment_s is None for effect in found.effects)
