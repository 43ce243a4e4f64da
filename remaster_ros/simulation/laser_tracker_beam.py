# SPDX-License-Identifier: Apache-2.0
"""Beam of the fake laser tracker: it follows a reflector, or loses it; its errors.

The beam follows while nothing is in its way, the reflector faces it and does not outrun it.
Large moves of the arm lose it now and then even so. Errors are those of a data sheet, in range
and angles: limits of 10 µm + 0.3 µm/m along the beam and 15 µm + 6 µm/m across it, at two
standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from remaster_ros.sensors.laser_tracker.packets import (
    Measurement,
)
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour
from remaster_ros.simulation.world import World
from remaster_ros.types import FloatArray

STEP_S = 0.1
"""World time between two steps of the instrument, s."""
_SIGHT_EVERY_S = 0.5


class Beam:
    """Laser beam of the tracker: its direction, and whether it is locked on a reflector.

    ``world, sensor``: the hidden world, and the tracker's name in it; ``t``: world time, s;
    ``aim``: first aim in the tracker's frame, m, (3,), or None for the reflector; ``further``:
    further reflectors of the tool by name, with their numbers for the fault ``hidden``; the
    first has the name '' and the number 1.
    """

    def __init__(
        self,
        world: World,
        sensor: str,
        rng: np.random.Generator,
        behaviour: TrackerBehaviour,
        t: float,
        aim: FloatArray | None,
        further: Mapping[str, int] | None = None,
    ) -> None:
        self._world, self._sensor, self._rng = world, sensor, rng
        self._behaviour = behaviour
        self._numbers = {'': 1, **(further or {})}
        # Name of the reflector that the beam is locked on.
        self._on = ''
        self.locked = False
        self.aim = self.reflector(t) if aim is None else np.asarray(aim, float)
        self._sight_at = -np.inf
        self._swept_rad = 0.0
        self._move_judged = False

    def reflector(self, t: float) -> FloatArray:
        """True position of the selected reflector in the tracker's frame at time t, s, m, (3,)."""
        return self._world.marker_in_sensor(self._sensor, t, self._on)

    def sees(self, t: float) -> bool:
        """Whether the line of sight to the selected reflector is free at world time t, s.

        False also with the fault ``hidden`` of this reflector's number.
        """
        if self._world.faults(self._sensor).get('hidden') == self._numbers[self._on]:
            return False
        return self._world.line_of_sight(self._sensor, t, self._on)

    def find(self, target: FloatArray, largest_rad: float, t: float) -> bool:
        """Select the visible reflector nearest to a direction; False if none is near enough.

        ``target``: in the tracker's frame, of any length but 0, (3,); ``largest_rad``: largest
        angle from it. The beam is not locked; without a reflector the former one stays selected.
        """
        before, angles = self._on, {}
        for name in self._numbers:
            self._on = name
            angle = angle_between(target, self.reflector(t))
            if angle <= largest_rad and self.sees(t):
                angles[name] = angle
        self._on = min(angles, key=angles.__getitem__, default=before)
        return bool(angles)

    def lock(self, t: float) -> None:
        """Lock on the selected reflector and aim at it, at time t, s."""
        self.locked, self.aim, self._sight_at = True, self.reflector(t), t
        self._swept_rad, self._move_judged = 0.0, False

    def follow(self, t: float) -> bool:
        """Follow the reflector for a step that ends at time t, s; False if the beam loses it.

        The beam loses it if it is hidden (looked up at every step while the arm moves, else
        every 0.5 s), outruns the beam, or a large move shakes it. The beam is then not locked,
        and the aim stays where the reflector was lost. To be called only while the beam is
        locked.
        """
        reflector, moving = self.reflector(t), self._world.is_moving(t)
        across_speed = angle_between(self.aim, reflector) * np.linalg.norm(reflector) / STEP_S
        # The line of sight takes long to compute, and changes little while the arm stands still.
        hidden = False
        if moving or t - self._sight_at > _SIGHT_EVERY_S:
            hidden, self._sight_at = not self.sees(t), t
        outrun = across_speed > self._behaviour.tracking_speed_m_s
        if self._shaken(t, moving) or hidden or outrun:
            self.locked = False
        else:
            self.aim = reflector
        return self.locked

    def _shaken(self, t: float, moving: bool) -> bool:
        """Decide whether a large move breaks the beam in this step; at random, once for each move.

        A move is large once the way of the fastest joint, summed over steps, is over
        ``large_move_rad``. `t`: end of the step, s; ``moving``: whether the arm moves then.
        """
        if not moving:
            self._swept_rad, self._move_judged = 0.0, False
            return False
        self._swept_rad += self._world.joint_speed(t) * STEP_S
        if self._move_judged or self._swept_rad <= self._behaviour.large_move_rad:
            return False
        self._move_judged = True
        return self._rng.random() < self._behaviour.large_move_break_share


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle between two directions (3,), rad, 0 to π; exact for small ones too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def covariance(position: FloatArray, behaviour: TrackerBehaviour) -> FloatArray:
    """Covariance of a measured position, m², (3, 3), with independent errors of range and angles.

    By the accuracy limits in ``behaviour``, which are two standard deviations. ``position``:
    in the tracker's frame, m, (3,).
    """
    b = behaviour
    distance = np.linalg.norm(position)
    range_std = 0.5 * (b.range_limit_m + b.range_limit_ppm * 1e-6 * distance)
    across_std = 0.5 * (b.across_limit_m + b.across_limit_ppm * 1e-6 * distance)
    along = np.outer(position, position) / distance**2
    return range_std**2 * along + across_std**2 * (np.eye(3) - along)


def adm_result(
    position: FloatArray,
    std: FloatArray,
    unit_m: float,
    environment: tuple[float, float, float],
) -> Measurement:
    """Packet of a measured position, m, (3,), and its standard deviation, m, (3,).

    ``unit_m``: the client's unit of length, m, to which they are converted; ``environment``:
    temperature (°C), pressure (mbar), relative humidity (%).
    """
    x, y, z = (position / unit_m).tolist()
    std_x, std_y, std_z = (std / unit_m).tolist()
    total = float(np.linalg.norm(std)) / unit_m
    temperature, pressure, humidity = environment
    return Measurement(
        status=0,
        mode=0,
        is_try=0,
        values=(x, y, z),
        std=(std_x, std_y, std_z),
        std_total=total,
        pointing_error=(0.0, 0.0, 0.0),
        a_priori_std=(std_x, std_y, std_z),
        a_priori_std_total=total,
        temperature=temperature,
        pressure=pressure,
        humidity=humidity,
    )
