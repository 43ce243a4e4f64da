"""Do the causes of one session hold in another of the same arm? One model of both sessions tells.

Registrations, markers, noise and errors of the measuring are each session's own. A cause is
*shared* by both, has a size of its *own* in each, or is *absent* in the other one; a zero-offset
is shared or each session's own; all other kinds of errors of the arm are shared. With D = X'WX and
h = X'Wy of the columns X of each session and its errors y, a choice of these is a matrix A of
zeros and ones from the parameters of both sessions to those of the choice, and::

    log evidence = ½ log|Λ| − ½ log|H| + ½ h'H⁻¹h,   H = Σ A'DA + Λ,   h = Σ A'(h − D s)

with Λ the precision of Gaussian priors and s the zero-offsets of this session less those that the
other one is linearised at. The evidence decides, from all shared on, by the best change at a time;
what another choice for a cause then loses is what is told of it. One such choice is how much of
the variance of the arm's errors is the other session's own (`SHARES`): with δ of the precision
Λ / share beside the parameters there, which is integrated out of D and h of that session.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from msgspec import Struct
from scipy.linalg import block_diag, cho_factor, cho_solve, cholesky

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.identifiability import WEAK_ANGLE
from remaster_ros.calibration.noise import Noise
from remaster_ros.calibration.priors import STEP_STD
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.base import Candidate, Design
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import Driver, driver_named
from remaster_ros.discovery.effects.registry import effects_of
from remaster_ros.discovery.effects.splines import Curve, in_turn, start_of_turn
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.gain import rms
from remaster_ros.discovery.random_effects import Family, kinds
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.thinning import draw_rows
from remaster_ros.discovery.walk import NAMED, NEEDED
from remaster_ros.discovery.words import joint_words, percent
from remaster_ros.errors import InputError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import BoolArray, FloatArray, IntArray, Session

Choice = Literal['shared', 'own', 'absent']
Answer = Literal['confirmed', 'changed', 'absent', 'open']
CHOICES: tuple[Choice, ...] = ('shared', 'own', 'absent')
# Of each zero-offset, then of each cause.
Choices = tuple[Choice, ...]
# A candidate with the precision of the prior on its parameters.
_Weighted = tuple[Candidate, FloatArray]

# A size of its own halves the evidence at least where the other session halves what it can be.
HALVED = float(np.log(2.0))
# What this session tells of a parameter: it leaves at most half of what can be. Frozen at less, a
# curve through angles that it hardly took would make the other session worse.
HALF = 0.5
# Causes that take less off the squared error of the other session, 0.5 % of its error, have
# nothing to gain there: no share of that is known.
LEAST_GAIN = 0.01
# Sessions of one arm have no reading in common; copies of one have most, even with some left out.
SAME_ROWS = 0.1
# Of the variance of the arm's errors what may be a session's own: no model is the arm, and what it
# lacks is not the same elsewhere. Of each size at most a tenth: what changes by more has changed.
SHARES = (0.001, 0.003, 0.01)


class Compared(Struct, frozen=True):
    """Quantity fitted to two sessions, in its unit: value and standard deviation in each.

    ``sigmas`` is the difference, other less this session's, over its standard deviation; None if
    that is zero.
    """

    name: str
    unit: str
    value: float
    std: float
    other_value: float
    other_std: float
    sigmas: float | None


def rms_sigmas(rows: Sequence[Compared]) -> float | None:
    """Return the root mean square of the ``sigmas`` of some rows; None if none has one."""
    squares = [row.sigmas**2 for row in rows if row.sigmas is not None]
    return float(np.sqrt(np.mean(squares))) if squares else None


# Of the next two what has a default is missing in files of earlier versions.


class ConfirmedCause(Struct, frozen=True):
    """Result of checking one cause on the other session, as discovery.json has it."""

    name: str
    joints: tuple[int, ...]
    # Of what the other session could gain from this cause, beside the others fitted there, the
    # share that it gains with the cause as found here: at most 1, negative where that makes it
    # worse; None if there is nothing to gain
    carried_over: float | None
    rows_common: int = 0  # Rows of the other session in which what drives the cause was seen here
    # RMS of the 3-D error in these rows without it, and with it as found here
    rms_without_m: float | None = None
    rms_frozen_m: float | None = None
    # Both sessions side by side; of a curve, where both measured
    parameters: tuple[Compared, ...] = ()
    # 'confirmed' (both sessions share it), 'changed' (of another size there), 'absent' (not there)
    # or 'open' (the other session cannot tell)
    answer: Answer = 'open'
    # Of 'shared', 'own' and 'absent', less that of the best, everything else as it is best
    log_evidence: Mapping[Choice, float] | None = None


class Confirmation(Struct, frozen=True):
    """Result of checking the causes found in one session on another, as discovery.json has it."""

    # RMS of the 3-D error of the rows that are common to all causes: without causes, with those as
    # found here, and with the same fitted there; all else, and what this session does not tell, is
    # fitted to the other one
    rms_before_m: float
    rms_after_m: float
    rms_own_m: float
    # With the zero-offsets of this session too, with or without the causes, whichever is less
    rms_frozen_offsets_m: float
    # Of what the other session could gain from the causes, the share that it gains with them as
    # found here: at most 1, negative where they make it worse; None with nothing to gain
    carried_over: float | None
    effects: tuple[ConfirmedCause, ...]  # Each cause, in the order of the discovery
    # More than half carries over, and the zero-offsets agree; not where nothing can be told
    confirmed: bool
    same_offsets: bool  # Whether no zero-offset that both sessions determine is another one
    # Rows of the other session, and those of them that are common to all causes
    rows: int = 0
    rows_common: int = 0
    joint_offsets: tuple[Compared, ...] = ()  # Those that both sessions determine, side by side
    # Root mean square of the differences of zero-offsets and of causes, in standard deviations
    offsets_rms_sigmas: float | None = None
    parameters_rms_sigmas: float | None = None
    why: str = ''  # Why nothing can be compared; '' if it can
    # 1-based joints whose zero-offset is another one there, by the evidence
    other_joints: tuple[int, ...] = ()
    # The same of those that the sessions do not determine: what the causes leave out moves them
    open_joints: tuple[int, ...] = ()
    # Of the size of each of the arm's errors, what is the other session's own
    differ_by: float = 0.0

    @property
    def gone(self) -> bool:
        """Whether one of the causes is absent in the other session."""
        return any(cause.answer == 'absent' for cause in self.effects)

    @property
    def carries_over(self) -> bool:
        """Whether causes as found here reach over half of the gain possible in the other session.

        The possible gain is that of the causes fitted to the other session. False if unknown.
        """
        return self.carried_over is not None and self.carried_over > 0.5


@one_thread
def confirm(discovery: Discovery, session: Session, rng: np.random.Generator) -> Confirmation:
    """Compare the causes found in one session with another session of the same arm.

    Parameters
    ----------
    discovery, session
        What was found in one session, and the other session.
    rng
        Draws the rows of a session that is too large to use all; see `thinning.draw_rows`.

    Raises
    ------
    InputError
        Another robot, other sensors, or the same measurements.
    InsufficientDataError
        Data that do not allow a fit.
    """
    require_other_session(discovery.fit.session, session)
    both = _Both.of(discovery, estimate(Problem.of(session)), rng)
    both, best = both.most_likely()
    rows = len(both.there.data.context)
    common_rows = [both.told(group) for group in both.groups]
    causes = tuple(
        both.judged(best, index, common_rows[index], effect)
        for index, effect in zip(range(len(common_rows)), discovery.effects, strict=False)
    )
    every = [i for group in both.groups for i in group]
    seen = np.all([np.ones(rows, dtype=bool), *common_rows], axis=0)
    error = partial(both.error, rows=seen)
    before, after, own_rms = error(absent=every), error(frozen=every), error()
    carried = share_of_gain(before, after, own_rms)
    why = ''
    if causes and all(cause.answer == 'open' for cause in causes):
        why = (
            f'In {seen.sum()} of the {rows} rows of the other session all that drives the causes '
            'is in the range seen here, and it shows none of them either way: nothing is '
            'confirmed. Measure the arm where this session did.'
        )
    with_causes = both.here.data.context.joint_offsets + both.alone.values[: both.joints]
    other_joints = tuple(j + 1 for j in both.own(best) if both.offsets(best, j) is not None)
    undetermined = tuple(j + 1 for j in both.own(best) if both.offsets(best, j) is None)
    side_by_side = both.offsets_side_by_side(discovery, best)
    return Confirmation(
        rows=rows,
        rows_common=int(seen.sum()),
        rms_before_m=before,
        rms_after_m=after,
        rms_own_m=own_rms,
        rms_frozen_offsets_m=min(
            error(absent=every, joint_offsets=discovery.offsets_before[0]),
            error(frozen=every, joint_offsets=with_causes),
        ),
        carried_over=carried,
        effects=causes,
        joint_offsets=side_by_side,
        offsets_rms_sigmas=rms_sigmas(side_by_side),
        parameters_rms_sigmas=rms_sigmas([row for cause in causes for row in cause.parameters]),
        confirmed=not other_joints and carried is not None and carried > 0.5 and not why,
        same_offsets=not other_joints,
        why=why,
        other_joints=other_joints,
        open_joints=undetermined,
        differ_by=float(np.sqrt(both.share)),
    )


def share_of_gain(before: float, frozen: float, refitted: float) -> float | None:
    """Return the share of the possible reduction of the squared error that causes as found reach.

    ``before``, ``frozen``, ``refitted``: RMS errors of a session, m: without causes, with the
    causes as found in another session, and with the causes fitted to this one. At most 1;
    negative if ``frozen`` is the largest. None if hardly any reduction is possible
    (`LEAST_GAIN`).
    """
    could = before**2 - min(refitted, frozen) ** 2
    if could < LEAST_GAIN * before**2:
        return None
    return (before**2 - frozen**2) / could


def _with(choices: Choices, index: int, choice: Choice) -> Choices:
    """Return a copy of the choices with that at an index replaced."""
    return (*choices[:index], choice, *choices[index + 1 :])


@dataclass(frozen=True, eq=False)
class _Measured:
    """Normal equations of a session for its natural parameters and the parameters of arm errors.

    Natural parameters are zero-offsets, registrations and markers. Both ``products`` and
    ``plain`` are X'WX, X being the columns of the natural parameters, then those of the m
    parameters of the arm's errors, and last the residuals. Errors of the measurement are
    marginalised in ``products`` and ignored in ``plain``.
    """

    data: Residuals
    products: FloatArray
    plain: FloatArray

    @classmethod
    def of(
        cls,
        data: Residuals,
        noise: Noise,
        candidates: Sequence[Candidate],
        nuisance: Sequence[_Weighted],
    ) -> _Measured:
        """Assemble the equations of the rows that ``data`` works on.

        ``candidates``: errors of the arm, whose parameters become unknowns of the equations;
        ``nuisance``: errors of the measurement, each with its prior precision, marginalised in
        `products`.
        """
        natural = data.full_jacobian[data.rows.source]
        further = data.columns([candidate for candidate, _ in nuisance])
        parts = natural, data.columns(candidates), data.errors[:, :, None], further
        columns = np.concatenate(parts, axis=2)
        grams = data.noise_model.gram(lambda _, where: columns[where], columns.shape[2])
        total = np.tensordot(1.0 / data.noise_model.variances(noise), grams, axes=1)
        known = columns.shape[2] - further.shape[2]
        plain, across = total[:known, :known], total[known:, :known]
        if not nuisance:
            return cls(data, plain, plain)
        precision = total[known:, known:] + block_diag(*(prior for _, prior in nuisance))
        return cls(data, plain - across.T @ _solved(precision, across), plain)

    @property
    def size(self) -> int:
        """Number of natural parameters."""
        return int(self.data.full_jacobian.shape[2])

    def apart(self, precision: FloatArray) -> tuple[FloatArray, float]:
        """Return `products` with the arm's errors marginalised, and the Occam term of that.

        The term, half the log determinant of posterior over prior precision, has to be
        subtracted from the log evidence. ``precision``: of the prior on the parameters of the
        arm's errors, (m, m).
        """
        where = slice(self.size, self.size + len(precision))
        across = self.products[where]
        arm_block = across[:, where] + precision
        loss = 0.5 * (np.linalg.slogdet(arm_block)[1] - np.linalg.slogdet(precision)[1])
        return self.products - across.T @ _solved(arm_block, across), float(loss)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Joint fit of two sessions: log evidence, up to a constant, and posterior.

    ``values``: posterior means, those of this session first; ``root``: upper Cholesky factor
    of their precision; ``there``: index in ``values`` of each parameter of the other session,
    -1 if it is absent there.
    """

    log_evidence: float
    values: FloatArray
    root: FloatArray
    there: IntArray

    def covariance(self, where: IntArray) -> FloatArray:
        """Return the posterior covariance of some parameters; ``where``: indices in `values`."""
        unit = np.zeros((len(self.values), len(where)))
        unit[where, np.arange(len(where))] = 1.0
        found: FloatArray = cho_solve((self.root, False), unit)[where]
        return found


@dataclass(frozen=True, eq=False)
class _Both:
    """Two sessions of an arm, this (``here``) and the other (``there``), for joint fits.

    ``found``: candidates of the arm's errors as found in this session; ``candidates``: the same
    with curves that reach over both sessions, of m parameters with the prior ``precision``,
    (m, m); ``groups``: indices of those that make each cause; ``fit``: the other session without
    causes; ``identifiable``: zero-offsets that this session determines, (k,).
    """

    found: tuple[Candidate, ...]
    candidates: tuple[Candidate, ...]
    groups: tuple[tuple[int, ...], ...]
    here: _Measured
    there: _Measured
    precision: FloatArray
    fit: Estimate
    identifiable: BoolArray
    # Of the variance of each of the arm's errors, what is the other session's own
    share: float = 0.0

    @classmethod
    def of(cls, discovery: Discovery, fit: Estimate, rng: np.random.Generator) -> _Both:
        """Assemble the equations of both sessions.

        ``discovery``: of this session; ``fit``: of the other session, with offsets only, whose
        rows are thinned by ``rng`` if they are many.
        """
        mine, theirs = discovery.residuals, Residuals.of(fit)
        theirs = theirs.only(draw_rows(fit.problem.measurements, fit.kept, rng))
        named = [candidate for group in discovery.groups for candidate in group]
        names = {name for candidate in named for name in candidate.parameters}
        other_candidates = [
            c for c in discovery.solution.candidates if not names & set(c.parameters)
        ]
        causes = [candidate for candidate in named if not candidate.happened]
        found = causes + [
            candidate for candidate in other_candidates if not candidate.of_measurement
        ]
        once = [c for c in named if c.happened] + [c for c in other_candidates if c.of_measurement]
        candidates = [widened(candidate, mine.part, theirs.part) for candidate in found]
        noise, nuisance = _by_itself(theirs, candidates[: len(causes)])
        priors = [_prior(discovery, *pair) for pair in zip(found, candidates, strict=True)]
        of_once = [(candidate, _prior(discovery, candidate, candidate)) for candidate in once]
        return cls(
            tuple(found),
            tuple(candidates),
            tuple(
                tuple(causes.index(candidate) for candidate in group if candidate in causes)
                for group in discovery.groups
            ),
            _Measured.of(mine, discovery.solution.noise, candidates, of_once),
            _Measured.of(theirs, noise, candidates, nuisance),
            np.reshape(block_diag(*priors), [sum(candidate.size for candidate in candidates)] * 2),
            fit,
            np.asarray(discovery.fit.identifiable),
        )

    @property
    def joints(self) -> int:
        """Number of joints k."""
        return self.fit.model.joints

    def where(self, group: Sequence[int]) -> IntArray:
        """Return the indices of the parameters of some candidates among the m of all `candidates`.

        ``group``: indices of these candidates; (0,) if it is empty.
        """
        edges = np.cumsum([0, *(candidate.size for candidate in self.candidates)])
        parts = [np.arange(edges[i], edges[i + 1]) for i in group]
        return np.concatenate([np.zeros(0, np.int64), *parts])

    def fitted(self, choices: Choices) -> _Fitted:
        """Fit both sessions at once: each zero-offset and cause shared, own, or absent there.

        ``choices``: of each zero-offset, then of each cause in `groups`; 'own' is another
        value in the other session, 'absent' 0 there.
        """
        here, there, k, m = self.here, self.there, self.joints, len(self.precision)
        first, second = here.size + m, there.size
        per_radian = self.fit.model.chain.per_radian
        prior = block_diag(np.diag(_natural(second, per_radian)), self.precision)
        to = np.concatenate((np.arange(k), np.full(second - k, -1), here.size + np.arange(m)))
        own_indices = [np.arange(k, second)]
        wheres = [*np.arange(k)[:, None], *(second + self.where(group) for group in self.groups)]
        for where, choice in zip(wheres, choices, strict=True):
            to[where] = -1 if choice == 'absent' else to[where]
            own_indices += [where] if choice == 'own' else []
        at = first
        for where in own_indices:
            to[where] = at + np.arange(len(where))
            at += len(where)
        blocks = [prior[np.ix_(where, where)] for where in own_indices]
        H = block_diag(np.diag(_natural(here.size, per_radian)), self.precision, *blocks)
        h = np.zeros(at)
        H[:first, :first] += here.products[:-1, :-1]
        h[:first] += here.products[:-1, -1]
        products, loss = self._of_the_other
        # Both sessions' zero-offsets count from those that this one is linearised at.
        known = products[:-1, :-1]
        steps = here.data.context.joint_offsets - there.data.context.joint_offsets
        pull = products[:-1, -1] - known[:, :k] @ steps
        kept = to >= 0
        H[np.ix_(to[kept], to[kept])] += known[np.ix_(kept, kept)]
        h[to[kept]] += pull[kept]
        root = cholesky(H)
        values = cho_solve((root, False), h)
        square = products[-1, -1] - steps @ (2.0 * pull[:k] + known[:k, :k] @ steps)
        evidence = 0.5 * (h @ values + sum(np.linalg.slogdet(block)[1] for block in blocks))
        evidence -= 0.5 * square + loss
        return _Fitted(float(evidence - np.sum(np.log(np.diag(root)))), values, root, to)

    @cached_property
    def _of_the_other(self) -> tuple[FloatArray, float]:
        """Matrix X'WX of the other session, and a term to subtract from the log evidence.

        Rows and columns as in `_Measured.products`. If `share` is above 0, the other session has
        arm errors of its own, with that share of the prior variance: they are marginalised, and
        the term is half the log determinant of their posterior over prior precision, see
        `_Measured.apart`. If it is 0: the other session's `products` unchanged, and 0.
        """
        if self.share == 0.0:
            return self.there.products, 0.0
        return self.there.apart(self.precision / self.share)

    def most_likely(self) -> tuple[_Both, Choices]:
        """Return both sessions at their most likely `share`, and the most likely choices.

        Hill climbing from all 'shared' by single changes, while one raises the log evidence by
        more than `NEEDED` (odds of twenty to one).
        """
        # What happened once is no matter of the other session.
        possible = [CHOICES[:2]] * self.joints
        possible += [CHOICES if group else ('shared',) for group in self.groups]
        both, best = self, tuple(choices[0] for choices in possible)
        alternatives = [self, *(replace(self, share=share) for share in SHARES)]
        value = both.fitted(best).log_evidence
        while True:
            tried = [(other, best) for other in alternatives if other is not both]
            tried += [
                (both, _with(best, i, choice))
                for i, choices in enumerate(possible)
                for choice in choices
                if choice != best[i]
            ]
            values = [other.fitted(choices).log_evidence for other, choices in tried]
            if max(values) < value + NEEDED:
                return both, best
            value, (both, best) = max(values), tried[int(np.argmax(values))]

    def judged(
        self, best: Choices, index: int, rows: BoolArray, effect: FoundEffect
    ) -> ConfirmedCause:
        """Compare a cause in both sessions: its evidence, parameters and RMS errors.

        ``best``: choices of all zero-offsets and causes; only that of this cause is varied for
        the evidence; ``index``: of the cause in `groups`; ``rows``: mask of the other session's
        rows in which its RMS errors are taken, all other causes being fitted to that session
        (see `error`). A cause without candidates (a step) has 0 rows, no errors and the answer
        'open'.
        """
        group = self.groups[index]
        if not group:
            return ConfirmedCause(effect.name, effect.joints, None)
        fits = {c: self.fitted(_with(best, self.joints + index, c)) for c in CHOICES}
        largest = max(fit.log_evidence for fit in fits.values())
        evidence = {choice: fit.log_evidence - largest for choice, fit in fits.items()}
        without, frozen = self.error(rows=rows, absent=group), self.error(rows=rows, frozen=group)
        return ConfirmedCause(
            effect.name,
            effect.joints,
            share_of_gain(without, frozen, self.error(rows=rows)),
            int(rows.sum()),
            without,
            frozen,
            self._side_by_side(group, fits['own']),
            answer_of(evidence),
            evidence,
        )

    @cached_property
    def alone(self) -> _Fitted:
        """Fit of both sessions in which each has its own value of every zero-offset and cause.

        Candidates that belong to no cause have one value for both.
        """
        every: Choices = (CHOICES[1],) * (self.joints + len(self.groups))
        return self.fitted(every)

    @cached_property
    def _spread(self) -> FloatArray:
        """Covariance of the m parameters of `candidates` for this session in `alone`, (m, m).

        Includes their prior. Candidates that belong to no cause have one value for both sessions,
        so the other session counts for these, too.
        """
        return self.alone.covariance(self.here.size + np.arange(len(self.precision)))

    def told(self, group: Sequence[int]) -> BoolArray:
        """Mask of the other session's rows in which a cause's driver is in the range seen here.

        ``group``: indices of the cause's candidates: in range for one of them is enough; all
        rows if it is empty. (all rows,).
        """
        context, mine = self.there.data.context, self.here.data.part
        seen = [_seen(self.found[i], mine)(context) for i in group]
        return np.any(seen, axis=0) if group else np.ones(len(context), dtype=bool)

    def error(
        self,
        *,
        absent: Sequence[int] = (),
        frozen: Sequence[int] = (),
        rows: BoolArray | None = None,
        joint_offsets: FloatArray | None = None,
    ) -> float:
        """Return the RMS 3-D error of the other session with some parameters fixed, m.

        ``absent``: indices of candidates whose parameters are fixed at 0; ``frozen``: of those
        fixed at the values found in this session, except parameters that this session hardly
        determines; ``joint_offsets``: zero-offsets to fix, rad or m, (k,), or None. All other
        parameters are fitted to the other session. The error is over its validation rows, or its
        fitted rows if it has none; of these only the ones in the mask ``rows``, (all rows,),
        unless that leaves none.
        """
        there, k, size = self.there, self.joints, self.there.size
        parameters = np.full(size + len(self.precision), np.nan)
        if joint_offsets is not None:
            parameters[:k] = joint_offsets - there.data.context.joint_offsets
        found = self.alone.values[self.here.size :][: len(self.precision)]
        is_determined = np.diag(self._spread) < HALF**2 * np.diag(np.linalg.inv(self.precision))
        for candidates, values in ((absent, 0.0 * found), (frozen, found)):
            where = self.where(candidates)
            where = where[is_determined[where]]
            parameters[size + where] = values[where]
        free, fixed = np.isnan(parameters), ~np.isnan(parameters)
        H = there.plain[:-1, :-1] + block_diag(np.diag(_natural(size)), self.precision)
        h = there.plain[:-1, -1][free] - H[np.ix_(free, fixed)] @ parameters[fixed]
        parameters[free] = _solved(H[np.ix_(free, free)], h)
        data = there.data
        residuals = data.full_errors - data.full_jacobian @ parameters[:size]
        residuals -= data.displaced(self.candidates, parameters[size:])
        judged = data.context.measurements.is_validation
        if not judged.any():
            judged = np.isin(np.arange(len(judged)), data.rows.source)
        if rows is not None and np.any(judged & rows):
            judged = judged & rows
        return rms(residuals, judged)

    def own(self, best: Choices) -> list[int]:
        """Return the joints (from 0) whose choice in ``best`` is 'own': another value there."""
        return [joint for joint, choice in enumerate(best[: self.joints]) if choice == 'own']

    def offsets(self, best: Choices, joint: int) -> tuple[FloatArray, FloatArray] | None:
        """Return a joint's zero-offsets in this and the other session, and their covariance.

        (2,), rad or m, and (2, 2), from a fit in which only this joint's choice is 'own'
        instead of that in ``best``. ``joint``: from 0. None if one of the sessions does not
        determine the offset.
        """
        fit = self.fitted(_with(best, joint, 'own'))
        where = np.array([joint, fit.there[joint]])
        covariance = fit.covariance(where)
        weak = WEAK_ANGLE * self.fit.model.chain.per_radian[joint]
        known = self.identifiable[joint] and not self.fit.gauge.why[joint]
        if not known or np.sqrt(np.diag(covariance).max()) >= weak:
            return None
        return self.here.data.context.joint_offsets[joint] + fit.values[where], covariance

    def offsets_side_by_side(self, discovery: Discovery, best: Choices) -> tuple[Compared, ...]:
        """Compare the zero-offset of each joint that both sessions determine, in degrees or mm.

        ``best``: choices of all zero-offsets and causes, changed only for the joint compared.
        Joints that one session does not determine are left out.
        """
        rows: list[Compared] = []
        chain = discovery.fit.chain
        for joint, name in enumerate(discovery.fit.joint_names):
            pair = self.offsets(best, joint)
            if pair is not None:
                scale, unit = chain.shown_scale[joint], chain.shown_units[joint]
                rows += _compared([name], unit, scale * pair[0], scale**2 * pair[1])
        return tuple(rows)

    def _side_by_side(self, group: Sequence[int], fit: _Fitted) -> tuple[Compared, ...]:
        """Compare the parameters of a cause in both sessions.

        ``group``: indices of its candidates; ``fit``: one in which the cause has parameters of
        its own in each session. Of a curve: heights, less their mean, at the places that both
        sessions measured; left out if there are fewer than two.
        """
        rows: list[Compared] = []
        for i in group:
            candidate, wide, where = self.found[i], self.candidates[i], self.where([i])
            names, heights = list(candidate.parameters), np.eye(wide.size)
            if candidate.curve is not None and wide.curve is not None:
                driver = _driver(self.here.data.context, candidate)
                there = driver.value(self.there.data.part)
                places = candidate.curve.places
                seen = candidate.curve.seen(places, 0.5) & candidate.curve.among(there).seen(
                    places, 0.5
                )
                axes = candidate.size // len(places)
                names = [n for n, both in zip(names, np.repeat(seen, axes), strict=True) if both]
                if len(names) < 2 * axes:
                    # Of one place nothing is left less the mean.
                    continue
                heights = wide.curve.columns(places[seen])
                heights = np.kron(heights - heights.mean(axis=0), np.eye(axes))
            both = np.append(self.here.size + where, fit.there[self.there.size + where])
            twice = block_diag(heights, heights)
            covariance = twice @ fit.covariance(both) @ twice.T
            rows += _compared(names, candidate.unit, twice @ fit.values[both], covariance)
        return tuple(rows)


def _compared(
    names: Sequence[str], unit: str, values: FloatArray, covariance: FloatArray
) -> list[Compared]:
    """Compare n values of this session with those of the other, both in ``values``, (2 n,).

    This session's values come first; ``covariance``: (2 n, 2 n). ``sigmas`` is None if the
    difference has no standard deviation.
    """
    found, n = [], len(names)
    variance = np.diag(covariance)
    for i, name in enumerate(names):
        mine, other = float(values[i]), float(values[n + i])
        std = float(np.sqrt(variance[i] + variance[n + i] - 2.0 * covariance[i, n + i]))
        sigmas = (other - mine) / std if std > 0.0 else None
        stds = np.sqrt(variance[[i, n + i]]).tolist()
        found.append(Compared(str(name), unit, mine, stds[0], other, stds[1], sigmas))
    return found


def answer_of(evidence: Mapping[Choice, float]) -> Answer:
    """Return the answer on a cause by the log evidence of 'shared', 'own' and 'absent'.

    'changed' or 'absent' if one of these clearly beats 'shared'; 'confirmed' if 'shared' clearly
    beats 'absent' and beats 'own' by a factor of two; else 'open'.
    """
    shared, own_evidence, absent = evidence['shared'], evidence['own'], evidence['absent']
    if max(own_evidence, absent) > shared + NEEDED:
        return 'changed' if own_evidence > absent + NEEDED else 'absent'
    if shared < absent + NEEDED or shared < own_evidence + HALVED:
        return 'open'
    return 'confirmed'


def _by_itself(data: Residuals, causes: Sequence[Candidate]) -> tuple[Noise, list[_Weighted]]:
    """Return a session's noise, and its errors of the measurement with their prior precisions.

    Both are of a fit of ``causes`` and of all kinds of errors as random effects. If the latter do
    not explain the session clearly better, the noise is of ``causes`` alone, and [] is returned
    for the errors.
    """
    candidates = [
        candidate
        for effect in effects_of(data.context).values()
        if not effect.moves_the_fit and not effect.needs(data.context)
        for candidate in effect.candidates(data.context)
    ]
    each = [Family.of(data, f'cause {i}', [candidate]) for i, candidate in enumerate(causes)]
    every = kinds(data, candidates, causes)
    found = solve(data, [kind.candidate for kind in each if kind is not None])
    if found is None:
        return data.noise, []
    # Of few rows all kinds together would explain the noise as well.
    full_solution = solve(data, [*found.candidates, *(kind.candidate for kind in every)], found)
    if full_solution is None or full_solution.log_evidence < found.log_evidence + NAMED:
        return found.noise, []
    weights = full_solution.weight_precisions()
    return full_solution.noise, [
        (family.candidate, weights[family.candidate] * np.eye(family.candidate.size))
        for family in every
        if family.members[0].of_measurement
    ]


def _natural(size: int, per_radian: FloatArray | None = None) -> FloatArray:
    """Return the diagonal prior precision of a session's natural parameters, (size,).

    1 each: registrations and markers are known to a metre or radian. With ``per_radian``, (k,),
    the first k are zero-offsets of standard deviation `STEP_STD` times ``per_radian``, rad or m.
    """
    found = np.ones(size)
    if per_radian is not None:
        found[: len(per_radian)] = (STEP_STD * per_radian) ** -2.0
    return found


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of a positive definite system whose parameters have units far apart.

    ``matrix``: (c, c); ``right``: (c,) or (c, r).
    """
    unit = np.diag(matrix) ** -0.5
    factor = cho_factor(matrix * np.outer(unit, unit), check_finite=False)
    return (unit * cho_solve(factor, (unit * right.T).T, check_finite=False).T).T


def _prior(discovery: Discovery, candidate: Candidate, wide: Candidate) -> FloatArray:
    """Return the prior precision of the parameters of a candidate of the arm's errors, (m, m).

    As in the discovery's solution for a free form (spline), or if the candidate belongs to no
    cause. Else the prior standard deviation is as large as the RMS of the parameters found.
    ``wide``: the candidate as returned by `widened`.
    """
    solution, fit = discovery.solution, discovery.fit
    is_cause = any(candidate in group for group in discovery.groups)
    if candidate in solution.candidates and (candidate.penalty is not None or not is_cause):
        index = solution.candidates.index(candidate)
        ridge = solution.ridge[solution.slices()[index]]
        if wide.penalty is None:
            return np.diag(ridge)
        return solution.smoothness[index] * wide.penalty + ridge[0] * np.eye(wide.size)
    chosen = [fit.theta_names.index(name) for name in candidate.parameters]
    return np.eye(candidate.size) / float(
        np.mean(fit.theta[chosen] ** 2 + fit.theta_std[chosen] ** 2)
    )


def _driver(context: Context, candidate: Candidate) -> Driver:
    """Return the driver that a candidate depends on, of its last joint if it has joints.

    AssertionError if the driver is not a single quantity.
    """
    driver = driver_named(
        context, candidate.driver, candidate.joints[-1] if candidate.joints else 0
    )
    assert driver is not None
    return driver


def widened(candidate: Candidate, mine: Context, theirs: Context) -> Candidate:
    """Return a copy of a candidate whose curve reaches over the values of both sessions.

    Its mean over this session's values (``mine``) is zero. The candidate itself if it has no
    curve, or is not about a joint's angle.
    """
    if candidate.curve is None or candidate.place != 'joint_angle':
        return candidate
    driver = _driver(mine, candidate)
    values = np.concatenate([driver.value(mine), driver.value(theirs)])
    curve = Curve.of(values, 0.0, candidate.curve.step, not np.isnan(candidate.curve.start))
    curve = replace(curve, weights=curve.splines(driver.value(mine)).mean(axis=0))
    names = tuple(f'{candidate.parameters[0]} {place:+.4f}' for place in curve.places)
    columns = partial(_free, joint=candidate.joints[0], driver=driver, curve=curve)
    return replace(
        candidate, columns=columns, parameters=names, penalty=curve.penalty, curve=curve
    )


def _free(context: Context, joint: int, driver: Driver, curve: Curve) -> Design:
    """Return columns of a curve of a driver that adds to a joint's (1-based) position."""
    return Design(joint - 1, curve.columns(driver.value(context)))


def _seen(candidate: Candidate, mine: Context) -> Callable[[Context], BoolArray]:
    """Return a function of a context: mask of rows in the range that this session saw, (n,).

    The range is that of the candidate's driver in ``mine``; of a curve, near a value seen; of a
    field or distortion, a box of positions in its sensor's frame. True in all rows for others.
    """
    driver = driver_named(mine, candidate.driver, candidate.joints[-1] if candidate.joints else 0)
    if driver is not None:
        if candidate.curve is not None:
            curve = candidate.curve
            return lambda context: curve.seen(driver.value(context))
        values = driver.value(mine)
        if driver.is_angle and mine.turns_over(driver.joint):
            start = start_of_turn(values)
            values = in_turn(values, start)
            return lambda context: _between(in_turn(driver.value(context), start), values)
        return lambda context: _between(driver.value(context), values)
    if candidate.driver == 'position' and candidate.form != 'linear':
        sensor = mine.sensor_names.index(candidate.subject)
        box = mine.in_sensor[mine.seen_by(sensor)]
        return lambda context: (
            np.all([_between(context.in_sensor[:, i], box[:, i]) for i in range(3)], axis=0)
            | ~context.seen_by(sensor)
        )
    return lambda context: np.ones(len(context), dtype=bool)


def _between(values: FloatArray, seen: FloatArray) -> BoolArray:
    """Mask of the values within the range of ``seen``, ends included."""
    inside: BoolArray = (values >= seen.min()) & (values <= seen.max())
    return inside


def require_other_session(session: Session, other: Session) -> None:
    """Raise InputError if two sessions cannot be compared.

    If joints, geometry, sensors or markers differ, or if more than a tenth of the rows of the
    smaller session are also in the other.
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
    for kind, own_names, other_names in (
        ('sensors', mine.sensor_names, theirs.sensor_names),
        ('markers', mine.marker_names, theirs.marker_names),
    ):
        if own_names != other_names:
            raise InputError(
                f'the other session has the {kind} {", ".join(other_names)}, not '
                f'{", ".join(own_names)}; confirm with a session of the same cell'
            )
    rows = len(other.measurements)
    equal = len(_readings(session) & _readings(other))
    if equal > SAME_ROWS * min(rows, len(session.measurements)):
        raise InputError(
            f'{equal} of the {rows} rows of the other session are measurements of this session: '
            'a session cannot confirm itself; give one that was measured at another time'
        )


def _readings(session: Session) -> set[bytes]:
    """Return the joint positions and measured position of each row as bytes, rounded.

    To 1e-9 rad or m, so that equal readings of two sessions can be found.
    """
    m = session.measurements
    rounded = np.round(np.concatenate((m.q, m.position), axis=1), 9) + 0.0
    return {row.tobytes() for row in rounded}


def in_words(discovery: Discovery, confirmation: Confirmation) -> list[str]:
    """Return sentences on a confirmation: whether the zero-offsets are the same, then each cause.

    Only `Confirmation.why` if nothing can be compared. A single sentence if the zero-offsets
    differ and nothing is confirmed, so that the other session is probably of another arm.
    """
    found = confirmation
    if found.why:
        return [found.why]
    carried = (
        'the causes could gain next to nothing there'
        if found.carried_over is None
        else f'{percent(found.carried_over)} of what they could gain there'
    )
    lines = [
        f'In {found.rows_common} of its {found.rows} rows all that drives the causes was seen '
        f'here. In these it is {1e3 * found.rms_before_m:.3f} mm RMS without the causes, '
        f'{1e3 * found.rms_after_m:.3f} mm with them as found here, '
        f'{1e3 * found.rms_own_m:.3f} mm with them fitted there: {carried}. What this session '
        'does not tell is fitted to the other one.'
    ] * bool(found.effects)
    if found.differ_by and lines:
        lines[0] += (
            f' Both are compared as sessions in which each error of the arm may differ by '
            f'{percent(found.differ_by)} of its size: no model is the arm.'
        )
    offsets = (
        f'they are {rms_sigmas(found.joint_offsets) or 0.0:.1f} standard deviations apart on the '
        f'average, and the error is {1e3 * found.rms_frozen_offsets_m:.3f} mm RMS with those '
        'found here'
    )
    own_error = f'{1e3 * min(found.rms_own_m, found.rms_before_m):.3f} mm with its own'
    holds = any(cause.answer == 'confirmed' for cause in found.effects)
    if not found.same_offsets and not holds and not found.carries_over:
        return [
            f'The zero-offsets found here are not those of the other session: {offsets}, '
            f'{own_error}. That is another arm, or it was mastered anew in between: nothing is '
            'confirmed.'
        ]
    if not found.same_offsets:
        lines.append(
            f'Of {joint_words(found.other_joints)} the zero-offset is another one there: '
            f'{offsets}, {own_error}. That is another arm of this kind, or it was mastered anew '
            'in between, or what imitates an offset has changed.'
        )
    elif found.joint_offsets:
        lines.append(f'The zero-offsets are the same, {offsets}: it is the same arm.')
    if found.open_joints:
        lines.append(
            f'The zero-offset of {joint_words(found.open_joints)} fits better as another one '
            'there, but the sessions do not determine it: what the causes leave out may do that.'
        )
    lines += [
        f'{effect.title}{_said(cause)}'
        for effect, cause in zip(discovery.effects, found.effects, strict=False)
    ]
    return lines


def _said(cause: ConfirmedCause) -> str:
    """Return the answer on a cause as text, with the errors in the other session.

    The errors are RMS in mm, in that session without the cause and with it as found in this
    one. The text follows the title of the cause: it begins with '. ' or ': '. It has no errors
    if the other session cannot tell, or if the cause happened once, in this session only.
    """
    evidence, without, frozen = cause.log_evidence, cause.rms_without_m, cause.rms_frozen_m
    if evidence is None or without is None or frozen is None:
        return ': it happened once, and is no matter of the other session.'
    change = f'{1e3 * without:.3f} to {1e3 * frozen:.3f} mm RMS'
    share = (
        f'as found here it goes from {change}'
        if cause.carried_over is None or cause.carried_over < 0.0
        else f'{percent(cause.carried_over)} of what it could gain from it, {change}'
    )
    if cause.answer == 'confirmed':
        return f'. Confirmed: both sessions share it ({share}).'
    if cause.answer == 'changed':
        return f'. Changed: there, but not as it was found here ({share}).'
    if cause.answer == 'absent':
        return f'. Not there any more: the other session does not show it ({share}).'
    if evidence['shared'] > evidence['absent'] + NEEDED:
        return f'. There too; whether it is the same cannot be told ({share}).'
    return ': the other session cannot tell; measure the arm where this session did.'
