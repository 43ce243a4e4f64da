"""Where the causes of one session were seen, and what another session has beyond.

A cause is known only where its driver was: a curve of a joint's angle says nothing of angles that
the joint never took. Angles of a joint that turns over are the same a turn further. A cause that
is constant, or linear in the position before a sensor, holds everywhere.

Two sessions in different regions hardly have a row in which the drivers of all causes were seen.
Each cause is therefore split: on the rows where its driver was seen it is compared, and on the
others a free form, fitted to them alone, takes its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Cell, Design
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import Driver, driver_named
from remaster_ros.discovery.effects.splines import Curve, in_turn, roughness, start_of_turn
from remaster_ros.types import BoolArray, FloatArray

Inside = Callable[[Context], BoolArray]


@dataclass(frozen=True, eq=False)
class Split:
    """A cell of one session on the rows of another.

    Attributes
    ----------
    cell
        As it was found.
    within
        The same where its driver was seen, nothing elsewhere.
    beyond
        A free form on the other rows; None where there are none.
    inside
        Which rows of a context are within, (n,).
    """

    cell: Cell
    within: Cell
    beyond: Cell | None
    inside: Inside


def split(cell: Cell, mine: Context, theirs: Context) -> Split:
    """Split a cell by where its driver was seen.

    Parameters
    ----------
    cell
        Of a cause.
    mine
        The rows that it was fitted to.
    theirs
        All rows of the other session.
    """
    driver = driver_named(cell.driver, cell.joints[-1] if cell.joints else 0)
    inside = _inside(cell, driver, mine)
    outside = ~inside(theirs)
    if not outside.any():
        return Split(cell, cell, None, inside)
    within = replace(cell, columns=partial(_masked, columns=cell.columns, rows=inside))
    beyond: Callable[[Context], Design] = cell.columns
    penalty = np.eye(cell.size)
    if cell.curve is not None and driver is not None and cell.place == 'joint_angle':
        turns_over = not np.isnan(cell.curve.start)
        values = driver.value(theirs)[outside]
        curve = Curve.of(values, 0.0, finest=cell.curve.step, turns_over=turns_over)
        beyond = partial(_free, joint=cell.joints[0], driver=driver, curve=curve)
        penalty = roughness(len(curve.weights), curve.closed)
    other = replace(
        cell,
        columns=partial(_masked, columns=beyond, rows=lambda context: ~inside(context)),
        parameters=tuple(f'beyond_{i}' for i in range(len(penalty))),
        penalty=penalty,
        largest=None,
        sign=0,
        curve=None,
        variant=f'{cell.variant} beyond',
    )
    return Split(cell, within, other, inside)


def _inside(cell: Cell, driver: Driver | None, mine: Context) -> Inside:
    if driver is not None:
        seen = driver.value(mine)
        if cell.curve is not None:
            curve = cell.curve
            return lambda context: curve.seen(driver.value(context))
        if driver.is_angle and mine.turns_over(driver.joint):
            start = start_of_turn(seen)
            turned = in_turn(seen, start)
            return lambda context: _between(in_turn(driver.value(context), start), turned)
        return lambda context: _between(driver.value(context), seen)
    if cell.driver == 'position' and cell.form != 'linear':
        sensor = mine.sensor_names.index(cell.subject)
        box = mine.in_sensor[mine.seen_by(sensor)]
        return lambda context: (
            np.all([_between(context.in_sensor[:, i], box[:, i]) for i in range(3)], axis=0)
            | ~context.seen_by(sensor)
        )
    return lambda context: np.ones(len(context), dtype=bool)


def _between(values: FloatArray, seen: FloatArray) -> BoolArray:
    inside: BoolArray = (values >= seen.min()) & (values <= seen.max())
    return inside


def _masked(context: Context, columns: Callable[[Context], Design], rows: Inside) -> Design:
    design = columns(context)
    mask = rows(context).reshape(-1, *[1] * (design.values.ndim - 1))
    return Design(design.at, design.values * mask)


def _free(context: Context, joint: int, driver: Driver, curve: Curve) -> Design:
    return Design(joint - 1, curve.splines(driver.value(context)))
