"""What the simulation gets wrong: its cause by name, the model extended by it, the gain measured.

`discover_session` takes the residuals of the offsets model, screens every cell (place, driver,
form), and adds those that pass the tests of `stepwise_selection`. Optimization rows decide;
validation rows only measure the gain.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.outliers import find_outliers
from remaster_ros.calibration.result import FitResult
from remaster_ros.calibration.sampling import Progress, silent
from remaster_ros.discovery.beside_memory import withstanding_memory
from remaster_ros.discovery.combined_searches import holds
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect, describe
from remaster_ros.discovery.findings import Findings
from remaster_ros.discovery.gain import (
    Gain,
    gain_of,
    noise_by_range,
    pose_common_fraction,
    residuals_of,
)
from remaster_ros.discovery.guard import Unexplained, harm_of, held, is_harmful, unfitted
from remaster_ros.discovery.marker_offsets import held_markers, loosened, moved_markers
from remaster_ros.discovery.model_averaging import moved_by_look_alikes
from remaster_ros.discovery.omnibus import structure_left
from remaster_ros.discovery.plain_forms import plainest
from remaster_ros.discovery.repeated_search import RepeatedSearch, repeat_search
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.selection import Selection
from remaster_ros.discovery.set_aside import (
    moved_by_memory,
    set_aside,
)
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.discovery.stretches import Stretches, compare_stretches
from remaster_ros.discovery.thinning import Thinning, draw_rows, judge_by_others
from remaster_ros.discovery.to_extension import (
    extension_of,
    moved_by_open_offsets,
    offsets_of,
)
from remaster_ros.discovery.undetected import Undetected, undetected
from remaster_ros.errors import InsufficientDataError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import FloatArray, IntArray, Priors, Session

Verdict = Literal['effects', 'none', 'undetermined', 'unexplained']
# Of the means, in standard deviations: 400 effective draws, enough for values of two figures.
PRECISION = 0.05
# A cause with this share of the gain is one of the leaders.
LEADING_SHARE = 0.1


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
        The cells of each effect that was searched for, in the order of ``effects``; those of
        structure without a cause are in ``selection`` alone.
    selection
        How the cells were found.
    residuals
        What the search worked on.
    offsets_before
        Zero-offsets without the effects, and their stds (NaN where the gauge holds them), rad.
    fit
        The sampled fit, with the effects where there are any.
    thinning
        Which part of a large session was searched, and how the causes hold on the rest; None where
        all of it was searched.
    stretches
        How stretches of the session agree with each other.
    missed
        Causes that the search may have missed.
    residuals_before
        Measured minus modelled position of every row with the zero-offsets alone, in the frame of
        its sensor, m, (n, 3).
    unexplained
        Structure that no cause explains.
    repeated
        What the search finds without some of the poses; None where it was not repeated.
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
    selection: Selection
    residuals: Residuals
    fit: FitResult
    stretches: Stretches
    missed: Undetected
    residuals_before: FloatArray
    thinning: Thinning | None = None
    unexplained: tuple[Unexplained, ...] = ()
    repeated: RepeatedSearch | None = None

    @property
    def widening(self) -> float | None:
        """Factor on the size of the predicted 95 % regions; None where nothing shows it."""
        if self.repeated is None:
            return self.stretches.widening
        return max(self.repeated.widening, self.stretches.widening or 1.0)


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
    findings = find_causes(session, rng=rng, progress=report)
    unexplained: tuple[Unexplained, ...] = ()
    try:
        findings, sampled = _combined_or_not(session, findings, rng, report, clock)
        fit, gain, stretches, missed = sampled
    except InsufficientDataError as error:
        if not findings.selection.solution.cells:
            raise
        findings = findings.not_combined()
        suggested = findings.effects + findings.structure
        try:
            markers = held_markers(findings.found)
            fit, gain, stretches, missed = _sampled(session, findings, rng, report, clock, markers)
            unexplained = (held(gain.noise_floor_m, markers, error),)
        except InsufficientDataError:
            unexplained = (unfitted(findings.residuals.errors, suggested, error),)
            findings = findings.without_causes()
            fit, gain, stretches, missed = _sampled(session, findings, rng, report, clock)
    if (findings.effects or findings.structure) and is_harmful(gain):
        unexplained = (harm_of(findings.before, fit, gain, findings.effects + findings.structure),)
        findings = findings.without_causes()
        fit, gain, stretches, missed = _sampled(session, findings, rng, report, clock)
    residuals, solution = findings.residuals, findings.selection.solution
    structure, gross = structure_left(
        residuals, solution, fit, findings.structure, findings.searched
    )
    unexplained += structure
    effects = tuple(
        effect.sampled(fit, group, residuals.part)
        for effect, group in itertools.zip_longest(findings.effects, findings.groups, fillvalue=())
        if isinstance(effect, FoundEffect)
    )
    verdict: Verdict = 'effects' if effects else 'unexplained' if unexplained else 'none'
    # A tie over a small remainder does not put the rest in doubt. The largest leads in any case:
    # where held-out poses gain nothing no share is known.
    leading = [effect for effect in effects if (effect.share or 0.0) > LEADING_SHARE]
    if any(effect.tied for effect in (*effects[:1], *leading)):
        verdict = 'undetermined'
    return Discovery(
        verdict=verdict,
        effects=effects,
        gain=gain,
        pose_common_fraction=pose_common_fraction(residuals, solution),
        noise_by_range=noise_by_range(residuals, solution),
        outliers=fit.left_out + gross,
        untestable=findings.untestable,
        offsets_before=offsets_of(findings.before),
        groups=findings.groups,
        selection=findings.selection,
        residuals=residuals,
        fit=fit,
        stretches=stretches,
        missed=missed,
        residuals_before=residuals_of(findings.before),
        thinning=findings.thinning,
        unexplained=unexplained,
        repeated=findings.repeated,
    )


def _combined_or_not(
    session: Session,
    findings: Findings,
    rng: np.random.Generator,
    report: Progress,
    clock: Callable[[], float] | None,
) -> tuple[Findings, tuple[FitResult, Gain, Stretches, Undetected]]:
    """Sample the model of several searches, or that of one where their mean does not hold."""
    if findings.selection.before_combining is not None:
        try:
            sampled = _sampled(session, findings, rng, report, clock)
        except InsufficientDataError:
            pass
        else:
            fit, gain = sampled[:2]
            as_meant = holds(findings.residuals, findings.selection.solution, fit.residuals_after)
            if as_meant and fit.sampler.converged and not is_harmful(gain):
                return findings, sampled
    findings = findings.not_combined()
    return findings, _sampled(session, findings, rng, report, clock)


def _sampled(
    session: Session,
    findings: Findings,
    rng: np.random.Generator,
    report: Progress,
    clock: Callable[[], float] | None,
    priors: Priors | None = None,
) -> tuple[FitResult, Gain, Stretches, Undetected]:
    """Sample the model with the causes found, and measure its gain on held-out rows.

    Priors are those that let moved markers go, where none are given.
    """
    residuals, solution, found = findings.residuals, findings.selection.solution, findings.found
    chosen = findings.selection.chosen
    stretches = compare_stretches(found, residuals, chosen)
    missed = undetected(found, residuals, solution)
    alike = moved_by_look_alikes(
        found, residuals, findings.selection, findings.effects, findings.groups
    )
    # The cells of the search come first in what combines it with others.
    more = len(solution.parameters) - len(chosen.parameters)
    unmodelled = [missed.moves, np.pad(stretches.moves, ((0, more), (0, 0))), alike]
    if solution.cells:
        unmodelled.append(moved_by_open_offsets(found, residuals, solution))
    if (aside := findings.aside) is not None:
        unmodelled.append(moved_by_memory(found, residuals, solution, aside.memory))
    if findings.repeated is not None:
        unmodelled.append(findings.repeated.moves)
    fit = fit_session(
        session,
        rng=rng,
        clock=clock,
        priors=loosened(session, findings.effects) if priors is None else priors,
        precision=PRECISION,
        extension=extension_of(residuals, solution, found) if solution.cells else None,
        unmodelled=np.concatenate(unmodelled, axis=1),
        progress=lambda _, share: report('sampling the extended model', share),
    )
    return fit, gain_of(findings.before, residuals, solution, fit, rng), stretches, missed


def find_causes(session: Session, *, rng: np.random.Generator, progress: Progress) -> Findings:
    """Search a session for causes; see `discover_session`."""
    progress('offsets', 0.0)
    before = found = sound_estimate(session)
    residuals = Residuals.of(found)
    bare = solve(residuals, ())
    moved = moved_markers(found, residuals, bare) if bare is not None else ()
    if moved:
        # A marker that is pulled to where it is not leaves errors for other causes to explain.
        found = estimate(Problem.of(session, loosened(session, moved)))
        residuals = Residuals.of(found)
    pool = draw_rows(found.problem.measurements, found.problem.fitted, rng)
    thinned = len(pool) < len(found.problem.fitted)
    if thinned:
        residuals = residuals.only(np.intersect1d(pool, found.kept))
    untestable = {
        name: why for name, effect in EFFECTS.items() if (why := effect.needs(residuals.context))
    }
    cells = [
        cell
        for name, effect in EFFECTS.items()
        if name not in untestable and not effect.moves_the_fit
        for cell in effect.cells(residuals.context)
    ]
    search = Search(
        residuals,
        tuple(cells),
        rng,
        lambda data, solution: _judged(found, data, solution, pool),
        lambda share: progress('searching causes', share),
    )
    selection = search.run()
    solution = withstanding_memory(search, selection.solution)
    solution = plainest(solution, search.data, search.catalogue, search.fit)
    selection = replace(selection, solution=solution)
    residuals = search.data
    groups, described = describe(
        residuals,
        selection,
        search.catalogue,
        search.fit,
        lambda share: progress('comparing look-alikes', share),
    )
    causes = [EFFECTS[group[0].name].is_cause for group in groups]
    effects = tuple(itertools.compress(described, causes))
    structure = tuple(effect for effect, cause in zip(described, causes, strict=True) if not cause)
    aside = set_aside(residuals, selection.solution, search.fit)
    if aside is not None:
        selection = replace(selection, solution=aside.solution)
        structure = aside.said(structure)
    repeated = repeat_search(
        found,
        search,
        selection.solution,
        lambda share: progress('searching again without some of the poses', share),
        combine=aside is None,
    )
    if repeated is not None and repeated.solution is not selection.solution:
        selection = replace(
            selection, solution=repeated.solution, before_combining=selection.solution
        )
    memory = None if aside is None else aside.memory
    effects += moved_markers(found, residuals, selection.chosen, memory)
    thinning = None
    if thinned:
        thinning = judge_by_others(
            residuals, found.kept, residuals.rows.source, selection.empty, selection.solution
        )
    groups = tuple(itertools.compress(groups, causes))
    return Findings(
        before,
        found,
        residuals,
        selection,
        groups,
        effects,
        structure,
        untestable,
        thinning,
        aside,
        repeated,
    )


def _judged(
    found: Estimate, residuals: Residuals, solution: Solution, pool: IntArray
) -> Residuals:
    """Return the residuals of the rows of the pool that the extended model does not call gross."""
    problem = found.problem
    every = residuals.only(pool)
    left = every.left(solution)
    try:
        gross = find_outliers(every.rows, lambda keep: left, left, problem.sensor_names).gross
    except InsufficientDataError:
        # What is left has long tails: no reason to set a tenth of the rows aside.
        return residuals
    kept = np.sort(every.rows.source[~gross])
    if np.array_equal(kept, np.sort(residuals.rows.source)):
        return residuals
    return residuals.only(kept)
