"""What may drive an error: time, temperature, angles, torques and moves of joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Driver:
    """What may drive an error."""

    # As the cells have them
    name: str
    unit: str
    value: Callable[[Context], FloatArray]  # Its value in each row, (n,)
    # For people: what it is, in which unit, and how much of ``unit`` makes one of that
    label: str
    shown_unit: str = ''
    per_shown: float = 1.0
    joint: int = 0  # The joint (1-based) that it belongs to; 0 where it belongs to none
    is_angle: bool = False  # It is that joint's angle

    def curve(
        self, context: Context, share: float, finest: float = 0.0, rows: BoolArray | None = None
    ) -> Curve:
        """Return a free form of it over the rows to fit, or those of them in ``rows`` (n,).

        ``share`` and ``finest`` are those of `Curve.of`.
        """
        chosen = context.to_fit if rows is None else context.to_fit & rows
        turns_over = self.is_angle and context.turns_over(self.joint)
        return Curve.of(self.value(context)[chosen], share, finest, turns_over)


TIME = Driver('time', 's', lambda context: context.elapsed_s, 'time', 'h', 3600.0)
TEMPERATURE = Driver(
    'temperature', 'K', lambda context: context.warming, 'temperature above the first', 'K'
)


def slow_drivers(context: Context) -> list[Driver]:
    """Return the drivers that change over the session."""
    found = [TIME] if context.has_time else []
    return found + ([TEMPERATURE] if context.has_temperature else [])


def angle_of(joint: int, name: str = 'own_angle') -> Driver:
    """Return the angle of a joint (1-based)."""
    return Driver(
        name,
        'rad',
        lambda context: context.measurements.q[:, joint - 1],
        f'angle of joint {joint}',
        '°',
        np.radians(1.0),
        joint,
        is_angle=True,
    )


def torque_of(joint: int, name: str = 'gravity_torque') -> Driver:
    """Return gravity's torque about a joint."""
    return Driver(
        name,
        '(N m)',
        lambda context: context.gravity_torque[:, joint - 1],
        f'gravity torque on joint {joint}',
        'N m',
        joint=joint,
    )


def approach_of(joint: int, name: str) -> Driver:
    """Return the side that a joint came from."""
    return Driver(
        name,
        '1',
        lambda context: context.approach[:, joint - 1],
        f'approach of joint {joint}',
        joint=joint,
    )


def last_move_of(joint: int, name: str) -> Driver:
    """Return how far a joint moved to get here."""
    return Driver(
        name,
        'rad',
        lambda context: context.last_move[:, joint - 1],
        f'last move of joint {joint}',
        '°',
        np.radians(1.0),
        joint,
    )


_OF_JOINTS: dict[str, Callable[[int, str], Driver]] = {
    'own_angle': angle_of,
    'angle': angle_of,
    'gravity_torque': torque_of,
    'approach': approach_of,
    'last_move': last_move_of,
}


def driver_named(name: str, joint: int) -> Driver | None:
    """Return the driver of a cell by its name; None where it is no single number.

    ``joint`` (1-based) is that of a name which has none.
    """
    stem, _, given = name.partition('_of_joint_')
    if stem in _OF_JOINTS:
        return _OF_JOINTS[stem](int(given or joint), name)
    return next((driver for driver in (TIME, TEMPERATURE) if driver.name == name), None)
