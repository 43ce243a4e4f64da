"""Geometry and errors of the fake laser tracker's beam."""

from __future__ import annotations

import numpy as np

from remaster_ros.sensors.laser_tracker.protocol.packets import Measurement
from remaster_ros.simulation.laser_tracker_settings import TrackerBehaviour
from remaster_ros.types import FloatArray


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
