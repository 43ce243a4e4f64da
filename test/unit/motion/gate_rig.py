"""A gate that judges whatever waypoints a test wants to see judged."""

import numpy as np

from remaster_ros.motion import motion_gate
from remaster_ros.motion.motion_gate import MotionGate, MotionRefusedError
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.trajectory import Waypoint


class Planned:
    """Stands where `plan_trajectory` does."""

    def __init__(self, *waypoints):
        self._waypoints = tuple(
            Waypoint(time_s, np.array(q, float), np.array(v, float)) for time_s, q, v in waypoints
        )

    def waypoints(self):
        return self._waypoints


def judge(monkeypatch, waypoints, along, start, limits, speeds=None):
    """Return why the gate refuses waypoints, planned by whomever; '' where it admits them."""
    monkeypatch.setattr(motion_gate, 'plan_trajectory', lambda *_: Planned(*waypoints))
    gate = MotionGate(limits, speeds)
    try:
        gate.admit(FreePath(np.array(along, float)), np.asarray(start, float))
    except MotionRefusedError as error:
        assert gate.refused == 1
        return str(error)
    assert gate.refused == 0
    return ''
