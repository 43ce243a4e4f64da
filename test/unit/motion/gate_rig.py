# SPDX-License-Identifier: Apache-2.0
"""A gate that judges whatever waypoints a test wants to see judged."""

import copy
import dataclasses
import re

import numpy as np

from remaster_ros.motion import motion_gate
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.motion.motion_gate import MotionGate, MotionRefusedError
from remaster_ros.motion.path_check import FreePath
from remaster_ros.motion.trajectory import Waypoint

SLIDES = JointUnits((True, False))


class Planned:
    """Stands where `plan_trajectory` does."""

    def __init__(self, waypoints, unit):
        self._waypoints = tuple(
            Waypoint(time_s, np.array(q, float) * unit, np.array(v, float) * unit)
            for time_s, q, v in waypoints
        )

    def waypoints(self):
        return self._waypoints


class Converted:
    """Speeds of the points of an arm, for one whose joints have other units."""

    def __init__(self, speeds, unit):
        self.speeds, self.unit = copy.deepcopy(speeds), unit

    def fastest(self, q, velocity):
        return self.speeds.fastest(q / self.unit, velocity / self.unit)


def judge(monkeypatch, waypoints, along, start, limits, speeds=None):
    """Return why the gate refuses waypoints, planned by whomever; '' where it admits them.

    Where both joints of the limits turn, the same arm with a first joint that slides, a quarter of
    a metre for each radian, has to be judged the same way.
    """
    why = _judged(monkeypatch, waypoints, along, start, limits, speeds)
    if not any(limits.units.slides):
        unit = SLIDES.per_radian
        names = ('lower', 'upper', 'velocity', 'acceleration')
        converted = {name: getattr(limits, name) * unit for name in names}
        sliding = dataclasses.replace(limits, units=SLIDES, **converted)
        converted_speeds = None if speeds is None else Converted(speeds, unit)
        said = _judged(monkeypatch, waypoints, along, start, sliding, converted_speeds, unit)
        assert without_figures(said) == without_figures(why)
    return why


def _judged(monkeypatch, waypoints, along, start, limits, speeds, unit=1.0):
    monkeypatch.setattr(motion_gate, 'plan_trajectory', lambda *_: Planned(waypoints, unit))
    gate = MotionGate(limits, speeds)
    try:
        gate.admit(FreePath(np.array(along, float) * unit), np.asarray(start, float) * unit)
    except MotionRefusedError as error:
        assert gate.refused == 1
        return str(error)
    assert gate.refused == 0
    return ''


def without_figures(text):
    text = re.sub(r'\[[-\d.]+, [-\d.]+\] (deg|mm)', '#', text)
    return re.sub(r'([-+]?[\d.]+|nan)( (deg|mm|rad)(/s2?)?)?', '#', text)
