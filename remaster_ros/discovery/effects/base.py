"""A cell: where an error enters, what drives it, in which form; and a named effect made of such.

The true joint angle is the reported one plus the zero-offset plus effects at the place
``joint_angle``. Everything else displaces the marker.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, get_args

import numpy as np

from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import FloatArray

Place = Literal[
    'joint_angle', 'link_translation', 'link_rotation', 'base_rotation', 'marker', 'sensor_frame'
]
PLACES: tuple[Place, ...] = get_args(Place)
# RMS displacement of the marker that a cause without a plausible range is taken to have at most.
LARGEST_M = 10e-3
NO_TIMES = 'the session has no times (times: none), only the order of its rows'


@dataclass(frozen=True, eq=False)
class Design:
    """What one unit of each of m parameters does to each of n rows.

    Attributes
    ----------
    at
        Index of the joint whose angle it adds to; None where it displaces the marker.
    values
        Added joint angle, rad per unit, (n, m), or displacement in R, m per unit, (n, 3, m).
    """

    at: int | None
    values: FloatArray

    @property
    def size(self) -> int:
        """Number of parameters m."""
        return self.values.shape[-1]

    def displacement(self, context: Context) -> FloatArray:
        """Return the displacement of the marker in R to first order, m per unit, (n, 3, m)."""
        if self.at is None:
            return self.values
        return context.jacobian[:, :, self.at, None] * self.values[:, None, :]


@dataclass(frozen=True, eq=False)
class ModelChange:
    """What a unit of each of m parameters changes for good in the robot model: a joint's origin.

    Attributes
    ----------
    joint
        Index of the joint, from 0.
    shifts
        Of its origin, in the frame of the link before, m per unit, (m, 3).
    turns
        Of its frame, about axes of that frame, rad per unit, (m, 3).
    """

    joint: int
    shifts: FloatArray
    turns: FloatArray


@dataclass(frozen=True, eq=False)
class Cell:
    """One candidate cause: a place, a driver and a form, with its parameters.

    Attributes
    ----------
    name
        Of the named effect; 'unnamed' for the rest.
    joints
        1-based; () where none.
    place, driver, form
        As discovery.json has them.
    parameters, unit
        Name of each of the m parameters, and their common unit.
    columns
        What a unit of each does.
    drawn_from
        How many cells like it are tried: its prior probability is that of its kind over this.
    penalty
        For free forms: precision of the parameters, (m, m), up to the smoothness; None else.
    variant
        Distinguishes cells of the same name and joints: the order of a harmonic, an axis.
    subject
        The sensor or marker it is about; '' where it is about joints or the whole arm.
    largest
        Standard deviation of the prior on each parameter about 0, in ``unit``: the largest that is
        plausible. None: what displaces the marker by `LARGEST_M`.
    sign
        Of the parameters, where physics has only one: 1 or -1; 0 for both.
    moment
        When it happened, s since the first row; NaN for what does not happen at one moment.
    moment_std
        How far apart moments are that explain the rows nearly as well, s; 0 until that is judged.
    curve
        For free forms of one driver: their splines, one parameter each, or one for each of three
        axes, those of a spline next to each other; None else.
    model_change
        The same as a change of the robot model, where it is one; None else.
    least
        Of a penalised cell: standard deviation of the weights at a penalty of 1 that its
        smoothness does not go below, in ``unit``; 0 for none.
    """

    name: str
    place: Place
    driver: str
    form: str
    parameters: tuple[str, ...]
    unit: str
    columns: Callable[[Context], Design]
    joints: tuple[int, ...] = ()
    drawn_from: int = 1
    penalty: FloatArray | None = None
    variant: str = ''
    subject: str = ''
    largest: float | None = None
    sign: int = 0
    moment: float = np.nan
    moment_std: float = 0.0
    curve: Curve | None = None
    model_change: ModelChange | None = None
    least: float = 0.0

    @property
    def size(self) -> int:
        """Number of parameters m."""
        return len(self.parameters)

    @property
    def happened(self) -> bool:
        """Whether it came at one moment and stayed: before it and after it the arm is another."""
        return not np.isnan(self.moment)

    @property
    def of_measurement(self) -> bool:
        """Whether it lies in how the arm was measured and not in the arm."""
        if self.happened:
            return self.place != 'joint_angle'
        return self.place == 'sensor_frame' or (
            self.place == 'marker' and self.driver == 'constant'
        )

    @cached_property
    def roughness(self) -> FloatArray:
        """Eigenvalues of the penalty, ascending, (m,); none where there is none."""
        penalty = np.zeros((0, 0)) if self.penalty is None else self.penalty
        return np.linalg.eigvalsh(penalty).astype(float, copy=False)

    @cached_property
    def key(self) -> tuple[str, tuple[int, ...], str, str, str, str]:
        """What distinguishes this cell from all others."""
        return self.name, self.joints, self.place, self.driver, self.form, self.label

    @cached_property
    def label(self) -> str:
        """Subject, variant and moment in one."""
        moment = '' if np.isnan(self.moment) else f'{self.moment:.3f} s'
        return ' '.join(part for part in (self.subject, self.variant, moment) if part)


@dataclass(frozen=True, eq=False)
class Effect:
    """A physical cause with a name: everything that the program needs to find and explain it.

    Attributes
    ----------
    name
        As in discovery.json.
    place, driver, form
        Of its cells.
    equation, source
        What it does, and where that is written.
    unit
        Of its parameters.
    plausible
        Range of size that real machines have, in ``unit``; its upper end is the standard deviation
        of the prior on each parameter. None where nothing is known.
    sign
        Of its parameters, as of `Cell`.
    sentence
        For a technician; ``{subject}`` (its joints or sensor), ``{other}`` (the joint that
        drives) and ``{driver}`` are filled in.
    separate_by
        Which measurements distinguish it from others.
    remedy
        What to do about it: a sentence for whoever answers for the arm.
    size
        What a cell amounts to, for a sentence: of context, cell and draws of its parameters
        (draws, m); see `sizes`.
    cells
        All of its cells for a context.
    needs
        Returns why a context cannot show it; '' where it can.
    family
        Effects of one family strike all joints or links alike: they are tried together, too, and
        share their prior probability. '' for an effect that comes alone.
    in_family
        Which of its cells are tried with the family: one for each joint, not every variant.
    cause_per
        How cells make causes: all cells of an ``effect`` are one cause, those of the same
        ``joints``, or those of the same joints and ``variant``.
    costly
        It has too many cells to be tried again and again.
    many
        Its cells are drawn from thousands: they are no family of one variance.
    moves_the_fit
        The offsets model absorbs it: it is judged by how far that fit moved the markers
        (`marker_offsets`), not by the residuals.
    reported_as
        Name in discovery.json, where it is another: 'unnamed' for what has no name of its own.
    is_cause
        False for structure that is located without a cause: it is reported as unexplained.
    between
        For what happened at one moment: its cells in all gaps between rows that reach between two
        moments, s since the first row.
    driven_by_joint
        Its cells' second joint is the one that drives; the sentence is about the first.
    """

    name: str
    place: Place
    driver: str
    form: str
    equation: str
    source: str
    unit: str
    plausible: tuple[float, float] | None
    sentence: str
    separate_by: str
    remedy: str
    size: Callable[[Context, Cell, FloatArray], str]
    cells: Callable[[Context], Iterable[Cell]]
    needs: Callable[[Context], str] = field(default=lambda context: '')
    family: str = ''
    in_family: Callable[[Cell], bool] = field(default=lambda cell: True)
    cause_per: Literal['effect', 'joints', 'variant'] = 'effect'
    costly: bool = False
    many: bool = False
    moves_the_fit: bool = False
    driven_by_joint: bool = False
    sign: int = 0
    reported_as: str = ''
    is_cause: bool = True
    between: Callable[[Context, float, float], Iterable[Cell]] | None = None

    def cell(
        self, columns: Callable[[Context], Design], parameters: Iterable[str], **more: Any
    ) -> Cell:
        """Return a cell of this effect; ``more`` are further arguments of `Cell`."""
        names = ('name', 'place', 'driver', 'form', 'unit', 'sign')
        own = {name: getattr(self, name) for name in names}
        own['largest'] = self.plausible[1] if self.plausible else None
        return Cell(columns=columns, parameters=tuple(parameters), **{**own, **more})

    def at_joints(
        self,
        joints: Iterable[int],
        features: Callable[[Context, int], Sequence[FloatArray]],
        parameters: Sequence[str],
        **more: Any,
    ) -> Iterator[Cell]:
        """Give a cell for each of some joints (1-based), which adds to that joint's angle.

        Parameters
        ----------
        joints
            Which.
        features
            Context and joint to m added angles, rad per unit, (n,) each.
        parameters
            Names of the m parameters, with ``{joint}`` for the joint.
        more
            Further arguments of `Cell`.
        """
        for joint in joints:
            yield self.cell(
                partial(_added, joint=joint, features=features),
                [name.format(joint=joint) for name in parameters],
                joints=(joint,),
                **more,
            )


def _added(
    context: Context, joint: int, features: Callable[[Context, int], Sequence[FloatArray]]
) -> Design:
    return Design(joint - 1, np.stack(features(context, joint), axis=-1))


def displaced(*shifts: FloatArray) -> Design:
    """Return columns that displace the marker by shifts (n, 3) in R, m per unit."""
    return Design(None, np.stack(shifts, axis=-1))


def along_axes(features: FloatArray, turns: FloatArray) -> list[FloatArray]:
    """Return each feature (n, m) times each axis of rotations (n, 3, 3): 3 m shifts (n, 3).

    The three axes of a feature stand next to each other.
    """
    return [features[:, [i]] * turns[:, :, a] for i in range(features.shape[1]) for a in range(3)]


def turned(context: Context, axes: Sequence[FloatArray], about: FloatArray) -> Design:
    """Return columns that turn the marker about points (n, 3), m, by axes (n, 3), rad per unit."""
    return displaced(*(np.cross(axis, context.points - about) for axis in axes))


def needs_gravity(context: Context) -> str:
    """Return why gravity's effects cannot be tested; '' where they can."""
    return '' if context.has_gravity else 'the URDF has no link masses, so gravity is unknown'


def needs_approach(context: Context) -> str:
    """Return why approach and last move cannot be tested; '' where they can."""
    return '' if context.has_approach else 'where the arm came from (from_q) is not recorded'


def needs_time(context: Context) -> str:
    """Return why drift cannot be tested; '' where it can."""
    if context.has_time:
        return ''
    return 'all rows have the same time' if context.timed else NO_TIMES
