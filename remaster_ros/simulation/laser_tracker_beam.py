"""The beam of the fake laser tracker: it follows a reflector, or loses it; its errors.

The beam follows while nothing is in its way, the reflector faces it and does not outrun it. Large
moves of the arm lose it now and then even so. Errors are those of a data sheet, in range and
angles: limits of 10 µm + 0.3 µm/m along the beam and 15 µm + 6 µm/m across it, at two standard
deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.sensors.laser_tracker.protocol.packets import Measurement
from remaster_ros.simulation.laser_tracker_settings import TrackerBehaviour
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.simulation.world import World

STEP_S = 0.1
"""World time between two looks at the world."""
_SIGHT_EVERY_S = 0.5


class Beam:
    """Where the instrument points, and whether it is locked on the reflector.

    Parameters
    ----------
    world, sensor
        Where the reflector truly is, and the tracker's name in the world.
    rng
        Source of all randomness.
    behaviour
        See `TrackerBehaviour`.
    t
        World time, s.
    aim
        Where it points at first, in its own frame, m, (3,); None: at the reflector.
    further
        Further reflectors of the tool by name, with the numbers of the fault ``hidden``; the
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
        # The reflector that it is locked on.
        self._on = ''
        self.locked = False
        self.home = self.reflector(t) if aim is None else np.asarray(aim, float)
        self.aim = self.home
        self._sight_at = -np.inf
        self._swept_rad = 0.0
        self._move_judged = False

    def reflector(self, t: float) -> FloatArray:
        """True position of the reflector that it is on at time t, m, (3,)."""
        return self._world.marker_in_sensor(self._sensor, t, self._on)

    def sees(self, t: float) -> bool:
        """Whether the line of sight to this reflector is free at time t."""
        if self._world.faults(self._sensor).get('hidden') == self._numbers[self._on]:
            return False
        return self._world.line_of_sight(self._sensor, t, self._on)

    def find(self, target: FloatArray, largest_rad: float, t: float) -> bool:
        """Find the reflector in sight nearest to a direction; False where none is so near."""
        before, near = self._on, {}
        for name in self._numbers:
            self._on = name
            angle = angle_between(target, self.reflector(t))
            if angle <= largest_rad and self.sees(t):
                near[name] = angle
        self._on = min(near, key=near.__getitem__, default=before)
        return bool(near)

    def lock(self, t: float) -> None:
        """Lock on the reflector that was found, at time t."""
        self.locked, self.aim, self._sight_at = True, self.reflector(t), t
        self._swept_rad, self._move_judged = 0.0, False

    def follow(self, t: float) -> bool:
        """Follow the reflector for a step that ends at time t; return whether it is kept."""
        reflector, moving = self.reflector(t), self._world.is_moving(t)
        across_speed = angle_between(self.aim, reflector) * np.linalg.norm(reflector) / STEP_S
        # The line of sight takes long to work out, and changes little while nothing moves.
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
        """Whether a large move breaks the beam now; chance decides once for each move."""
        if not moving:
            self._swept_rad, self._move_judged = 0.0, False
            return False
        self._swept_rad += self._world.joint_speed(t) * STEP_S
        if self._move_judged or self._swept_rad <= self._behaviour.large_move_rad:
            return False
        self._move_judged = True
        return self._rng.random() < self._behaviour.large_move_break_share


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle between two directions, rad; exact for small ones too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def covariance(position: FloatArray, behaviour: TrackerBehaviour) -> FloatArray:
    """Covariance of a measured position, m², (3, 3): range and angles err on their own.

    The limits of a data sheet are two standard deviations.
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
    """Return the packet of a measured position and its standard deviation (m, (3,) each).

    Parameters
    ----------
    unit_m
        The client's unit of length, m.
    environment
        Temperature (°C), pressure (mbar), relative humidity (%).
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
