"""Do the causes of one session hold in another of the same arm?

Registrations, markers and zero-offsets are fitted to the other session three times: without the
causes, with the causes as found here, frozen, and with the same causes fitted there. The last
shows what the other session could gain from them, and the frozen ones their share of it. A cause
counts where its driver has values that were seen here (`common_range`). Errors are those of the
validation rows, or of the fitted ones where there are none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate, hold_offsets
from remaster_ros.discovery.common_range import Split, split
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.gain import rms
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.side_by_side import (
    Compared,
    compare_cell,
    compare_offsets,
    rms_sigmas,
)
from remaster_ros.discovery.solution import Solution
from remaster_ros.errors import InputError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import BoolArray, Session

# Zero-offsets with which a session's error is so many times that with its own, and which differ
# by so many standard deviations on the average, are not its own.
OTHER_OFFSETS = 1.5
OTHER_SIGMAS = 3.0
# Causes that take less off the squared error of the other session have nothing to gain there.
LEAST_GAIN = 0.01
# Fewer poses of the other session in the common range do not determine anything.
FEWEST_POSES = 6
# Sessions with a larger share of equal measurements are one and the same.
SAME_ROWS = 0.1


@dataclass(frozen=True)
class ConfirmedCause:
    """How a cause does in the other session.

    Attributes
    ----------
    rows_common
        Rows of the other session in which what drives the cause was seen here.
    carried_over
        Of what the other session could gain from this cause, beside the others fitted there, the
        share that it gains with the cause as found here: at most 1, negative where that makes it
        worse; NaN where there is nothing to gain.
    rms_without_m, rms_frozen_m
        RMS of the 3-D error in these rows without it, and with it as found here.
    parameters
        Both sessions side by side; empty where the other session does not determine them.
    """

    rows_common: int
    carried_over: float
    rms_without_m: float
    rms_frozen_m: float
    parameters: tuple[Compared, ...]


@dataclass(frozen=True)
class Confirmation:
    """How causes found in one session do in another.

    Attributes
    ----------
    rows, rows_common
        Rows of the other session, and those in which what drives each of the causes was seen.
    rms_before_m, rms_after_m, rms_own_m
        RMS of the 3-D error without causes, with the causes as found here, and with the same
        causes fitted there. Registrations, markers, zero-offsets, and what takes the place of
        causes beyond the common range, are fitted to the other session.
    rms_frozen_offsets_m
        With the zero-offsets of this session too, with or without the causes, whichever is less.
    carried_over
        Of what the other session could gain from the causes, the share that it gains with them as
        found here: at most 1, negative where they make it worse; NaN with nothing to gain.
    effects
        Each cause, in the order of the discovery.
    joint_offsets
        Zero-offsets that both sessions determine, side by side.
    confirmed
        More than half carries over, and the zero-offsets agree.
    same_offsets
        Whether the zero-offsets agree: within three standard deviations on the average, or with an
        error that is nearly as small as with the other session's own.
    why
        Why nothing can be compared; '' where it can.
    """

    rows: int
    rows_common: int
    rms_before_m: float
    rms_after_m: float
    rms_own_m: float
    rms_frozen_offsets_m: float
    carried_over: float
    effects: tuple[ConfirmedCause, ...]
    joint_offsets: tuple[Compared, ...]
    confirmed: bool
    same_offsets: bool
    why: str = ''

    @property
    def offsets_rms_sigmas(self) -> float:
        """Root mean square of the zero-offsets' differences in standard deviations."""
        return rms_sigmas(self.joint_offsets)

    @property
    def parameters_rms_sigmas(self) -> float:
        """Root mean square of the causes' differences in standard deviations."""
        return rms_sigmas([row for effect in self.effects for row in effect.parameters])


@one_thread
def confirm(discovery: Discovery, session: Session) -> Confirmation:
    """Compare a discovery with another session of the same arm.

    Raises
    ------
    InputError
        Another robot, other sensors, or the same measurements.
    InsufficientDataError
        Data that do not allow a fit.
    """
    require_other_session(discovery.fit.session, session)
    there = _OtherSession.of(discovery, estimate(Problem.of(session)))
    context = there.data.context
    seen = np.ones(len(context), dtype=bool)
    for part in there.given:
        seen &= part.inside(context)
    if there.given and not there.parts:
        why = (
            f'Of the {len(context)} rows of the other session too few lie where the causes were '
            'seen, or none shows them: nothing can be compared. Measure the arm where this '
            'session did.'
        )
        return _nothing(len(context), int(seen.sum()), why)
    every = [part.within for part in there.parts]
    before, own = there.error((), ()), there.error((), every)
    after = there.error(every, ())
    offsets = compare_offsets(discovery.fit, there.found, there.data, there.own, there.parts)
    carried = share_of_gain(before, after, own)
    frozen_offsets = there.error_with_offsets(discovery)
    agree = not rms_sigmas(offsets) > OTHER_SIGMAS
    same = agree or frozen_offsets < OTHER_OFFSETS * min(before, after, own)
    return Confirmation(
        rows=len(context),
        rows_common=int(seen.sum()),
        rms_before_m=before,
        rms_after_m=after,
        rms_own_m=own,
        rms_frozen_offsets_m=frozen_offsets,
        carried_over=carried,
        effects=tuple(_confirmed(discovery, there, group) for group in discovery.groups),
        joint_offsets=offsets,
        confirmed=same and carried > 0.5,
        same_offsets=same,
    )


def _nothing(rows: int, common: int, why: str) -> Confirmation:
    nan = float('nan')
    return Confirmation(rows, common, nan, nan, nan, nan, nan, (), (), False, False, why)


def share_of_gain(before: float, frozen: float, own: float) -> float:
    """Return the share of what could be gained in mean square that frozen causes gain.

    Parameters
    ----------
    before, frozen, own
        RMS errors without causes, with frozen ones, and with those fitted to the session itself.

    Returns
    -------
    float
        At most 1: what frozen causes gain could be gained. NaN where that is next to nothing.
    """
    could = before**2 - min(own, frozen) ** 2
    if could < LEAST_GAIN * before**2:
        return float('nan')
    return (before**2 - frozen**2) / could


@dataclass(frozen=True, eq=False)
class _OtherSession:
    """The other session, and the causes on its rows.

    Attributes
    ----------
    found, data
        Its fit without causes, and the residuals of the rows kept.
    values
        Name of each of the causes' parameters -> its value in the first session.
    given, parts
        The cells of the causes, and those that the other session shows.
    beyond
        What takes the causes' place in fitted rows where they were not seen.
    known
        Rows in which each cause was seen or has something in its place, (all rows,).
    own
        The fit with the causes and what lies beyond.
    """

    found: Estimate
    data: Residuals
    values: Mapping[str, float]
    given: tuple[Split, ...]
    parts: tuple[Split, ...]
    beyond: tuple[Cell, ...]
    known: BoolArray
    own: Solution

    @classmethod
    def of(cls, discovery: Discovery, found: Estimate) -> _OtherSession:
        data = Residuals.of(found)
        # What happened once is no property of the arm.
        cells = [cell for group in discovery.groups for cell in group if np.isnan(cell.moment)]
        given = tuple(split(cell, discovery.residuals.part, data.context) for cell in cells)
        poses = data.context.measurements.pose[data.rows.source]
        parts = [
            part for part in given if len(np.unique(poses[part.inside(data.part)])) >= FEWEST_POSES
        ]
        beyond, known = [], np.ones(len(data.context), dtype=bool)
        for part in given:
            if part.beyond is not None and np.any(~part.inside(data.part)):
                beyond.append(part.beyond)
            else:
                # Nothing can be fitted to held-out rows alone.
                known &= part.inside(data.context)
        own = solve(data, [*(part.within for part in parts), *beyond])
        if own is None:
            # Some of the causes this session cannot show: the rest.
            own = solve(data, beyond)
            shown: list[Split] = []
            for part in parts:
                within = [*(other.within for other in shown), part.within]
                tried = solve(data, [*within, *beyond], own)
                if tried is not None:
                    own, shown = tried, [*shown, part]
            parts = shown
        assert own is not None
        values = dict(zip(discovery.fit.theta_names, discovery.fit.theta, strict=True))
        return cls(found, data, values, given, tuple(parts), tuple(beyond), known, own)

    def error(
        self,
        frozen: Sequence[Cell],
        fitted: Sequence[Cell],
        *,
        rows: BoolArray | None = None,
        data: Residuals | None = None,
    ) -> float:
        """Return the RMS error with some cells as found in the first session, and some fitted.

        Of the validation rows, or the fitted ones without any; of those in ``rows`` (all rows,).
        """
        data = self.data if data is None else data
        theta = np.array([self.values[name] for cell in frozen for name in cell.parameters])
        data = data.less(data.displaced(frozen, theta))
        fit = solve(data, (*fitted, *self.beyond), self.own)
        if fit is None:
            return float('nan')
        judged = data.context.measurements.is_validation & self.known
        if not judged.any():
            judged = np.isin(np.arange(len(judged)), data.rows.source)
        if rows is not None and np.any(judged & rows):
            judged = judged & rows
        return rms(data.unexplained(fit), judged)

    def error_with_offsets(self, discovery: Discovery) -> float:
        """Return the least RMS error with the first session's zero-offsets, causes or not."""
        joints = np.arange(self.found.model.joints)
        within = [part.within for part in self.parts]
        errors = []
        for offsets, frozen in (
            (discovery.offsets_before[0], ()),
            (discovery.fit.joint_offsets, within),
            (discovery.fit.joint_offsets, ()),
        ):
            data = Residuals.at(self.found, hold_offsets(self.found.mode, offsets))
            errors.append(self.error(frozen, (), data=data.holding(joints)))
        return min(errors)


def _confirmed(
    discovery: Discovery, there: _OtherSession, group: tuple[Cell, ...]
) -> ConfirmedCause:
    """Judge one cause where it was seen, the others fitted to the other session."""
    mine = [part for part in there.parts if part.cell in group]
    context = there.data.context
    rows = np.zeros(len(context), dtype=bool)
    for part in mine:
        rows |= part.inside(context)
    within = [part.within for part in mine]
    rest = [part.within for part in there.parts if part not in mine]
    without = there.error((), rest, rows=rows)
    frozen = there.error(within, rest, rows=rows) if mine else float('nan')
    own = there.error((), [*rest, *within], rows=rows)
    return ConfirmedCause(
        int(rows.sum()),
        share_of_gain(without, frozen, own) if mine else float('nan'),
        without,
        frozen,
        tuple(
            row
            for part in mine
            for row in compare_cell(discovery.fit, part, there.data.part, there.own)
        ),
    )


def require_other_session(session: Session, other: Session) -> None:
    """Refuse to compare sessions of different robots, sensors or markers, or one with itself.

    Raises
    ------
    InputError
        Says what differs, or how many measurements are in both.
    """
    mine, theirs = Problem.of(session), Problem.of(other)
    if mine.chain.joint_names != theirs.chain.joint_names:
        raise InputError(
            f'the other session is of another robot: its joints are '
            f'{", ".join(theirs.chain.joint_names)}, not {", ".join(mine.chain.joint_names)}'
        )
    if not np.allclose(mine.chain.T_fixed, theirs.chain.T_fixed, atol=1e-6):
        raise InputError(
            "the other session's URDF has another geometry; confirm with the same arm"
        )
    for kind, own, others in (
        ('sensors', mine.sensor_names, theirs.sensor_names),
        ('markers', mine.marker_names, theirs.marker_names),
    ):
        if own != others:
            raise InputError(
                f'the other session has the {kind} {", ".join(others)}, not {", ".join(own)}; '
                'confirm with a session of the same cell'
            )
    rows = len(other.measurements)
    equal = len(_readings(session) & _readings(other))
    if equal > SAME_ROWS * min(rows, len(session.measurements)):
        raise InputError(
            f'{equal} of the {rows} rows of the other session are measurements of this session: '
            'a session cannot confirm itself; give one that was measured at another time'
        )


def _readings(session: Session) -> set[bytes]:
    """Return joint angles and position of every row, to a nanoradian and a nanometre."""
    m = session.measurements
    rounded = np.round(np.concatenate((m.q, m.position), axis=1), 9) + 0.0
    return {row.tobytes() for row in rounded}
