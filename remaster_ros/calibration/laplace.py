# SPDX-License-Identifier: Apache-2.0
"""Mode of a posterior, and its covariance there.

Gauss–Newton steps to the peak of the linearised posterior (`linearisation`), with the noise at the
peak of its marginal density.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from remaster_ros.calibration.gauge_words import hardly_seen
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.linearisation import Linearisation, linearise
from remaster_ros.calibration.noise import RESOLUTION_M
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import BoolArray, FloatArray

# Length of a step, in standard deviations, at which the search ends; and the length that is near
# enough, for proposals that the sampler corrects, if steps along a badly known direction shorten
# slowly.
SETTLED, NEAR_ENOUGH = 1e-2, 0.1
FIRST_STEPS, MOST_STEPS = 12, 60
# Longest step within which the tangent holds; a longer one may be halved this number of times.
TRUSTED = 0.1
HALVINGS = 10
# Share of a step for the finite differences of the predictions' bend along it.
BENT = 0.05
# Least start of a shared part's coordinate: the noise density is even in it, so that its slope at
# zero is zero and a search would stay there.
OFF_ZERO = 0.1
# Step of finite differences in the noise's coordinates.
DIFFERENCE = 0.02


@dataclass(frozen=True, eq=False)
class Mode:
    """Peak of a posterior: parameters and noise, with the linearised posterior about it."""

    z: FloatArray  # Pinned parameters, (size,)
    eta: FloatArray  # Coordinates of the noise, (e,)
    linearisation: Linearisation  # Linearisation about z

    @cached_property
    def eta_covariance(self) -> FloatArray:
        """Covariance of the noise's coordinates, (e, e)."""
        return _noise_covariance(self.linearisation, self.eta)

    @cached_property
    def of_points(self) -> Mode:
        """The same mode with only the positions as data, for analyses of position errors.

        The information of the orientations on the parameters is in the Gram matrix of the priors,
        at the noise of the mode.
        """
        posterior = self.linearisation.posterior
        if not posterior.rows.turning:
            return self
        noise_model = posterior.noise_model.of_points
        groups, channels = len(noise_model.error_groups), len(posterior.noise_model.channels)
        shares = [
            part < len(noise_model.channels)
            for parts in (posterior.noise_model.separable, posterior.noise_model.framed)
            for part in parts
        ]
        kept = np.arange(len(self.eta)) < len(noise_model.channels)
        kept[channels:] = shares
        weights = 1.0 / posterior.variances(self.eta)[groups:]
        linearisation = replace(
            self.linearisation,
            posterior=replace(posterior, noise_model=noise_model),
            grams=self.linearisation.grams[:groups],
            prior=self.linearisation.prior
            + np.tensordot(weights, self.linearisation.grams[groups:], axes=1),
        )
        return Mode(self.z, self.eta[kept], linearisation)

    @property
    def log_evidence(self) -> float:
        """Log likelihood of the noise at the mode, with the parameters integrated out.

        Without the prior of the noise, and up to a constant: only differences between noise models
        on the same rows have a meaning.
        """
        marginal = self.linearisation.whitened(self.eta)[2]
        return float(marginal - self.linearisation.posterior.log_noise_prior(self.eta))

    @property
    def weakest(self) -> str:
        """Names of the parameters that are determined worst together, as text.

        Without those of the extension: of an error curve of a joint, an effect, a coefficient
        is always determined by its smoothness prior alone.
        """
        posterior = self.linearisation.posterior
        core = posterior.free < posterior.model.core
        scale = np.sqrt(np.diag(self.linearisation.gram(self.eta))[: len(core)])
        scaled = self.covariance * np.outer(scale, scale)
        direction = np.linalg.eigh(scaled[core][:, core])[1][:, -1]
        names = np.array(posterior.free_names)[core]
        return hardly_seen(names.tolist(), direction)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the free pinned parameters at the mode's noise, (f, f).

        The noise's own uncertainty is not in it.
        """
        root = np.linalg.inv(self.linearisation.whitened(self.eta)[0])
        return root.T @ root


def find_mode(posterior: Posterior, begun: Mode | None = None) -> Mode:
    """Find the mode by Gauss–Newton steps, the noise at the peak of its marginal density.

    ``posterior``: with ``reference`` near the mode (see `initial_guess.robust_start`); ``begun``:
    `noise_mode` there, None to guess the noise from the errors at the reference. Raises
    InsufficientDataError, naming the parameters, if the steps do not settle: the rows do not
    determine the free parameters.
    """
    z = posterior.reference
    eta = _noise_guess(posterior) if begun is None else begun.eta
    size, step = np.inf, np.zeros(len(posterior.free))
    previous, damping = step, 1.0
    linearisation = linearise(posterior, z) if begun is None else begun.linearisation
    try:
        for count in range(MOST_STEPS):
            # Far from the mode the noise need not be exact.
            eta = _noise_peak(linearisation, eta, 1e-4 if size < TRUSTED else 1e-2)
            mean, factor, _ = linearisation.conditional(eta)
            step = mean - z[posterior.free]
            # The step in units of the posterior's own spread.
            whitened = factor.T @ step
            size = float(np.linalg.norm(whitened))
            back = -float(whitened @ previous)
            if back > 0.5 * size * np.linalg.norm(previous):
                # The step before went too far by this share of it, and the next one would as well.
                damping /= 1.0 + back / float(previous @ previous)
            previous = whitened
            if size > TRUSTED:
                mean = _uphill(linearisation, z[posterior.free], damping * step, eta)
            else:
                mean = z[posterior.free] + damping * step
            z = posterior.parameters(mean)
            linearisation = linearise(posterior, z)
            if size < (SETTLED if count < FIRST_STEPS else NEAR_ENOUGH):
                break
        if size < NEAR_ENOUGH:
            return Mode(z, eta, linearisation)
    except np.linalg.LinAlgError:
        # A parameter without any information: the same remedy as steps that never end.
        pass
    weakest = hardly_seen(posterior.free_names, _open_direction(linearisation, eta, step))
    raise InsufficientDataError(
        f'the fit does not settle: the observations hardly determine {weakest}; measure more '
        'poses, spread further, or give a prior on one of them'
    )


def noise_mode(posterior: Posterior) -> Mode:
    """Mode of the noise alone, the parameters being kept at the posterior's reference.

    For a reference that is the mode of the parameters under another noise model. The parameters
    are integrated out by their tangent there: the log evidence is that of `find_mode` to first
    order, with one linearisation in place of several. Raises InsufficientDataError if the
    observations do not determine the noise.
    """
    linearisation = linearise(posterior, posterior.reference)
    try:
        eta = _noise_peak(linearisation, _noise_guess(posterior), 1e-2)
    except np.linalg.LinAlgError:
        raise InsufficientDataError('the observations determine no such noise') from None
    return Mode(posterior.reference, eta, linearisation)


def _uphill(
    linearisation: Linearisation, free: FloatArray, step: FloatArray, eta: FloatArray
) -> FloatArray:
    """Free parameters after a step, or after the best of shorter ones, at a higher density.

    The shortest step if none raises the density. Given the noise each Gauss–Newton step points
    uphill. A shorter one may follow the bend of the predictions (Transtrum & Sethna 2012,
    arXiv:1201.5885). ``free``, ``step``: (f,); ``eta``: noise coordinates, (e,).
    """
    posterior = linearisation.posterior

    def heights(tries: FloatArray) -> FloatArray:
        at_noise = np.broadcast_to(eta, (len(tries), len(eta)))
        return posterior.log_density(np.concatenate((tries, at_noise), axis=1))

    height, first = heights(np.stack((free, free + step)))
    # Most often the first will do.
    if first > height:
        return free + step
    share = 0.5 ** np.arange(HALVINGS)[:, None]
    straight = free + share * step
    tries = np.concatenate((straight + share**2 * _bend(linearisation, step, eta), straight))
    raised = heights(tries)
    if not np.any(raised > height):
        return tries[-1]
    return tries[np.argmax(raised)]


def _bend(linearisation: Linearisation, step: FloatArray, eta: FloatArray) -> FloatArray:
    """Second-order change of the free parameters, (f,), to be added to a step (f,).

    It reduces the errors if the predictions bend along the step.
    """
    posterior, z = linearisation.posterior, linearisation.z
    model, free, f = posterior.model, posterior.free, len(step)
    neighbours = posterior.parameters(z[free] + BENT * np.stack((-step, 0.0 * step, step)))

    def joined(rows: Rows, _: slice) -> FloatArray:
        before, here, after = (model.predict(point, rows) for point in neighbours)
        second = (before - 2.0 * here + after) / BENT**2
        return np.concatenate((model.jacobian(z, rows)[:, :, free], second[:, :, None]), axis=2)

    grams = posterior.noise_model.gram(joined, f + 1)
    pull = (1.0 / posterior.variances(eta)) @ grams[:, f, :f]
    return np.asarray(-0.5 * np.linalg.solve(linearisation.gram(eta)[:f, :f], pull))


def _open_direction(linearisation: Linearisation, eta: FloatArray, step: FloatArray) -> FloatArray:
    """Eigenvector (f,) of the information matrix along which a step (f,) goes furthest.

    Each parameter is in units of its effect by itself on the observations. If parameters have
    no information at all: 1 for these, 0 for the others.
    """
    f = len(step)
    gram = linearisation.gram(eta)[:f, :f]
    scale = np.sqrt(np.diag(gram))
    if np.any(scale == 0.0):
        return (scale == 0.0).astype(float)
    vectors = np.linalg.eigh(gram / np.outer(scale, scale))[1]
    loadings: FloatArray = vectors[:, np.argmax(np.abs(vectors.T @ (scale * step)))]
    return loadings


def _noise_guess(posterior: Posterior) -> FloatArray:
    """Coordinates of the noise, (e,), from the errors at the posterior's reference.

    In the order of noise coordinates: logarithms of sigma, then the ratios of the common parts.
    """
    errors = posterior.rows.target - posterior.model.predict(posterior.reference, posterior.rows)
    noise = posterior.noise_model
    sums = noise.sums_of_squares(errors)
    sigmas, ratios, ratios_of_frames = [], [], []
    kind = np.array([group.kind for group in noise.error_groups])

    def ratio(larger: BoolArray, size: FloatArray, variance: float, sigma: float) -> float:
        share = np.average(size[larger], weights=noise.freedom[larger])
        more = sums[larger].sum() / noise.freedom[larger].sum() - variance
        return float(np.arcsinh(np.sqrt(max(more, 0.0) / share) / sigma))

    for index in range(len(noise.channels)):
        selection = noise.channel_of == index
        rows, frames, poses = (selection & (kind == name) for name in ('rows', 'frames', 'poses'))
        smallest = next(part for part in (rows, frames, poses) if part.any())
        below = frames if frames.any() else poses
        variance = sums[smallest].sum() / noise.freedom[smallest].sum()
        sigma = np.sqrt(variance + RESOLUTION_M**2)
        sigmas.append(np.log(sigma))
        if index in noise.framed:
            ratios_of_frames.append(ratio(below, noise.frame_size_of, variance, sigma))
            variance = sums[below].sum() / noise.freedom[below].sum()
        if index in noise.separable:
            ratios.append(ratio(poses, noise.size_of, variance, sigma))
    return np.array(sigmas + ratios + ratios_of_frames)


def _noise_peak(linearisation: Linearisation, start: FloatArray, shortest: float) -> FloatArray:
    """Noise coordinates (e,) at the peak of their log posterior density, by Newton steps.

    The parameters are integrated out by the linearisation. From ``start``, (e,); no step is
    longer than 1. The search ends with a step shorter than ``shortest``, with one that does not
    raise the density, even shortened, or after 100. Ratios of common parts are 0 or more.
    Raises numpy.linalg.LinAlgError if a parameter has no information.
    """
    count = len(linearisation.posterior.noise_model.channels)
    peak = np.concatenate((start[:count], np.maximum(start[count:], OFF_ZERO)))
    for _ in range(100):
        height, gradient, precision = _noise_slope(linearisation, peak)
        values, vectors = np.linalg.eigh(precision)
        # Uphill also where the density is not yet concave.
        step = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 0.1))
        step /= max(1.0, float(np.linalg.norm(step)))
        if np.linalg.norm(step) < shortest:
            break
        # With hundreds of parameters each try costs milliseconds; most often the first will do.
        for tries in (peak[None] + step, peak + step * 0.5 ** np.arange(1.0, 8.0)[:, None]):
            heights = linearisation.whitened(tries)[2]
            if np.max(heights) > height:
                break
        else:
            break
        peak = tries[np.argmax(heights)]
    return np.concatenate((peak[:count], np.abs(peak[count:])))


def _noise_covariance(linearisation: Linearisation, peak: FloatArray) -> FloatArray:
    """Covariance of the noise's coordinates, (e, e), by the curvature at their peak, (e,).

    If the coordinate of a common part (of pose or frame) is within two standard deviations of
    zero, its variance is its mean squared deviation from the peak, integrated numerically, and
    its covariances are 0.
    """
    precision = _noise_curvature(linearisation, peak)
    count = len(linearisation.posterior.noise_model.channels)
    std = 1.0 / np.sqrt(np.maximum(np.diag(precision), 0.45))
    spread = {}
    for index in range(count, len(peak)):
        if peak[index] < 2.0 * std[index]:
            # From a thousandth of a sigma to as much as matters, evenly in the logarithm: of what
            # is smooth over a factor of two, a sum of steps of a quarter of it is the integral.
            ratio = np.geomspace(1e-3, 5.0, 40)
            points = np.repeat(peak[None], len(ratio), axis=0)
            points[:, index] = ratio
            log_weight = linearisation.whitened(points)[2]
            weight = np.exp(log_weight - log_weight.max()) * ratio
            weight[[0, -1]] *= 0.5
            spread[index] = float(np.average((ratio - peak[index]) ** 2, weights=weight))
    values, vectors = np.linalg.eigh(precision)
    covariance: FloatArray = (vectors / np.maximum(values, 0.45)) @ vectors.T
    for index, square in spread.items():
        # At the boundary there is no tangent to correlate by.
        covariance[index], covariance[:, index] = 0.0, 0.0
        covariance[index, index] = max(square, 1e-6)
    return covariance


def _noise_slope(
    linearisation: Linearisation, at: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Log posterior density of the noise coordinates `at`, (e,), with gradient and curvature.

    Returns the density, its gradient (e,), and its approximate negative second derivative (e, e).
    """
    posterior = linearisation.posterior
    value, slope, information = linearisation.by_variances(at)

    def near(points: FloatArray) -> FloatArray:
        step = np.log(posterior.variances(points) / posterior.variances(at))
        rise = step @ slope - 0.5 * np.sum((step @ information) * step, axis=-1)
        return rise + posterior.log_noise_prior(points)

    _, gradient, precision = _curvature(near, at)
    return value, gradient, precision


def _noise_curvature(linearisation: Linearisation, at: FloatArray) -> FloatArray:
    """Negative second derivative of the noise's log density at ``at``, (e, e), symmetric.

    By differences of its gradient, which needs one factorisation for dozens of the density's.
    """
    around = DIFFERENCE * np.stack((np.eye(len(at)), -np.eye(len(at))))
    plus, minus = (
        np.array([_noise_slope(linearisation, at + step)[1] for step in steps]) for steps in around
    )
    curvature: FloatArray = (minus - plus) / (2.0 * DIFFERENCE)
    return 0.5 * (curvature + curvature.T)


def _curvature(
    density: Callable[[FloatArray], FloatArray], at: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Log density, gradient (e,) and negative second derivative (e, e) at ``at``, by differences.

    ``density``: of points (n, e) to (n,). All points in one batch: the density costs microseconds,
    its analytic derivative a page.
    """
    e, step = len(at), DIFFERENCE
    unit = step * np.eye(e)
    first, second = np.triu_indices(e, 1)
    corners = [at + a * unit[first] + b * unit[second] for a in (1, -1) for b in (1, -1)]
    points = np.concatenate((at[None], at + unit, at - unit, *corners))
    value = density(points)
    plus, minus = value[1 : e + 1], value[e + 1 : 2 * e + 1]
    four = value[2 * e + 1 :].reshape(4, -1)
    curvature = np.diag((plus + minus - 2.0 * value[0]) / step**2)
    mixed = (four[0] - four[1] - four[2] + four[3]) / (4.0 * step**2)
    curvature[first, second] = curvature[second, first] = mixed
    return float(value[0]), (plus - minus) / (2.0 * step), -curvature
