"""What can be set on the fake laser tracker: by who builds it, and by a client over the wire."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from remaster_ros.sensors.laser_tracker.protocol.packets import Change, Command, Status, Value

LENGTH_UNITS_M = (1.0, 1e-3, 1e-6, 0.3048, 0.9144, 0.0254)
"""Metre, millimetre, micron, foot, yard, inch."""

REFLECTORS = {1: (1, 0.01905, 'CCR 1.5in'), 2: (1, 0.00635, 'CCR 0.5in')}
"""Number -> target type (corner cube), surface offset (m), name."""


class Setting(NamedTuple):
    """The command that reads a setting, what is sent when it changes, the first values."""

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
    """What can be set on the fake. World time in s, lengths in m.

    Attributes
    ----------
    warm_up_s
        From switching on until it can be initialised (two hours on a real one).
    initialise_s
        How long the initialisation takes.
    slew_rad_s, slew_settle_s
        Speed of turning to a position, and what each turn takes on top.
    spiral_pitch_m, spiral_speed_m_s
        Of the search, at the reflector.
    acquire_s
        From the first return of light to a lock with a valid absolute distance.
    search_failure_share
        Share of searches that find nothing for no visible reason.
    tracking_speed_m_s
        The beam loses a reflector that moves faster across it.
    large_move_rad, large_move_break_share
        Share of the moves in which a joint turns further than that which break the beam (gimbal
        and reflector shake); the line of sight breaks others.
    stability_limit_m
        The ADM refuses a reflector that leaves a sphere of this radius while it integrates.
    range_limit_m, range_limit_ppm, across_limit_m, across_limit_ppm
        Accuracy limits (two standard deviations): a constant, and parts per million of distance.
    """

    warm_up_s: float = 5.0
    initialise_s: float = 2.0
    slew_rad_s: float = 1.0
    slew_settle_s: float = 0.3
    spiral_pitch_m: float = 0.02
    spiral_speed_m_s: float = 3.0
    acquire_s: float = 1.0
    search_failure_share: float = 0.02
    tracking_speed_m_s: float = 4.0
    large_move_rad: float = 1.5
    large_move_break_share: float = 0.25
    stability_limit_m: float = 50e-6
    range_limit_m: float = 10e-6
    range_limit_ppm: float = 0.3
    across_limit_m: float = 15e-6
    across_limit_ppm: float = 6.0


def refusal(command: Command, values: tuple[Value, ...]) -> Status:
    """Why a setting is refused, or `Status.ALL_OK`."""
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
    # What is left are the search and the stationary mode: radius and time, time and a flag.
    return Status.ALL_OK if numbers[0] > 0 and numbers[1] >= 0 else Status.WRONG_PARAMETER
