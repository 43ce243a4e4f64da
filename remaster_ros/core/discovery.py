"""What the simulation gets wrong: its cause by name, the model extended by it, the gain measured.

`discover_session` looks at what the offsets model leaves, screens every cell of place, driver and
form, and adds what passes (`discovery_select`). Optimization rows decide; validation rows only
measure the gain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.core.discovery_causes import FoundEffect, describe
from remaster_ros.core.discovery_evidence import Solution
from remaster_ros.core.discovery_extend import extension_of
from remaster_ros.core.discovery_markers import moved_markers
from remaster_ros.core.discovery_noise import Residuals
from remaster_ros.core.discovery_screen import Catalogue
from remaster_ros.core.discovery_select import Search, Selection
from remaster_ros.core.effects.cell import Cell
from remaster_ros.core.effects.registry import EFFECTS
from remaster_ros.core.estimate import Estimate, Problem, estimate
from remaster_ros.core.fit import fit_session
from remaster_ros.core.outliers import find_outliers
from remaster_ros.core.result import FitResult
from remaster_ros.core.sampling import Progress, silent
from remaster_ros.core.types import BoolArray, FloatArray, Session

Verdict = Literal['effects', 'none', 'undetermined']


@dataclass(frozen=True)
class Gain:
    """RMS of the 3-D error over all validation rows, m; None where there are none.

    Attributes
    ----------
    held_out_rms_before_m, held_out_rms_after_m
        With offsets only, and with the effects.
    noise_floor_m
        What the noise alone leaves, by the sensors' estimated noise.
    """

    held_out_rms_before_m: float | None
    held_out_rms_after_m: float | None
    noise_floor_m: float


@dataclass(frozen=True, eq=False)
class Discovery:
    """What was found in a session.

    Attributes
    ----------
    verdict
        'effects', 'none', or 'undetermined' where the leading explanations tie.
    effects
        The causes, the largest first.
    gain
        On the validation rows.
    pose_common_fraction
        Share of the remaining noise that all rows of a pose have in common.
    noise_by_range
        By sensor: ratio of the errors far to near, and the p-value that they are equal.
    outliers
        ``observation`` of every row set aside, with the reason.
    untestable
        Name of an effect -> why this session cannot show it.
    selection
        How the cells were found.
    residuals
        What the search worked on.
    offsets_before
        Zero-offsets without the effects, and their stds (NaN where the gauge holds them), rad.
    fit
        The sampled fit, with the effects where there are any.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    gain: Gain
    pose_common_fraction: float
    noise_by_range: Mapping[str, Mapping[str, float]]
    outliers: tuple[tuple[int, str], ...]
    untestable: Mapping[str, str]
    offsets_before: tuple[FloatArray, FloatArray]
    selection: Selection
    residuals: Residuals
    fit: FitResult


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
    residuals, solution = findings.residuals, findings.selection.solution
    fit = fit_session(
        session,
        rng=rng,
        clock=clock,
        extension=extension_of(residuals, solution) if solution.cells else None,
        progress=lambda _, share: report('sampling the extended model', share),
    )
    effects = tuple(effect.sampled(fit) for effect in findings.effects)
    verdict: Verdict = 'effects' if effects else 'none'
    if any(effect.tied for effect in effects):
        verdict = 'undetermined'
    return Discovery(
        verdict=verdict,
        effects=effects,
        gain=_gain(residuals, solution, fit),
        pose_common_fraction=_pose_common_fraction(solution),
        noise_by_range=_noise_by_range(residuals, solution),
        outliers=fit.left_out,
        untestable=findings.untestable,
        offsets_before=_offsets(findings.estimate),
        selection=findings.selection,
        residuals=residuals,
        fit=fit,
    )


@dataclass(frozen=True, eq=False)
class Findings:
    """What is found before anything is sampled; fields as in `Discovery`."""

    estimate: Estimate
    residuals: Residuals
    selection: Selection
    effects: tuple[FoundEffect, ...]
    untestable: Mapping[str, str]


def find_causes(session: Session, *, rng: np.random.Generator, progress: Progress) -> Findings:
    """Search a session for causes; see `discover_session`."""
    progress('offsets', 0.0)
    problem = Problem.of(session)
    found = estimate(problem)
    residuals = Residuals.of(found)
    untestable = {
        name: why for name, effect in EFFECTS.items() if (why := effect.needs(residuals.scene))
    }
    cells = [
        cell
        for name, effect in EFFECTS.items()
        if name not in untestable and name != 'marker_offset'
        for cell in effect.cells(residuals.scene)
    ]
    residuals, selection = _searched(found, residuals, cells, rng, progress)
    effects = describe(
        residuals, selection, cells, lambda share: progress('comparing look-alikes', share)
    )
    effects += moved_markers(found, residuals, selection.solution)
    return Findings(found, residuals, selection, effects, untestable)


def _offsets(found: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the zero-offsets of the fit without effects and their stds, rad, (k,) each."""
    joints = found.model.joints
    std = np.full(joints, np.nan)
    free = found.posterior.free
    angles = free < joints
    std[free[angles]] = np.sqrt(np.diag(found.mode.covariance)[: len(free)][angles])
    return found.model.offsets(found.mode.z), std


def _searched(
    found: Estimate,
    residuals: Residuals,
    cells: list[Cell],
    rng: np.random.Generator,
    report: Progress,
) -> tuple[Residuals, Selection]:
    """Search; where the extended model judges other rows gross, search again without those."""
    for attempt in range(3):
        search = Search(
            residuals,
            Catalogue.of(residuals, cells),
            rng,
            lambda share: report('searching causes', share),
        )
        selection = search.run()
        if not selection.solution.cells or attempt == 2:
            return residuals, selection
        kept = _kept(found, residuals, selection.solution)
        if np.array_equal(kept, np.sort(residuals.rows.source)):
            return residuals, selection
        residuals = residuals.only(kept, found.model.reference)
    raise AssertionError('unreachable')


def _kept(found: Estimate, residuals: Residuals, solution: Solution) -> FloatArray:
    """Return the optimization rows that the extended model does not call gross."""
    problem = found.problem
    every = residuals.only(problem.fitted, found.model.reference)
    left = every.errors - every.base @ solution.base
    left -= residuals.columns(solution.cells)[every.rows.source] @ solution.parameters

    def refit(keep: BoolArray) -> FloatArray:
        return left

    judgement = find_outliers(every.rows, refit, left, problem.sensor_names)
    return np.sort(every.rows.source[~judgement.gross])


def _gain(residuals: Residuals, solution: Solution, fit: FitResult) -> Gain:
    measurements = residuals.scene.measurements
    held_out = measurements.is_validation
    noise = solution.noise
    variance = 3.0 * (noise.sigma**2 + noise.pose_sigma**2)
    rows = held_out if held_out.any() else ~held_out
    floor = float(np.sqrt(np.mean(variance[measurements.sensor[rows]])))
    if not held_out.any():
        return Gain(None, None, floor)

    def rms(errors: FloatArray) -> float:
        return float(np.sqrt(np.mean(np.sum(errors[held_out] ** 2, axis=1))))

    return Gain(rms(residuals.full_errors), rms(fit.residuals_after), floor)


def _pose_common_fraction(solution: Solution) -> float:
    common = np.sum(solution.noise.pose_sigma**2)
    return float(common / (common + np.sum(solution.noise.sigma**2)))


def _noise_by_range(residuals: Residuals, solution: Solution) -> dict[str, dict[str, float]]:
    """Compare the sizes of errors near and far, sensor by sensor.

    The logarithm of the error's length against that of the range: slope, and the normal p-value
    of its rank correlation.
    """
    from scipy.stats import spearmanr

    rows = residuals.rows
    left = residuals.errors - residuals.base @ solution.base
    left = left - residuals.columns(solution.cells)[rows.source] @ solution.parameters
    length = np.linalg.norm(left, axis=1)
    found = {}
    for sensor, span in rows.spans:
        distance = residuals.scene.range_m[rows.source[span]]
        low, high = np.quantile(distance, (0.25, 0.75))
        near, far = length[span][distance <= low], length[span][distance >= high]
        _, p_value = spearmanr(distance, length[span])
        found[residuals.scene.sensor_names[sensor]] = {
            'near_m': float(low),
            'far_m': float(high),
            'far_over_near': float(np.sqrt(np.mean(far**2) / np.mean(near**2))),
            'p_value': float(p_value) if np.isfinite(p_value) else 1.0,
        }
    return found
