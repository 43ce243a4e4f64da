"""What may drive an error: time, temperature, angles, torques and moves of joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from remaster_ros.discovery.effects.context import Context
from remaster_ros.types import FloatArray


@dataclass(frozen=True, eq=False)
class Driver:
    """What may drive an error: its name, unit, and value in each row, (n,).

    ``joint`` is the joint (1-based) that it belongs to; 0 where it belongs to none.
    """

    name: str
    unit: str
    value: Callable[[Context], FloatArray]
    joint: int = 0


TIME = Driver('time', 's', lambda context: context.elapsed_s)
TEMPERATURE = Driver('temperature', 'K', lambda context: context.warming)


def slow_drivers(context: Context) -> list[Driver]:
    """Return the drivers that change over the session."""
    found = [TIME] if context.has_time else []
    return found + ([TEMPERATURE] if context.has_temperature else [])


def angle_of(joint: int, name: str = 'own_angle') -> Driver:
    """Return the angle of a joint (1-based)."""
    return Driver(name, 'rad', lambda context: context.measurements.q[:, joint - 1], joint)


def torque_of(joint: int, name: str = 'gravity_torque') -> Driver:
    """Return gravity's torque about a joint."""
    return Driver(name, '(N m)', lambda context: context.gravity_torque[:, joint - 1], joint)


def approach_of(joint: int, name: str) -> Driver:
    """Return the side that a joint came from."""
    return Driver(name, '1', lambda context: context.approach[:, joint - 1], joint)


def last_move_of(joint: int, name: str) -> Driver:
    """Return how far a joint moved to get here."""
    return Driver(name, 'rad', lambda context: context.last_move[:, joint - 1], joint)
