"""Drivers of an error: time, temperature, angles, torques and moves of joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import BoolArray, FloatArray

# What people read of joints that turn, and of those that slide: the unit, and how much of rad or m
# makes one.
_SHOWN = {False: ('°', np.radians(1.0)), True: ('mm', 1e-3)}
# What drives where a joint turns, and its name where it slides.
_OF_SLIDES = {
    'own_angle': 'own_place',
    'angle': 'place',
    'gravity_torque': 'gravity_force',
}


@dataclass(frozen=True, eq=False)
class Driver:
    """Quantity on which an error may depend, such as time or an angle: name, unit, values."""

    # As the candidates have them
    name: str
    unit: str
    value: Callable[[Context], FloatArray]  # Its value in each row, (n,)
    # For people: what it is, in which unit, and how much of ``unit`` makes one of that
    label: str
    shown_unit: str = ''
    per_shown: float = 1.0
    joint: int = 0  # The joint (1-based) that it belongs to; 0 if it belongs to none
    is_angle: bool = False  # It is that joint's angle

    def curve(
        self, context: Context, share: float, finest: float = 0.0, rows: BoolArray | None = None
    ) -> Curve:
        """Return a spline over the driver's values in the rows to fit, of zero mean over them.

        ``share``: distance of the knots as a share of the range of values; ``finest``: least
        distance, in the driver's unit; ``rows``: mask, (n,): only rows to fit among these count.
        """
        chosen = context.to_fit if rows is None else context.to_fit & rows
        turns_over = self.is_angle and context.turns_over(self.joint)
        return Curve.of(self.value(context)[chosen], share, finest, turns_over)


TIME = Driver('time', 's', lambda context: context.elapsed_s, 'time', 'h', 3600.0)
TEMPERATURE = Driver(
    'temperature', 'K', lambda context: context.warming, 'temperature above the first', 'K'
)


def slow_drivers(context: Context) -> list[Driver]:
    """Return the drivers time and temperature, each if it is known and varies in the session."""
    found = [TIME] if context.has_time else []
    return found + ([TEMPERATURE] if context.has_temperature else [])


def driver_at(context: Context, joint: int, name: str) -> str:
    """Return the name of a joint's (1-based) driver: ``name``, or another one if the joint slides.

    Of a joint that slides 'angle_of_joint_2' becomes 'place_of_joint_2', for example.
    """
    stem, of, number = name.partition('_of_joint_')
    return _OF_SLIDES.get(stem, stem) + of + number if context.slides(joint) else name


def angle_of(context: Context, joint: int, name: str = 'own_angle') -> Driver:
    """Return the driver that is a joint's measured angle, rad, or position, m, if it slides.

    ``joint``: 1-based; ``name``: of the driver if the joint turns.
    """
    slides = context.slides(joint)
    return Driver(
        driver_at(context, joint, name),
        context.chain.units[joint - 1],
        lambda context: context.measurements.q[:, joint - 1],
        f'{"place" if slides else "angle"} of joint {joint}',
        *_SHOWN[slides],
        joint,
        is_angle=True,
    )


def torque_of(context: Context, joint: int, name: str = 'gravity_torque') -> Driver:
    """Return the driver that is gravity's torque about a joint, N m, or its force on a slide, N.

    ``joint``: 1-based; ``name``: of the driver if the joint turns.
    """
    slides = context.slides(joint)
    return Driver(
        driver_at(context, joint, name),
        context.chain.torque_units[joint - 1],
        lambda context: context.gravity_torque[:, joint - 1],
        f'gravity {"force" if slides else "torque"} on joint {joint}',
        'N' if slides else 'N m',
        joint=joint,
    )


def approach_of(context: Context, joint: int, name: str) -> Driver:
    """Return the driver that is the sign of a joint's last move: 1, -1, or 0 before the first.

    ``joint``: 1-based; ``name``: of the driver.
    """
    return Driver(
        name,
        '1',
        lambda context: context.approach[:, joint - 1],
        f'approach of joint {joint}',
        joint=joint,
    )


def last_move_of(context: Context, joint: int, name: str) -> Driver:
    """Driver `name`: signed move of a joint to get here, rad or m, 0 if unknown.

    ``joint``: number of the joint, from 1.
    """
    return Driver(
        name,
        context.chain.units[joint - 1],
        lambda context: context.last_move[:, joint - 1],
        f'last move of joint {joint}',
        *_SHOWN[context.slides(joint)],
        joint,
    )


_OF_JOINTS: dict[str, Callable[[Context, int, str], Driver]] = {
    'own_angle': angle_of,
    'own_place': angle_of,
    'angle': angle_of,
    'place': angle_of,
    'gravity_torque': torque_of,
    'gravity_force': torque_of,
    'approach': approach_of,
    'last_move': last_move_of,
}


def driver_named(context: Context, name: str, joint: int) -> Driver | None:
    """Return the driver of a name, such as 'time', 'own_angle' or 'angle_of_joint_2'.

    ``joint`` (1-based): the driver's joint if the name has none. None if the name is not that of
    a single quantity.
    """
    stem, _, given = name.partition('_of_joint_')
    if stem in _OF_JOINTS:
        return _OF_JOINTS[stem](context, int(given or joint), name)
    return next((driver for driver in (TIME, TEMPERATURE) if driver.name == name), None)
