# SPDX-License-Identifier: Apache-2.0
"""Sensors and joint states for tests of the pairing."""

import numpy as np

from remaster_ros.collection.pairing import SensorRules
from remaster_ros.types import MarkerReading

STREAM = SensorRules('mocap', 'sir', dwell_s=0.5, min_samples=5, max_std_m=5e-4, timeout_s=2.0)
SHOT = SensorRules('tracker', 'smr', single_shot=True, timeout_s=10.0)
Q = np.array([0.1, 0.2, 0.3])


def run(pairing, *, until=1.0, offset=0.0, q=Q, skip_stream=False, start=10.0):
    """Feed joint states at 50 Hz and stream readings at 100 Hz until `until` s after settling."""
    events = [(start + t, 'q') for t in np.arange(-0.1, until, 0.02)]
    if not skip_stream:
        events += [(start + t, 'p') for t in np.arange(-0.1, until, 0.01)]
    for stamp, kind in sorted(events):
        if kind == 'q':
            pairing.add_joint_state(stamp, q + offset * (stamp > start + 0.2))
        else:
            position = np.array([stamp, 0.0, 0.0]) * 1e-6
            pairing.add_reading('mocap', MarkerReading(stamp, position))
    return pairing
