# SPDX-License-Identifier: Apache-2.0
"""Fit of a session: zero-offsets, registrations, markers and noise, with uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import compress
from typing import Literal

import numpy as np

from remaster_ros.calibration.convergence import MINIMUM_DRAWS
from remaster_ros.calibration.dynamics import estimate_moving
from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.extension import Extension
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.paper import BURN_IN_SHARE, STEPS, fit_paper
from remaster_ros.calibration.result import FitResult, Sampled, build_result, sampled_columns
from remaster_ros.calibration.sampling import PRECISION, Progress, sample_posterior, silent
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import FloatArray, Priors, Session

__all__ = ['PRECISION', 'FitResult', 'fit_session']

Sampler = Literal['fast', 'paper']

# Range of the precision: with a coarser one convergence cannot be judged, a finer one requires
# more draws than memory holds.
COARSEST_PRECISION = 0.1
FINEST_PRECISION = 0.002


@one_thread
def fit_session(
    session: Session,
    *,
    rng: np.random.Generator,
    sampler: Sampler = 'fast',
    chains: int = 4,
    draws: int | None = None,
    precision: float = PRECISION,
    progress: Progress | None = None,
    clock: Callable[[], float] | None = None,
    extension: Extension | None = None,
    priors: Priors | None = None,
    unmodelled: FloatArray | None = None,
    found: Estimate | None = None,
) -> FitResult:
    """Fit a session's optimization rows.

    Parameters
    ----------
    session
        As read from its folder.
    rng
        Source of all randomness: the same one gives the same result.
    sampler
        'fast', or 'paper' for eq. 8 and 12 to 16 of Van Wyk et al. as they stand.
    chains
        At least 2, to judge convergence by.
    draws
        Per chain; None for as many as the precision takes. In paper mode the steps in all, 200,000
        by default, of which the last eighth is kept.
    precision
        Wanted Monte Carlo error of every mean in standard deviations of that parameter; of no
        meaning in paper mode.
    progress
        Called with the stage and the share of it that is done.
    clock
        Returns seconds, to time the sampler.
    extension
        Further physical effects to fit; the paper's model has none.
    priors
        What is known beforehand, in place of the session's own priors; the paper's model has none.
    unmodelled
        How c causes outside the model move its natural parameters, one standard deviation of
        each, (size, c): the posterior is widened by them. Not in paper mode.
    found
        The session's estimate by the same priors and without an extension, if it has been made;
        None to make it here. With an extension only its path noise is used.

    Raises
    ------
    InputError
        A session that does not fit its robot, or arguments out of range.
    InsufficientDataError
        Data that do not determine the parameters or do not fit the robot (`MisfitError`); if a
        mistake in the session's tables explains it, a `MistakeFoundError` names the mistake.
    """
    for what, given in (('further effects', extension), ('priors on its parameters', priors)):
        if sampler == 'paper' and given is not None:
            raise InputError(f"the paper's model has no {what}; use the fast sampler")
    if chains < 2:
        raise InputError(f'{chains} chain(s) cannot be judged; use at least 2')
    if not FINEST_PRECISION <= precision <= COARSEST_PRECISION:
        raise InputError(
            f'a precision of {precision:g} is out of range; use {FINEST_PRECISION} to '
            f'{COARSEST_PRECISION}; 0.02 for an error of 2 % of each standard deviation'
        )
    fewest = MINIMUM_DRAWS / ((1.0 - BURN_IN_SHARE) if sampler == 'paper' else 1.0)
    if draws is not None and draws < fewest:
        raise InputError(f'{draws} draws are too few; use at least {fewest:.0f}')
    report = progress if progress is not None else silent
    started = clock() if clock is not None else np.nan
    problem = Problem.of(session, priors)
    slides = list(compress(problem.chain.joint_names, problem.chain.slides))
    if session.is_moving and sampler == 'paper':
        raise InputError(
            "the paper's model has no dynamics, and this session was measured while the arm "
            'moved; fit with the fast sampler'
        )
    if slides and sampler == 'paper':
        raise InputError(
            f"joint '{slides[0]}' slides, which the paper sampler does not take; fit with the "
            'fast sampler'
        )
    if sampler == 'paper':
        sampled = fit_paper(
            problem,
            chains=chains,
            steps=STEPS if draws is None else draws,
            rng=rng,
            progress=lambda share: report('sampling', share),
        )
    else:
        # With further effects the same model has been fitted to the same rows before.
        if extension is not None:
            if found is not None:
                problem = replace(problem, path_noise=found.problem.path_noise)
            found = estimate(problem, extension)
        elif found is None:
            fitted = estimate_moving if session.is_moving else estimate
            found = sound_estimate(session, priors, fitted)
        sampled = _fast(found, chains, draws, precision, rng, report)
        if unmodelled is not None:
            sampled = replace(sampled, unmodelled=unmodelled)
    seconds = clock() - started if clock is not None else None
    result = build_result(problem, sampled, seconds, rng)
    if extension is None:
        # What cannot be compared is said now.
        _ = result.comparison
    return result


def _fast(
    found: Estimate,
    chains: int,
    draws: int | None,
    precision: float,
    rng: np.random.Generator,
    report: Progress,
) -> Sampled:
    """Posterior of an estimate, sampled by independence Metropolis (`sample_posterior`).

    ``draws``: per chain, None for as many as the precision takes. Raises InsufficientDataError if
    the posterior cannot be factored.
    """
    posterior, model = found.posterior, found.model

    def columns(points: FloatArray) -> FloatArray:
        x, eta = model.natural(posterior.parameters(points)), points[..., len(posterior.free) :]
        return sampled_columns(posterior, x, eta, posterior.free)

    try:
        run, name = sample_posterior(
            found.mode,
            chains=chains,
            rng=rng,
            draws=draws,
            precision=precision,
            quantities=columns,
            report=report,
        )
    except np.linalg.LinAlgError:
        raise InsufficientDataError(
            f'the posterior cannot be sampled: the observations hardly determine '
            f'{found.mode.weakest}; measure more poses, spread further'
        ) from None
    return Sampled(
        posterior=posterior,
        z=posterior.parameters(run.draws),
        eta=run.draws[..., len(posterior.free) :],
        z_mean=posterior.parameters(run.draws.mean(axis=(0, 1))),
        moved=posterior.free,
        run=run._replace(draws=columns(run.draws), trace=columns(run.trace)),
        name=name,
        precision=precision if draws is None else None,
        gauge=found.gauge,
        taken_as_known=np.zeros(model.joints),
        z_before=lambda: found.before.z,
        left_out=found.left_out,
        mode=found.mode,
        found=found,
    )
