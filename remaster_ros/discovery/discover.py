"""What the simulation gets wrong: its cause by name, the model extended by it, the gain measured.

One model holds every kind of error (`random_effects`): what stands out of it is named (`causes`),
and what does not keeps a variance of its own, so that offsets and predictions state what errors
that nobody can name would do to them. Optimization rows decide; validation rows only measure the
gain, and refuse a model that predicts them worse than the offsets do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.outliers import find_outliers
from remaster_ros.calibration.result import FitResult
from remaster_ros.calibration.sampling import Progress, silent
from remaster_ros.discovery.causes import NAMED, NEEDED, Search, p_value
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect, describe
from remaster_ros.discovery.gain import (
    Gain,
    fails_held_out,
    gain_of,
    noise_by_range,
    pose_common_fraction,
    residuals_of,
)
from remaster_ros.discovery.geometry_model import GeometryModel, geometry_model
from remaster_ros.discovery.guard import Unexplained, harm_of, is_harmful, nameless, unfitted
from remaster_ros.discovery.marker_offsets import loosened, moved_markers
from remaster_ros.discovery.omnibus import beyond_noise, structure_left
from remaster_ros.discovery.random_effects import (
    Family,
    by_members,
    fit_kinds,
    kinds,
    with_kinds,
)
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.thinning import Thinning, draw_rows, judge_by_others
from remaster_ros.discovery.to_extension import (
    extension_of,
    moved_by,
    moved_by_names,
    moved_by_open_offsets,
    offsets_of,
)
from remaster_ros.errors import InsufficientDataError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import FloatArray, IntArray, Session

Verdict = Literal['effects', 'none', 'undetermined', 'unexplained']
# Of the means, in standard deviations: 400 effective draws, enough for values of two figures.
PRECISION = 0.05
# A cause with this share of the gain is one of the leaders.
LEADING_SHARE = 0.1
NOT_LOADED = 'No robot model with it predicts held-out poses better than the zero-offsets do.'


@dataclass(frozen=True, eq=False)
class Discovery:
    """What was found in a session.

    Attributes
    ----------
    verdict
        'effects', 'none', 'undetermined' where the leading explanations tie, or 'unexplained'
        where the causes that were searched do not hold on poses never fitted.
    effects
        The causes, the largest first.
    gain
        On the validation rows.
    pose_common_fraction
        Share of the remaining noise that all rows of a pose have in common.
    noise_by_range
        By sensor: ratio of the errors far to near, and the p-value that they are equal.
    outliers
        ``observation`` of every gross error, with the reason: set aside, or held out.
    untestable
        Name of an effect -> why this session cannot show it.
    groups
        The cells of each effect that was searched for, in the order of ``effects``.
    empty, named, solution
        Fits of the offsets alone, of these with the causes and located structure, and of the whole
        model with all kinds of errors that have no name of their own.
    residuals
        What the search worked on.
    offsets_before
        Zero-offsets without the effects, and their stds (NaN where the gauge holds them), rad.
    fit
        The sampled fit, with the effects where there are any.
    thinning
        Which part of a large session was searched, and how the causes hold on the rest; None where
        all of it was searched.
    residuals_before
        Measured minus modelled position of every row with the zero-offsets alone, in the frame of
        its sensor, m, (n, 3).
    unexplained
        Structure that no cause explains.
    alone
        The sampled fit whose zero-offsets are right where nothing else of the arm is corrected:
        with errors of the measurement taken out where they are certain, and no other.
    geometry
        All lengths and tilts beside the zero-offsets, the same taken out; None where they cannot
        be fitted.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    gain: Gain
    pose_common_fraction: float
    noise_by_range: Mapping[str, Mapping[str, float]]
    outliers: tuple[tuple[int, str], ...]
    untestable: Mapping[str, str]
    offsets_before: tuple[FloatArray, FloatArray]
    groups: tuple[tuple[Cell, ...], ...]
    empty: Solution
    named: Solution
    solution: Solution
    residuals: Residuals
    fit: FitResult
    residuals_before: FloatArray
    alone: FitResult
    geometry: GeometryModel | None
    thinning: Thinning | None = None
    unexplained: tuple[Unexplained, ...] = ()

    @property
    def loads_geometry(self) -> bool:
        """Whether a robot model with all lengths and tilts is worth loading.

        Held-out poses decide; without them, or where these gain by chance alone, that a length or
        tilt is among the causes.
        """
        if self.geometry is None:
            return False
        is_cause = any(effect.in_robot_model for effect in self.effects)
        if not self.geometry.judged.any():
            return is_cause
        gains = self.geometry.held_out_m < self.geometry.drawing_held_out_m
        return self.geometry.is_better or (is_cause and gains)


@one_thread
def discover_session(
    session: Session,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    clock: Callable[[], float] | None = None,
) -> Discovery:
    """Find what the offsets model leaves out, and extend it.

    Parameters
    ----------
    session
        As read from its folder.
    rng
        Source of all randomness: the same one gives the same result.
    progress
        Called with the stage and the share of it that is done.
    clock
        Returns seconds, to time the samplers.

    Raises
    ------
    InputError
        A session that does not fit its robot.
    InsufficientDataError
        Data that do not allow an answer.
    """
    report = progress if progress is not None else silent
    report('offsets', 0.0)
    # What causes do to orientations is not modelled.
    session = session.positions_alone()
    before = sound_estimate(session)
    found, residuals, pool = _to_search(session, before, rng)
    untestable = {
        name: why for name, effect in EFFECTS.items() if (why := effect.needs(residuals.context))
    }
    cells = [
        cell
        for name, effect in EFFECTS.items()
        if name not in untestable and not effect.moves_the_fit
        for cell in effect.cells(residuals.context)
    ]
    search = Search(residuals, cells, lambda share: report('searching causes', share))
    named = search.run()
    if (judged := _judged(found, residuals, named, search, pool)) is not residuals:
        search, named = search.again(judged, named)
    named, groups, described = _that_help(search, named, report)
    search.let_go()
    unexplained: tuple[Unexplained, ...] = ()
    sampled: _Sampled | None = None
    # Kinds that nobody named may be what does harm, or what the poses do not determine. Where
    # their model does not hold on held-out poses, these decide between it and the names alone.
    beside = _Beside(search, named)
    for every in (True, False):
        try:
            tried = _sampled(session, before, found, beside, every, rng, report, clock)
        except InsufficientDataError as error:
            if described and not every and sampled is None:
                unexplained = (unfitted(residuals.errors, described, error),)
            continue
        if is_harmful(tried.gain):
            if described and tried.by_name and sampled is None:
                unexplained = (harm_of(before, tried.fit, tried.gain, described),)
        elif sampled is None or tried.predicts_better_than(sampled):
            sampled = tried
        holds = sampled is tried and not fails_held_out(search.data, tried.solution, tried.fit)
        if tried.by_name or holds:
            break
    if sampled is None:
        found, search = before, Search(Residuals.of(before), ())
        empty = search.fit(())
        assert empty is not None
        named, groups, described = empty, (), ()
        beside = _Beside(search, named)
        sampled = _sampled(session, before, found, beside, False, rng, report, clock)
    data, solution, fit, gain = search.data, sampled.solution, sampled.fit, sampled.gain
    is_cause = [EFFECTS[group[0].name].is_cause for group in groups]
    structure = tuple(e for e, cause in zip(described, is_cause, strict=True) if not cause)
    left, gross = structure_left(data, solution, fit, structure)
    unexplained += left
    causes = [
        (effect.sampled(fit, group, data), group)
        for effect, group, so in zip(described, groups, is_cause, strict=True)
        if so
    ]
    causes.sort(key=lambda cause: -cause[0].size_m)
    effects, groups = zip(*causes, strict=True) if causes else ((), ())
    effects += tuple(effect.sampled(fit) for effect in moved_markers(found, data, named))
    empty = search.fit(())
    assert empty is not None
    if not effects and not sampled.by_name:
        gain_of_kinds = solution.log_evidence - empty.log_evidence
        unexplained += (nameless(data, solution, p_value(gain_of_kinds)),)
    if not effects and not unexplained:
        unexplained = tuple(beyond_noise(data, fit))
    verdict: Verdict = 'effects' if effects else 'unexplained' if unexplained else 'none'
    # A tie over a small remainder does not put the rest in doubt. The largest leads in any case:
    # where held-out poses gain nothing no share is known.
    leading = [effect for effect in effects if (effect.share or 0.0) > LEADING_SHARE]
    if any(effect.tied for effect in (*effects[:1], *leading)):
        verdict = 'undetermined'
    report('fitting what can be loaded', 0.0)
    measured = [
        cell
        for effect, group in zip(effects, groups, strict=False)
        if effect.is_taken_out
        for cell in group
    ]
    alone = fit
    # Kinds that nobody named are in no file with zero-offsets either.
    if not {*solution.cells} <= {*measured}:
        errors = search.fit(measured) if measured else None
        alone = fit_session(
            session,
            rng=rng,
            clock=clock,
            priors=None if found is before else found.problem.priors,
            precision=PRECISION,
            extension=None if errors is None else extension_of(data, errors, found),
            found=found,
        )
    outliers = fit.left_out + gross
    geometry = geometry_model(found, causes=measured)
    if geometry is not None:
        geometry = geometry.beside(alone, [observation for observation, _ in outliers])
    thinning = None
    if len(pool) < len(found.problem.fitted):
        thinning = judge_by_others(data, found.kept, data.rows.source, empty, solution)
    result = Discovery(
        verdict=verdict,
        effects=effects,
        gain=gain,
        pose_common_fraction=pose_common_fraction(data, solution),
        noise_by_range=noise_by_range(data, solution),
        outliers=outliers,
        untestable=untestable,
        offsets_before=offsets_of(before),
        groups=groups,
        empty=empty,
        named=named,
        solution=solution,
        residuals=data,
        fit=fit,
        residuals_before=residuals_of(before),
        alone=alone,
        geometry=geometry,
        thinning=thinning,
        unexplained=unexplained,
    )
    if result.loads_geometry:
        return result
    effects = tuple(replace(e, remedy=NOT_LOADED) if e.in_robot_model else e for e in effects)
    return replace(result, effects=effects)


def _to_search(
    session: Session, before: Estimate, rng: np.random.Generator
) -> tuple[Estimate, Residuals, IntArray]:
    """Return the fit to search beside, its residuals, and the rows that may be searched."""
    found, residuals = before, Residuals.of(before)
    bare = solve(residuals, ())
    moved = moved_markers(found, residuals, bare) if bare is not None else ()
    if moved:
        # A marker that is pulled to where it is not leaves errors for other causes to explain.
        found = estimate(Problem.of(session, loosened(session, moved)))
        residuals = Residuals.of(found)
    pool = draw_rows(found.problem.measurements, found.problem.fitted, rng)
    if len(pool) < len(found.problem.fitted):
        residuals = residuals.only(np.intersect1d(pool, found.kept))
    return found, residuals, pool


def _that_help(
    search: Search, named: Solution, report: Progress
) -> tuple[Solution, tuple[tuple[Cell, ...], ...], tuple[FoundEffect, ...]]:
    """Return the causes without those that take the held-out poses further off.

    What they explain of the fitted rows is left to the variances of all kinds of errors.
    """
    while True:
        groups, effects = describe(
            search, named, lambda share: report('comparing look-alikes', share)
        )
        if not search.data.context.measurements.is_validation.any():
            return named, groups, effects
        worst = min(
            (index for index, effect in enumerate(effects) if (effect.share or 0.0) < 0.0),
            key=lambda index: effects[index].share or 0.0,
            default=None,
        )
        if worst is None:
            return named, groups, effects
        out = set(groups[worst])
        out |= {one.cell for one in search.families if out & set(one.members)}
        fewer = search.fit([cell for cell in named.cells if cell not in out], named)
        if fewer is None:
            return named, groups, effects
        named = fewer


@dataclass(frozen=True, eq=False)
class _Sampled:
    """A sampled model, its gain, and whether it has nothing but what has a name."""

    solution: Solution
    fit: FitResult
    gain: Gain
    by_name: bool

    def predicts_better_than(self, other: _Sampled) -> bool:
        """Return whether its errors on held-out poses are smaller."""
        mine, others = self.gain.held_out_rms_after_m, other.gain.held_out_rms_after_m
        return mine is not None and others is not None and mine < others


def _sampled(
    session: Session,
    before: Estimate,
    found: Estimate,
    beside: _Beside,
    every: bool,
    rng: np.random.Generator,
    report: Progress,
    clock: Callable[[], float] | None,
) -> _Sampled:
    """Sample the model of the causes, or of all kinds of errors, and measure its gain."""
    data = beside.search.data
    solution = of_all_kinds(beside) if every else None
    by_name = solution is None
    if solution is None:
        solution, unmodelled = by_names(found, beside)
    else:
        unmodelled = moved_by_names(found, data, beside.members, solution)
    if solution.cells:
        unmodelled = np.concatenate(
            (unmodelled, moved_by_open_offsets(found, data, solution)), axis=1
        )
    fit = fit_session(
        session,
        rng=rng,
        clock=clock,
        # Priors that let moved markers go.
        priors=None if found is before else found.problem.priors,
        precision=PRECISION,
        extension=extension_of(data, solution, found) if solution.cells else None,
        unmodelled=unmodelled,
        progress=lambda _, share: report('sampling the extended model', share),
    )
    return _Sampled(solution, fit, gain_of(before, data, solution, fit, rng), by_name)


@dataclass(frozen=True, eq=False)
class _Beside:
    """The causes that have a name, and all other kinds of errors beside them."""

    search: Search
    named: Solution

    @cached_property
    def members(self) -> Solution:
        """The causes by members."""
        return by_members(self.named, self.search.families)

    @cached_property
    def kinds(self) -> list[Family]:
        """All kinds of errors without the members that have a name."""
        search = self.search
        return kinds(search.data, search.cells, self.members.cells)

    @cached_property
    def fit(self) -> Solution | None:
        """The fit of the causes with these; None where they agree with a cause."""
        return with_kinds(self.search.data, self.named, self.kinds)


def of_all_kinds(beside: _Beside) -> Solution | None:
    """Return the model of all kinds of errors, by members; None where the causes say more.

    A name is a choice among thousands: two halves of one session are not given the same names.
    Offsets, lengths and predictions come from all kinds at once, each with one variance for all
    its members, named or not. Not where so many members explain less than the few causes and
    nothing is beside these (one joint errs and no other), or where nothing is there at all.
    """
    search, named = beside.search, beside.named
    data, cells = search.data, search.cells
    of_a_kind = {name for family in kinds(data, cells) for name in family.parameters}
    members = by_members(named, search.families).cells
    # A curve has a smoothness of its own: that of all together fits none of them.
    own = [
        cell
        for cell in members
        if cell.penalty is not None or not of_a_kind.issuperset(cell.parameters)
    ]
    every = kinds(data, cells, own)
    of_a_name = {name for cell in members for name in cell.parameters}
    unnamed = [family for family in every if of_a_name.isdisjoint(family.parameters)]
    whole = fit_kinds(data, own, [one for one in every if one not in unnamed], unnamed)
    # What only has a place is no kind of error of the arm: what it explains tells nothing of that.
    located = search.fit(
        [one for one in named.cells if one.name in EFFECTS and not EFFECTS[one.name].is_cause]
    )
    if whole is None or located is None or whole.log_evidence < located.log_evidence + NAMED:
        return None
    if whole.log_evidence < named.log_evidence:
        both = beside.fit
        if both is None or both.log_evidence < named.log_evidence + NEEDED:
            return None
    return by_members(whole, every)


def by_names(found: Estimate, beside: _Beside) -> tuple[Solution, FloatArray]:
    """Return the model of the causes alone, by members, and how all other kinds would move it.

    That of all its natural parameters and those of the solution, one standard deviation of each
    weight of a kind that is not in it, (size + m, c).
    """
    data = beside.search.data
    members = by_members(beside.named, beside.search.families)
    weights = {} if beside.fit is None else beside.fit.weight_precisions()
    unseen = (
        data.columns([family.cell]) * weights[family.cell] ** -0.5
        for family in beside.kinds
        if family.cell in weights
    )
    return members, moved_by(found, data, members, unseen)


def _judged(
    found: Estimate, residuals: Residuals, solution: Solution, search: Search, pool: IntArray
) -> Residuals:
    """Return the residuals of the rows of the pool that the causes do not show to be gross."""
    problem = found.problem
    every = residuals.only(pool)
    if any(np.isfinite(cell.moment) for cell in solution.cells):
        # Rows just before or after a step look gross where it is dated without them.
        cells = search.again(every, solution)[1].cells
        solution = search.fit(cells, solution) or solution
    left = every.left(by_members(solution, search.families))
    try:
        gross = find_outliers(every.rows, lambda keep: left, left, problem.sensor_names).gross
    except InsufficientDataError:
        # What is left has long tails: no reason to set a tenth of the rows aside.
        return residuals
    kept = np.sort(every.rows.source[~gross])
    if np.array_equal(kept, np.sort(residuals.rows.source)):
        return residuals
    return residuals.only(kept)
