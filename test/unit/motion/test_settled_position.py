"""Where an arm has settled is the mean of what it reported while it stood still."""

import numpy as np
from supervisor_rig import HOME, Rig

from remaster_ros.motion.actions import Settled

# Within what counts as still, 2e-4 rad.
SWAY = 5e-5


def test_the_settled_position_is_the_mean_and_not_the_last_report():
    rig = Rig()
    target = HOME + np.array([0.2, -0.1])
    seen = []

    def sway(t, q):
        """Mostly to one side: the mean is neither first nor last nor the middle."""
        q = q + SWAY * (1.0 if len(seen) % 4 else -1.0)
        seen.append((t, q))
        return q

    rig.alter = sway
    rig.plan(target)
    rig.run(10.0, lambda: rig.said(Settled))
    said = rig.last(Settled)
    since = said.stamp_s - said.settle_s
    still = np.array([q for t, q in seen if since - 1e-9 <= t <= said.stamp_s + 1e-9])
    assert len(still) > 40
    np.testing.assert_allclose(said.q, still.mean(axis=0), atol=1e-12)
    for wrong in (still[-1], still[0], (still.min(axis=0) + still.max(axis=0)) / 2, target):
        assert np.abs(said.q - wrong).min() > 1e-5
