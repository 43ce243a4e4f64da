# SPDX-License-Identifier: Apache-2.0
"""Settings, behaviour and refusals of the fake laser tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.sensors.laser_tracker.codes import Change, Command, Status
from remaster_ros.sensors.laser_tracker.packets import (
    Value,
)

LENGTH_UNITS_M = (1.0, 1e-3, 1e-6, 0.3048, 0.9144, 0.0254)
"""Metre, millimetre, micron, foot, yard, inch."""
REFLECTORS = {1: (1, 0.01905, 'CCR 1.5in'), 2: (1, 0.00635, 'CCR 0.5in')}
"""Number -> target type (corner cube), surface offset (m), name."""


class Setting(NamedTuple):
    """Command that reads a setting, event of its change, and initial values."""

    get: Command
    change: Change
    initial: tuple[Value, ...]


SETTINGS = {
    Command.SET_UNITS: Setting(Command.GET_UNITS, Change.UNITS, (1, 0, 0, 0, 0)),
    Command.SET_ENVIRONMENT: Setting(
        Command.GET_ENVIRONMENT, Change.ENVIRONMENT, (20.0, 1013.25, 50.0)
    ),
    Command.SET_MEASUREMENT_MODE: Setting(
        Command.GET_MEASUREMENT_MODE, Change.MEASUREMENT_MODE, (0,)
    ),
    Command.SET_COORDINATE_SYSTEM_TYPE: Setting(
        Command.GET_COORDINATE_SYSTEM_TYPE, Change.COORDINATE_SYSTEM_TYPE, (0,)
    ),
    Command.SET_STATIONARY_MODE: Setting(
        Command.GET_STATIONARY_MODE, Change.STATIONARY_MODE, (1000, 1)
    ),
    Command.SET_REFLECTOR: Setting(Command.GET_REFLECTOR, Change.REFLECTOR, (1,)),
    Command.SET_SEARCH: Setting(Command.GET_SEARCH, Change.SEARCH, (50.0, 10_000)),
    Command.SET_STATISTIC_MODE: Setting(Command.GET_STATISTIC_MODE, Change.STATISTIC_MODE, (0, 0)),
}
"""The environment is temperature (°C), pressure (mbar) and relative humidity (%) of the air."""


@dataclass(frozen=True)
class TrackerBehaviour:
    """Durations, speeds, accuracy and failure rates of the fake tracker; world time in s, m."""

    # Time from switching on until it can be initialised (two hours on a real one)
    warm_up_s: float = 5.0
    initialise_s: float = 2.0  # Duration of the initialisation
    # Speed of turning to a position, and additional time of each turn
    slew_rad_s: float = 1.0
    slew_settle_s: float = 0.3
    # Pitch and speed of the search's spiral, at the reflector
    spiral_pitch_m: float = 0.02
    spiral_speed_m_s: float = 3.0
    # Time from the first return of light to a lock with a valid absolute distance
    acquire_s: float = 1.0
    search_failure_share: float = 0.02  # Share of searches that find nothing for no visible reason
    tracking_speed_m_s: float = 4.0  # Speed across the beam above which it loses the reflector
    # Angle of a large move of a joint, and share of large moves that break the beam (gimbal and
    # reflector shake); the line of sight breaks others
    large_move_rad: float = 1.5
    large_move_break_share: float = 0.25
    # The ADM refuses a reflector that leaves a sphere of this radius while it integrates
    stability_limit_m: float = 50e-6
    # Accuracy limits (two standard deviations): a constant, and parts per million of distance
    range_limit_m: float = 10e-6
    range_limit_ppm: float = 0.3
    across_limit_m: float = 15e-6
    across_limit_ppm: float = 6.0


def refusal(command: Command, values: tuple[Value, ...]) -> Status:
    """Status with the reason why a setting is refused, or `Status.ALL_OK`.

    ``command``: that sets it; ``values``: its arguments. Refused are values that are not
    finite; lengths in other units than `LENGTH_UNITS_M`, pressure in other units than mbar or
    hPa, and any other unit than 0; modes other than 0; unknown reflectors; air or search
    values out of range.
    """
    numbers = np.array(values, float)
    if not np.all(np.isfinite(numbers)):
        return Status.INVALID_INPUT_DATA
    if command is Command.SET_UNITS:
        length, angle, temperature, pressure, humidity = numbers
        known = length < len(LENGTH_UNITS_M) and angle == temperature == humidity == 0
        # The second pressure unit, hPa, is the first one, mbar.
        return Status.ALL_OK if known and pressure < 2 else Status.NOT_IMPLEMENTED
    if command in (
        Command.SET_MEASUREMENT_MODE,
        Command.SET_COORDINATE_SYSTEM_TYPE,
        Command.SET_STATISTIC_MODE,
    ):
        return Status.NOT_IMPLEMENTED if np.any(numbers) else Status.ALL_OK
    if command is Command.SET_REFLECTOR:
        return Status.ALL_OK if values[0] in REFLECTORS else Status.WRONG_PARAMETER_1
    if command is Command.SET_ENVIRONMENT:
        temperature, pressure, humidity = numbers
        inside = -20 <= temperature <= 60 and 500 <= pressure <= 1200 and 0 <= humidity <= 100
        return Status.ALL_OK if inside else Status.METEO_DATA_OUT_OF_RANGE
    # The remaining settings are the search and the stationary mode: radius and time, time and
    # flag.
    return Status.ALL_OK if numbers[0] > 0 and numbers[1] >= 0 else Status.WRONG_PARAMETER
