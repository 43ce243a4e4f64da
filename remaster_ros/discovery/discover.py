"""Discovery of the causes of errors: their names, the model extended by them, the gain measured.

A walk over models (`walk`) finds which sets of causes explain the residuals, beside a background
of all kinds of errors. The best model is sampled on all rows; what the other models would do to
the offsets is in their uncertainty. Optimization rows decide; validation rows measure the gain,
and refuse a model that predicts them worse than the offsets do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from msgspec import structs

from remaster_ros.calibration.dynamics import clocks_of, estimate_beside, estimate_moving
from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.outliers import find_outliers
from remaster_ros.calibration.result import FitResult
from remaster_ros.calibration.sampling import Progress, silent
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import changed
from remaster_ros.discovery.effects.registry import EFFECTS, effects_of
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect, SearchRecord, describe
from remaster_ros.discovery.gain import (
    Gain,
    gain_of,
    noise_by_range,
    pose_common_fraction,
    residuals_of,
)
from remaster_ros.discovery.geometry_model import GeometryModel, geometry_model
from remaster_ros.discovery.guard import (
    Unexplained,
    harm_of,
    is_harmful,
    located,
    nameless,
    unfitted,
)
from remaster_ros.discovery.marker_offsets import loosened, moved_markers
from remaster_ros.discovery.omnibus import beyond_noise, structure_left
from remaster_ros.discovery.random_effects import Family
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.thinning import Thinning, draw_rows, judge_by_others
from remaster_ros.discovery.to_extension import extension_of, offsets_of
from remaster_ros.discovery.unmodelled import Unmodelled
from remaster_ros.discovery.walk import DATED_TO, NAMED, Walk, at_other_moments, p_value
from remaster_ros.errors import InsufficientDataError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import BoolArray, FloatArray, IntArray, Session

Verdict = Literal['effects', 'none', 'undetermined', 'unexplained']
# Of the means, in standard deviations: 400 effective draws, enough for values of two figures.
PRECISION = 0.05
# A cause with this share of the gain is one of the leaders.
LEADING_SHARE = 0.1
NOT_LOADED = 'No robot model with it predicts held-out poses better than the zero-offsets do.'


@dataclass(frozen=True, eq=False)
class Discovery:
    """Result of a search for causes in a session.

    Attributes
    ----------
    verdict
        'effects', 'none', 'undetermined' where the leading explanations tie, or 'unexplained'
        where errors are left that no cause explains.
    effects
        The causes, the largest first; then markers that have moved.
    gain, metrics
        On the validation rows, as `gain_of` returns them.
    pose_common_fraction
        Share of the remaining noise that all rows of a pose have in common.
    noise_by_range
        By sensor: ratio of the errors far to near, and the p-value that they are equal.
    outliers
        ``observation`` of every gross error, with the reason: set aside, or held out.
    untestable
        Name of an effect -> why this session cannot show it.
    groups
        The candidates of each effect that was searched for, in the order of ``effects``.
    background
        Kinds of errors beside the causes in the best model.
    empty, solution
        Fits of the offsets alone, and of the best model: causes, located structure, background.
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
    clocks
        Of a moving session: how late each sensor's stamps are beside the joints', and std, s. They
        were taken out before the search.
    alone
        The sampled fit for a controller that takes zero-offsets alone: errors of the measurement
        that are certain are taken out, errors of the arm are left in the offsets.
    std_if_drawn
        Standard deviation of the zero-offsets of ``fit`` if the arm is exactly its drawing; NaN
        where the gauge holds them, rad, (k,).
    search
        How far the chains of the walk agree, and the causes that are rather not there.
    geometry
        All link lengths and axis tilts fitted beside the zero-offsets, with the same errors of the
        measurement taken out; None if they cannot be fitted.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    gain: Gain
    metrics: Mapping[str, Any]
    pose_common_fraction: float
    noise_by_range: Mapping[str, Mapping[str, float]]
    outliers: tuple[tuple[int, str], ...]
    untestable: Mapping[str, str]
    offsets_before: tuple[FloatArray, FloatArray]
    groups: tuple[tuple[Candidate, ...], ...]
    background: tuple[Family, ...]
    empty: Solution
    solution: Solution
    residuals: Residuals
    fit: FitResult
    residuals_before: FloatArray
    alone: FitResult
    std_if_drawn: FloatArray
    geometry: GeometryModel | None
    search: SearchRecord
    thinning: Thinning | None = None
    unexplained: tuple[Unexplained, ...] = ()
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def loads_geometry(self) -> bool:
        """Whether a robot model with all fitted lengths and tilts is worth loading.

        It is if it predicts held-out poses clearly better than the drawing. If it predicts them
        only slightly better, or if there are no held-out rows, it is worth it only if a length or
        tilt is among the causes. False without `geometry`.
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
    """Find causes of the errors that the offsets model leaves, and extend the model by them.

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
    moving = sound_estimate(session, fitted=estimate_moving) if session.is_moving else None
    if moving is None:
        before = sound_estimate(session)
    else:
        before = sound_estimate(session, fitted=partial(estimate_beside, moving))
    found, residuals, pool = _to_search(session, before, rng)
    candidates, untestable = _candidates(residuals.context)
    searched = _searched(found, residuals, pool, candidates, rng, report)
    sampled = partial(_sampled, session, before, pool=pool, rng=rng, report=report, clock=clock)
    model = _checked(before, found, searched, sampled)
    answer = _answer(model)
    report('fitting what can be loaded', 0.0)
    measurement_errors = [
        candidate
        for effect, group in zip(answer.effects, answer.groups, strict=False)
        if effect.is_taken_out
        for candidate in group
    ]
    offsets_fit = _offsets_alone(session, before, model, measurement_errors, rng, clock)
    outliers = model.fit.left_out + answer.gross
    geometry = geometry_model(model.found, causes=measurement_errors)
    if geometry is not None:
        geometry = geometry.beside(offsets_fit, [observation for observation, _ in outliers])
    # With no cause and no background the two are one fit.
    empty = _bare(model.data) if model.solution.candidates else model.solution
    thinning = None
    if len(pool) < len(model.found.problem.fitted):
        rows = model.data.rows.source
        thinning = judge_by_others(model.data, model.found.kept, rows, empty, model.solution)
    result = Discovery(
        verdict=answer.verdict,
        effects=answer.effects,
        gain=model.gain,
        metrics=model.metrics,
        pose_common_fraction=pose_common_fraction(model.data, model.solution),
        noise_by_range=noise_by_range(model.data, model.solution),
        outliers=outliers,
        untestable=untestable,
        offsets_before=offsets_of(before),
        groups=answer.groups,
        background=model.background,
        empty=empty,
        solution=model.solution,
        residuals=model.data,
        fit=model.fit,
        residuals_before=residuals_of(before),
        alone=offsets_fit,
        std_if_drawn=model.std_if_drawn,
        geometry=geometry,
        search=searched.record,
        thinning=thinning,
        unexplained=answer.unexplained,
        clocks={} if moving is None else clocks_of(moving),
    )
    if result.loads_geometry:
        return result
    effects = tuple(
        structs.replace(effect, remedy=NOT_LOADED) if effect.in_robot_model else effect
        for effect in answer.effects
    )
    return replace(result, effects=effects)


@dataclass(frozen=True, eq=False)
class _Searched:
    """Result of the walk over models: models with their shares, causes and background."""

    data: Residuals  # Rows that were searched
    models: list[tuple[Solution, float]]  # Each with its share, the best first
    background: tuple[Family, ...]  # Of the best model
    groups: tuple[tuple[Candidate, ...], ...]  # Candidates of each effect
    effects: tuple[FoundEffect, ...]
    gain: float  # Log posterior of the best model over that of the offsets alone, nats
    record: SearchRecord


@dataclass(frozen=True, eq=False)
class _Checked:
    """Model that was sampled: that of the search, or the offsets alone if that does not hold."""

    found: Estimate
    data: Residuals
    solution: Solution
    background: tuple[Family, ...]
    groups: tuple[tuple[Candidate, ...], ...]
    effects: tuple[FoundEffect, ...]
    gain_nats: float  # As `_Searched.gain`
    fit: FitResult
    gain: Gain
    metrics: Mapping[str, Any]
    std_if_drawn: FloatArray  # See `Discovery`
    unexplained: tuple[Unexplained, ...]  # Why the model of the walk does not hold


@dataclass(frozen=True, eq=False)
class _Answer:
    """Verdict of a search, with its causes and errors that no cause explains."""

    verdict: Verdict
    effects: tuple[FoundEffect, ...]  # The largest first, then markers that have moved
    groups: tuple[tuple[Candidate, ...], ...]  # Of the effects that the walk has found
    unexplained: tuple[Unexplained, ...]
    gross: tuple[tuple[int, str], ...]  # Gross errors of held-out rows


def _bare(data: Residuals) -> Solution:
    """Fit the offsets model without any cause to the residuals.

    AssertionError if that has no solution.
    """
    solution = solve(data, ())
    assert solution is not None
    return solution


def _candidates(context: Context) -> tuple[list[Candidate], dict[str, str]]:
    """Return all candidate causes of a session, and the effects that it cannot show.

    The candidates include changes in mid-session, but no marker offsets, which are judged by
    the fit itself. The effects that cannot be shown are given as name -> reason.
    """
    effects_tried = effects_of(context)
    untestable = {
        name: why for name, effect in effects_tried.items() if (why := effect.needs(context))
    }
    candidates = [
        candidate
        for name, effect in effects_tried.items()
        if name not in untestable and not effect.moves_the_fit
        for candidate in effect.candidates(context)
    ]
    changes = [(candidate, EFFECTS[candidate.name].changes) for candidate in candidates]
    return [*candidates, *changed(context, changes)], untestable


def _searched(
    found: Estimate,
    residuals: Residuals,
    pool: IntArray,
    candidates: Sequence[Candidate],
    rng: np.random.Generator,
    report: Progress,
) -> _Searched:
    """Walk over models of causes; twice if the best model changes which rows are gross errors.

    ``found``: the fit to be extended; ``residuals``: its residuals; ``pool``: indices of the rows
    to search, gross errors among them; ``candidates``: all causes to try; ``report``: called with
    the stage and the share done.
    """
    walking = partial(report, 'searching causes')
    walk = Walk(residuals, candidates, rng, walking, None)
    data = _judged(found, residuals, walk.best, pool)
    if data is not residuals:
        walk = Walk(data, candidates, rng, walking, walk.models[0])
    groups, effects = describe(walk, partial(report, 'comparing look-alikes'))
    gain = walk.models[0].value - walk.bare.value
    background = walk.models[0].families
    # The walk is not kept: its columns are most of the memory.
    return _Searched(
        data,
        walk.solutions,
        background,
        groups,
        effects,
        gain,
        SearchRecord.of(walk, groups),
    )


def _checked(
    before: Estimate,
    found: Estimate,
    searched: _Searched,
    sampled: Callable[..., tuple[FitResult, tuple[Gain, Mapping[str, Any]], FloatArray]],
) -> _Checked:
    """Sample the best model; or the offsets alone, if it cannot be fitted or predicts worse.

    ``before``: fit of the offsets alone; ``found``: the fit to extend; ``sampled``: `_sampled`
    of the session.
    """
    data, effects = searched.data, searched.effects
    causes, structure = (
        tuple(
            effect
            for effect, group in zip(effects, searched.groups, strict=True)
            if EFFECTS[group[0].name].is_cause == wanted
        )
        for wanted in (True, False)
    )
    named = [candidate for group in searched.groups for candidate in group]
    unexplained: tuple[Unexplained, ...] = ()
    try:
        fit, (gain, metrics), if_drawn = sampled(found, data, searched.models, named)
    except InsufficientDataError as error:
        if causes:
            unexplained = (unfitted(data.errors, effects, error),)
    else:
        if not is_harmful(gain):
            return _Checked(
                found,
                data,
                searched.models[0][0],
                searched.background,
                searched.groups,
                effects,
                searched.gain,
                fit,
                gain,
                metrics,
                if_drawn,
                (),
            )
        if causes:
            unexplained = (harm_of(before, fit, gain, effects),)
    # That the fitted rows have it does not depend on what a fit beside it predicts elsewhere.
    unexplained = located(structure) + unexplained
    data = Residuals.of(before)
    solution = _bare(data)
    fit, (gain, metrics), if_drawn = sampled(before, data, [(solution, 1.0)], ())
    return _Checked(
        before, data, solution, (), (), (), 0.0, fit, gain, metrics, if_drawn, unexplained
    )


def _answer(model: _Checked) -> _Answer:
    """Return the verdict on a sampled model, with its causes and what no cause explains."""
    data, solution, fit = model.data, model.solution, model.fit
    is_cause = [EFFECTS[group[0].name].is_cause for group in model.groups]
    structure = tuple(e for e, cause in zip(model.effects, is_cause, strict=True) if not cause)
    residual_structure, gross = structure_left(data, solution, fit, structure)
    unexplained = model.unexplained + residual_structure
    causes = [
        (effect.sampled(fit, group, data), group)
        for effect, group, has_cause in zip(model.effects, model.groups, is_cause, strict=True)
        if has_cause
    ]
    causes.sort(key=lambda cause: -cause[0].size_m)
    effects: tuple[FoundEffect, ...]
    groups: tuple[tuple[Candidate, ...], ...]
    effects, groups = zip(*causes, strict=True) if causes else ((), ())
    named = [candidate for group in groups for candidate in group]
    moved = moved_markers(model.found, data, solution.noise, named)
    effects += tuple(effect.sampled(fit) for effect in moved)
    if not effects and not unexplained and model.gain_nats > NAMED:
        unexplained += (nameless(data, solution, p_value(model.gain_nats)),)
    if not effects and not unexplained:
        unexplained = tuple(beyond_noise(data, fit))
    return _Answer(_verdict(effects, unexplained), effects, groups, unexplained, gross)


def _verdict(effects: Sequence[FoundEffect], unexplained: Sequence[Unexplained]) -> Verdict:
    """Return the verdict on a search.

    'undetermined' if the largest cause or one of a large share ties with a look-alike; else
    'effects' if there are causes, 'unexplained' if there is structure without, else 'none'.
    """
    # A tie over a small remainder does not put the rest in doubt. The largest leads in any case:
    # where held-out poses gain nothing no share is known.
    leading = [effect for effect in effects if (effect.share or 0.0) > LEADING_SHARE]
    if any(effect.tied for effect in (*effects[:1], *leading)):
        return 'undetermined'
    return 'effects' if effects else 'unexplained' if unexplained else 'none'


def _offsets_alone(
    session: Session,
    before: Estimate,
    model: _Checked,
    measurement_errors: Sequence[Candidate],
    rng: np.random.Generator,
    clock: Callable[[], float] | None,
) -> FitResult:
    """Sampled fit for a controller that takes zero-offsets alone, see `Discovery.alone`.

    ``measurement_errors``: causes outside the arm that are certain; these are taken out. If
    the model has no other candidates, its fit is returned.
    """
    # Kinds that nobody named are in no file with zero-offsets either.
    if {*model.solution.candidates} <= {*measurement_errors}:
        return model.fit
    errors = solve(model.data, measurement_errors) if measurement_errors else None
    return fit_session(
        session,
        rng=rng,
        clock=clock,
        priors=None if model.found is before else model.found.problem.priors,
        precision=PRECISION,
        extension=None if errors is None else extension_of(model.data, errors, model.found),
        found=model.found,
    )


def _to_search(
    session: Session, before: Estimate, rng: np.random.Generator
) -> tuple[Estimate, Residuals, IntArray]:
    """Return the fit to be extended by causes, its residuals, and the rows to search.

    The fit is ``before``, that of the offsets alone; if markers have moved, it is made again
    with wide priors for these. The rows are indices in the session, drawn by ``rng`` if they
    are many; gross errors are among them.
    """
    found, residuals = before, Residuals.of(before)
    bare = solve(residuals, ())
    moved = moved_markers(found, residuals, bare.noise, ()) if bare is not None else ()
    if moved:
        # A marker that is pulled to where it is not leaves errors for other causes to explain.
        problem = Problem.of(session, loosened(session, moved))
        found = estimate(replace(problem, path_noise=before.problem.path_noise))
        residuals = Residuals.of(found)
    pool = draw_rows(found.problem.measurements, found.problem.fitted, rng)
    if len(pool) < len(found.problem.fitted):
        residuals = residuals.only(np.intersect1d(pool, found.kept))
    return found, residuals, pool


def _sampled(
    session: Session,
    before: Estimate,
    found: Estimate,
    data: Residuals,
    models: Sequence[tuple[Solution, float]],
    named: Sequence[Candidate],
    *,
    pool: IntArray,
    rng: np.random.Generator,
    report: Progress,
    clock: Callable[[], float] | None,
) -> tuple[FitResult, tuple[Gain, Mapping[str, Any]], FloatArray]:
    """Sample the first of some models, and measure its gain on held-out rows.

    Returns the sampled fit, `gain_of` it, and the std of the zero-offsets if the arm is
    exactly its drawing, rad or m, (k,). ``before``: fit of the offsets alone; ``found``: the
    fit that ``models`` extend; ``models``: each with its posterior weight; the others than the
    first widen the uncertainty; ``named``: candidates of the causes; ``pool``: indices of the rows
    that could be searched, gross errors among them.
    """
    solution = models[0][0]
    # Of a large session the rows that were not searched are fitted as well.
    fitted = np.union1d(data.rows.source, np.setdiff1d(found.kept, pool))
    unmodelled = Unmodelled.of(found, data, solution, fitted)
    moves = [unmodelled.by_models(models[1:])]
    if solution.candidates:
        moves.append(unmodelled.by_open_offsets())
    if_drawn = unmodelled.std_of_offsets(moves)
    moves.append(unmodelled.by_drawing(named))
    fit = fit_session(
        session,
        rng=rng,
        clock=clock,
        # Priors that let moved markers go.
        priors=None if found is before else found.problem.priors,
        precision=PRECISION,
        extension=extension_of(data, solution, found) if solution.candidates else None,
        unmodelled=np.concatenate(moves, axis=1),
        found=found,
        progress=lambda _, share: report('sampling the extended model', share),
    )
    return fit, gain_of(before, data, solution, fit, rng), if_drawn


def _judged(
    found: Estimate, residuals: Residuals, solution: Solution, pool: IntArray
) -> Residuals:
    """Residuals of the pool's rows that are not gross errors in a model.

    A row counts as gross only if it also is with each step dated a little earlier and later.
    ``pool``: indices of the rows. `residuals` itself if its rows are these already, or if too
    many rows would be gross.
    """
    every = residuals.only(pool)
    gross = None
    for errors in _left_by_moment(every, solution):
        try:
            off = find_outliers(
                every.rows,
                partial(_residuals_as_given, errors),
                errors,
                found.problem.sensor_names,
            ).gross
        except InsufficientDataError:
            if gross is None:
                # What is left has long tails: no reason to set a tenth of the rows aside.
                return residuals
            # Of a moment that cannot be.
            continue
        gross = off if gross is None else gross & off
    assert gross is not None
    kept = np.sort(every.rows.source[~gross])
    if np.array_equal(kept, np.sort(residuals.rows.source)):
        return residuals
    return residuals.only(kept)


def _residuals_as_given(residuals: FloatArray, kept: BoolArray) -> FloatArray:
    """Return ``residuals``, m, (n, 3), unchanged: the function for `find_outliers` without refits.

    ``kept``: mask of the rows not set aside, (n,); ignored.
    """
    return residuals


def _left_by_moment(data: Residuals, solution: Solution) -> list[FloatArray]:
    """Return residuals of a model, m, (n, 3) each: as fitted, and with its steps dated otherwise.

    First those as fitted. Then two more for each candidate that happened at a moment, with it
    dated a little earlier and later: rows near a step look gross if its date is a little wrong.
    """
    residuals = [data.left(solution)]
    reach = DATED_TO * float(np.ptp(data.context.elapsed_s))
    for candidate, where in zip(solution.candidates, solution.slices(), strict=True):
        variants = [
            other
            for other in at_other_moments(
                candidate, data.context, candidate.moment - reach, candidate.moment + reach
            )
            if other.variant == candidate.variant
        ]
        for other in (variants[0], variants[-1]) if variants else ():
            moved = data.columns([candidate]) - data.columns([other])
            residuals.append(residuals[0] + moved @ solution.parameters[where])
    return residuals
