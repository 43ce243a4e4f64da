"""`fit_session`: zero-offsets, registrations, markers and noise of a session, with uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from remaster_ros.core import convergence
from remaster_ros.core.errors import InputError
from remaster_ros.core.estimate import Estimate, Problem, estimate
from remaster_ros.core.extension import Extension
from remaster_ros.core.paper_mode import BURN_IN_SHARE, STEPS, fit_paper
from remaster_ros.core.result import FitResult, Sampled, build_result
from remaster_ros.core.sampling import Progress, sample_posterior, silent
from remaster_ros.core.types import FloatArray, Session

__all__ = ['FitResult', 'fit_session']

Sampler = Literal['fast', 'paper']

FAST_DRAWS = 1000


def fit_session(
    session: Session,
    *,
    rng: np.random.Generator,
    sampler: Sampler = 'fast',
    chains: int = 4,
    draws: int | None = None,
    progress: Progress | None = None,
    clock: Callable[[], float] | None = None,
    extension: Extension | None = None,
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
        Per chain; 1000 by default. In paper mode the steps in all, 200,000 by default, of which
        the last eighth is kept.
    progress
        Called with the stage and the share of it that is done.
    clock
        Returns seconds, to time the sampler; core has no clock of its own.
    extension
        Further physical effects to fit; the paper's model has none.

    Raises
    ------
    InputError
        A session that does not fit its robot, or arguments out of range.
    InsufficientDataError
        Data that do not allow an answer.
    """
    if extension is not None and sampler == 'paper':
        raise InputError("the paper's model has no further effects; use the fast sampler")
    if chains < 2:
        raise InputError(f'{chains} chain(s) cannot be judged; use at least 2')
    default = STEPS if sampler == 'paper' else FAST_DRAWS
    draws = default if draws is None else draws
    fewest = convergence.MINIMUM_DRAWS / ((1.0 - BURN_IN_SHARE) if sampler == 'paper' else 1.0)
    if draws < fewest:
        raise InputError(f'{draws} draws are too few; use at least {fewest:.0f}')
    report = progress if progress is not None else silent
    started = clock() if clock is not None else np.nan
    problem = Problem.of(session)
    if sampler == 'paper':
        sampled = fit_paper(
            problem,
            chains=chains,
            steps=draws,
            rng=rng,
            progress=lambda share: report('sampling', share),
        )
    else:
        sampled = _fast(estimate(problem, extension), chains, draws, rng, report)
    seconds = clock() - started if clock is not None else np.nan
    return build_result(problem, sampled, seconds, rng)


def _fast(
    found: Estimate, chains: int, draws: int, rng: np.random.Generator, report: Progress
) -> Sampled:
    posterior, model = found.posterior, found.model
    run, name = sample_posterior(found.mode, chains=chains, draws=draws, rng=rng, report=report)
    sensors = model.sensor_names
    names = tuple(model.names[index] for index in posterior.free)
    names += tuple(f'noise.{sensor}.sigma' for sensor in sensors)
    names += tuple(f'noise.{sensors[index]}.pose_sigma' for index in posterior.separable)

    def readable(points: FloatArray) -> FloatArray:
        natural = model.natural(posterior.parameters(points))[..., posterior.free]
        sigma, pose_sigma = posterior.noise(points[..., len(posterior.free) :])
        separate = pose_sigma[..., list(posterior.separable)]
        return np.concatenate((natural, sigma, separate), axis=-1)

    sigma, pose_sigma = posterior.noise(run.draws[..., len(posterior.free) :])
    unfixed = np.isin(np.arange(model.joints), found.gauge.held)
    return Sampled(
        model=model,
        z=posterior.parameters(run.draws),
        z_mean=posterior.parameters(run.draws.reshape(-1, posterior.size).mean(axis=0)),
        sigma=sigma,
        pose_sigma=pose_sigma,
        trace=readable(run.trace),
        draws=readable(run.draws),
        names=names,
        separable=posterior.separable,
        name=name,
        acceptance_rate=run.acceptance_rate,
        gauge=found.gauge,
        unfixed=unfixed,
        z_before=found.before.z,
        left_out=found.left_out,
    )
