"""Candidate: where an error enters, what drives it, in which form; and a named effect of such.

The true joint angle is the reported one plus the zero-offset plus effects at the place
``joint_angle``. Everything else displaces the marker. Of a joint that slides the angle is its
place, in m, and a torque the force along it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, Protocol, get_args

import numpy as np

from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import driver_at
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.kinematics.serial_chain import LEVER_M
from remaster_ros.types import FloatArray

Place = Literal[
    'joint_angle', 'link_translation', 'link_rotation', 'base_rotation', 'marker', 'sensor_frame'
]
PLACES: tuple[Place, ...] = get_args(Place)
# RMS displacement of the marker that a cause without a plausible range is taken to have at most.
LARGEST_M = 10e-3
# Of a unit of effects at joints that turn: that at a joint that slides, and how much of it counts
# as one. A torque is a force at `LEVER_M`.
AT_A_SLIDE = {
    'rad': ('m', LEVER_M),
    'rad/rad': ('m/m', 1.0),
    'rad/(N m)': ('m/N', LEVER_M**2),
}
# Form of a candidate that is all members of a kind of error.
RANDOM = 'random'
NO_TIMES = 'the session has no times (times: none), only the order of its rows'


@dataclass(frozen=True, eq=False)
class Design:
    """Columns of a candidate: effect of one unit of each of its m parameters in n rows.

    Either positions added to one joint (`at`), or displacements of the marker.
    """

    at: int | None  # Index of the joint whose angle it adds to; None if it displaces the marker
    # Added joint angle, rad or m per unit, (n, m), or displacement in R, m per unit, (n, 3, m)
    values: FloatArray

    @property
    def size(self) -> int:
        """Number of parameters m."""
        return self.values.shape[-1]

    def displacement(self, context: Context) -> FloatArray:
        """Return the displacement of the marker, m per unit in the base frame R, (n, 3, m).

        To first order: of positions added to a joint by the marker's Jacobian in ``context``.
        """
        if self.at is None:
            return self.values
        return context.jacobian[:, :, self.at, None] * self.values[:, None, :]


@dataclass(frozen=True, eq=False)
class ModelChange:
    """Change of a joint's origin in the robot model by one unit of each of m parameters."""

    joint: int  # Index of the joint, from 0
    shifts: FloatArray  # Of its origin, in the frame of the link before, m per unit, (m, 3)
    turns: FloatArray  # Of its frame, about axes of that frame, rad per unit, (m, 3)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Candidate cause of errors: what errs, the quantity it depends on, and the function of it.

    ``place`` is what errs (such as a joint's angle or a sensor's frame), ``driver`` the quantity
    that the error depends on, ``form`` the kind of function.
    """

    name: str  # Of the named effect; 'unnamed' for the rest
    # As discovery.json has them
    place: Place
    driver: str
    form: str
    # Name of each of the m parameters, and their common unit
    parameters: tuple[str, ...]
    unit: str
    columns: Callable[[Context], Design]  # What a unit of each does
    joints: tuple[int, ...] = ()  # 1-based; () if none
    # How many candidates like it are tried: its prior probability is that of its kind over this
    drawn_from: int = 1
    # For free forms: precision of the parameters, (m, m), up to the smoothness; None else
    penalty: FloatArray | None = None
    # Distinguishes candidates of the same name and joints: the order of a harmonic, an axis
    variant: str = ''
    # The sensor or marker it is about; '' if it is about joints or the whole arm
    subject: str = ''
    # Standard deviation of the prior on each parameter about 0, in ``unit``: the largest that is
    # plausible. None: what displaces the marker by `LARGEST_M`.
    largest: float | None = None
    sign: int = 0  # Of the parameters, where physics has only one: 1 or -1; 0 for both
    # When it happened, s since the first row; NaN for what does not happen at one moment
    moment: float = np.nan
    # How far apart moments are that explain the rows nearly as well, s; 0 until that is judged
    moment_std: float = 0.0
    # For free forms of one driver: their splines, one parameter each, or one for each of three
    # axes, those of a spline next to each other; None else
    curve: Curve | None = None
    # The same as a change of the robot model, where it is one; None else
    model_change: ModelChange | None = None
    # Of a penalised candidate: standard deviation of the weights at a penalty of 1 that its
    # smoothness does not go below, in ``unit``; 0 for none
    least: float = 0.0
    slide: bool = False  # It is about the place of a joint that slides
    # The candidate of which it is a change at its moment, which begins then or ends then; None for
    # what is there in all of the session
    changes: Candidate | None = None
    ends: bool = False

    @property
    def size(self) -> int:
        """Number of parameters m."""
        return len(self.parameters)

    @property
    def happened(self) -> bool:
        """Whether the error begins, ends or changes at one moment of the session (`moment`)."""
        return not np.isnan(self.moment)

    @property
    def of_measurement(self) -> bool:
        """Whether the error is one of the measurement (sensor, marker) and not of the arm."""
        if self.changes is not None:
            return self.changes.of_measurement
        if self.happened:
            return self.place != 'joint_angle'
        return self.place == 'sensor_frame' or (
            self.place == 'marker' and self.driver == 'constant'
        )

    def is_shape_of(self, form: Candidate) -> bool:
        """Return whether this candidate is one fixed shape among those of a free form (a spline).

        True if ``form`` has a penalty, this candidate has none, and place, driver, joints and
        subject are the same.
        """
        return (
            form.penalty is not None
            and self.penalty is None
            and (self.place, self.driver, self.joints, self.subject)
            == (form.place, form.driver, form.joints, form.subject)
        )

    @cached_property
    def roughness(self) -> FloatArray:
        """Eigenvalues of the penalty, ascending, (m,); (0,) without a penalty."""
        penalty = np.zeros((0, 0)) if self.penalty is None else self.penalty
        return np.linalg.eigvalsh(penalty).astype(float, copy=False)

    @cached_property
    def key(self) -> tuple[str, tuple[int, ...], str, str, str, str]:
        """Key that identifies the candidate among all others."""
        return self.name, self.joints, self.place, self.driver, self.form, self.label

    @cached_property
    def label(self) -> str:
        """Text of subject, variant and moment, joined by blanks: 'mocap shift 812.000 s'.

        Parts that the candidate lacks are left out; '' if it has none of them.
        """
        moment = '' if np.isnan(self.moment) else f'{self.moment:.3f} s'
        moment = f'until {moment}' if self.ends else moment
        return ' '.join(part for part in (self.subject, self.variant, moment) if part)


class Changes(Protocol):
    """Function that makes the columns of a candidate that begins, ends or changes in a gap.

    ``gap``: start and end, s since the first row, (2,), between which the moment lies.
    """

    def __call__(
        self, context: Context, candidate: Candidate, gap: FloatArray, ends: bool
    ) -> Design:
        """Return the columns."""
        ...


@dataclass(frozen=True, eq=False)
class Effect:
    """Named physical cause: makes its candidates, and has the texts that explain them."""

    name: str  # As in discovery.json
    # Of its candidates
    place: Place
    driver: str
    form: str
    # What it does, and where that is written
    equation: str
    source: str
    unit: str  # Of its parameters
    # Range of size that real machines have, in ``unit``; its upper end is the standard deviation
    # of the prior on each parameter. None if nothing is known.
    plausible: tuple[float, float] | None
    # For a technician; ``{subject}`` (its joints or sensor), ``{other}`` (the joint that drives)
    # and ``{driver}`` are filled in
    sentence: str
    separate_by: str  # Which measurements distinguish it from others
    remedy: str  # What to do about it: a sentence for whoever answers for the arm
    # What a candidate amounts to, for a sentence: of context, candidate and draws of its
    # parameters (draws, m); see `sizes`
    size: Callable[[Context, Candidate, FloatArray], str]
    candidates: Callable[[Context], Iterable[Candidate]]  # All of its candidates for a context
    # Returns why a context cannot show it; '' if it can
    needs: Callable[[Context], str] = field(default=lambda context: '')
    # Which of its candidates are members of its kind: one for each joint, not every variant
    in_family: Callable[[Candidate], bool] = field(default=lambda candidate: True)
    # How candidates make causes: all candidates of an ``effect`` are one cause, those of the same
    # ``joints``, or those of the same joints and ``variant``
    cause_per: Literal['effect', 'joints', 'variant'] = 'effect'
    costly: bool = False  # It has too many candidates to be tried again and again
    many: bool = False  # Its candidates are drawn from thousands: they are no kind of one variance
    # The offsets model absorbs it: it is judged by how far that fit moved the markers
    # (`marker_offsets`), not by the residuals
    moves_the_fit: bool = False
    # Its candidates' second joint is the one that drives; the sentence is about the first
    driven_by_joint: bool = False
    sign: int = 0  # Of its parameters, as of `Candidate`
    # Name in discovery.json, where it is another: 'unnamed' for what has no name of its own
    reported_as: str = ''
    # False for structure that is located without a cause: it is reported as unexplained
    is_cause: bool = True
    # In place of sentence and remedy where it is about joints that slide; '' if these are right
    slide_sentence: str = ''
    slide_remedy: str = ''
    # For what happened at one moment: its candidates in all gaps between rows that reach between
    # two moments, s since the first row
    between: Callable[[Context, float, float], Iterable[Candidate]] | None = None
    # For what has a place or size that no parameter is: its candidates near one of them
    finer: Callable[[Context, Candidate], Iterable[Candidate]] | None = None
    # Columns of a change of its candidates at a moment; None for what is the same all the time
    changes: Changes | None = None

    def candidate(
        self, columns: Callable[[Context], Design], parameters: Iterable[str], **more: Any
    ) -> Candidate:
        """Return a candidate of this effect.

        Name, place, driver, form, unit, sign and prior size are the effect's, unless given in
        ``more``: further arguments of `Candidate`.
        """
        names = ('name', 'place', 'driver', 'form', 'unit', 'sign')
        defaults = {name: getattr(self, name) for name in names}
        defaults['largest'] = self.plausible[1] if self.plausible else None
        return Candidate(columns=columns, parameters=tuple(parameters), **{**defaults, **more})

    def sentence_of(self, candidates: Iterable[Candidate]) -> str:
        """Return the sentence for candidates of this effect, with its placeholders not filled in.

        `slide_sentence`, if there is one, if all candidates are about joints that slide.
        """
        return (
            all(candidate.slide for candidate in candidates) and self.slide_sentence
        ) or self.sentence

    def remedy_of(self, candidate: Candidate) -> str:
        """Return the remedy for a candidate of this effect, with the name of its driver filled in.

        `slide_remedy`, if there is one, if the candidate is about a joint that slides. Driver:
        the quantity that the error depends on.
        """
        remedy = (candidate.slide and self.slide_remedy) or self.remedy
        return remedy.format(driver=candidate.driver.replace('_', ' '))

    def at_joints(
        self,
        context: Context,
        joints: Iterable[int],
        features: Callable[[Context, int], Sequence[FloatArray]],
        parameters: Sequence[str],
        **more: Any,
    ) -> Iterator[Candidate]:
        """Yield a candidate for each of some joints (1-based), which adds to its position.

        ``joints``: which of the context's; ``features``: function of context and joint to m
        added positions, rad or m per unit, (n,) each; ``parameters``: names of the m
        parameters, with ``{joint}`` for the joint; ``more``: further arguments of `Candidate`.
        For a joint that slides unit, driver and prior size are those of a slide.
        """
        for joint in joints:
            slide_fields: dict[str, Any] = {}
            if context.slides(joint):
                unit, counts = AT_A_SLIDE[self.unit]
                slide_fields = {'unit': unit, 'driver': driver_at(context, joint, self.driver)}
                slide_fields |= {'slide': True}
                if self.plausible:
                    slide_fields['largest'] = counts * self.plausible[1]
            yield self.candidate(
                partial(_added, joint=joint, features=features),
                [name.format(joint=joint) for name in parameters],
                joints=(joint,),
                **{**slide_fields, **more},
            )


def _added(
    context: Context, joint: int, features: Callable[[Context, int], Sequence[FloatArray]]
) -> Design:
    """Return columns that add features to a joint's position, rad or m per unit, (n, m).

    ``joint``: 1-based; ``features``: function of context and joint to m arrays, (n,) each.
    """
    return Design(joint - 1, np.stack(features(context, joint), axis=-1))


def displaced(*shifts: FloatArray) -> Design:
    """Return columns that displace the marker by m shifts in base frame R, (n, 3), m per unit."""
    return Design(None, np.stack(shifts, axis=-1))


def along_axes(features: FloatArray, turns: FloatArray) -> list[FloatArray]:
    """Return each of m features times each axis of a frame: 3 m shifts, (n, 3) each.

    ``features``: (n, m); ``turns``: rotation matrices of the frame, (n, 3, 3), or (1, 3, 3)
    for all rows. The three axes of a feature stand next to each other.
    """
    return [features[:, [i]] * turns[:, :, a] for i in range(features.shape[1]) for a in range(3)]


def turned(context: Context, axes: Sequence[FloatArray], about: FloatArray) -> Design:
    """Return columns of small rotations of the marker about axes through points.

    ``axes``: rotation vectors in the base frame R, rad per unit, (n, 3) each, one for each
    parameter; ``about``: points of R on the axes, m, (n, 3) or (3,).
    """
    return displaced(*(np.cross(axis, context.points - about) for axis in axes))


def needs_gravity(context: Context) -> str:
    """Return the reason why effects of gravity cannot be tested; '' if they can.

    They cannot if the URDF has no link masses.
    """
    return '' if context.has_gravity else 'the URDF has no link masses, so gravity is unknown'


def needs_approach(context: Context) -> str:
    """Return the reason why effects of approach and last move cannot be tested; '' if they can.

    They cannot if ``from_q`` is unknown in too many rows.
    """
    return '' if context.has_approach else 'where the arm came from (from_q) is not recorded'


def needs_motion(context: Context) -> str:
    """Return the reason why effects of motion cannot be tested; '' if they can.

    They cannot if the arm stood still at every reading.
    """
    return '' if context.has_motion else 'the arm stood still at every reading'


def needs_time(context: Context) -> str:
    """Return the reason why effects over time cannot be tested; '' if they can.

    They cannot without times, or if all rows have the same time.
    """
    if context.has_time:
        return ''
    return 'all rows have the same time' if context.timed else NO_TIMES
