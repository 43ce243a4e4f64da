"""The posterior of a model that is linear about a point: its mode, its width, draws from it.

Given the noise, the parameters are then Gaussian, with a mean and a precision that follow from
a handful of Gram matrices whatever the noise: a rotation of well under a degree bends so little
that this is nearly the exact posterior, which makes it the proposal of the exact sampler.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from remaster_ros.core.errors import InsufficientDataError
from remaster_ros.core.metropolis import StudentT, log_student_t
from remaster_ros.core.posterior import RESOLUTION_M, Posterior, prior_rows
from remaster_ros.core.types import FloatArray

# Tails of the proposal: of the noise always, of the parameters in this share of the draws. They
# bound the importance weights where the linear picture is too narrow.
NOISE_FREEDOM = 10.0
TAIL_SHARE = 0.05
TAIL_FREEDOM = 5.0
TAIL_WIDENING = 1.3


def linearise(posterior: Posterior, z: FloatArray) -> Linearisation:
    """Return the posterior with the predictions replaced by their tangent at z (size,)."""
    errors = posterior.rows.target - posterior.model.predict(z, posterior.rows)
    derivative = posterior.model.jacobian(z, posterior.rows)[:, :, posterior.free]
    # One matrix holds derivative and error: its Gram matrix holds all the products needed.
    joined = np.concatenate((derivative, errors[:, :, None]), axis=2)
    sums = posterior.rows.group_sum(joined, axis=0)
    within, between = [], {}
    for sensor, span in posterior.rows.spans:
        flat = joined[span].reshape(-1, joined.shape[2])
        gram = flat.T @ flat
        for size in np.unique(posterior.rows.group_size[posterior.rows.group_sensor == sensor]):
            chosen = (posterior.rows.group_sensor == sensor) & (posterior.rows.group_size == size)
            part = sums[chosen].reshape(-1, joined.shape[2])
            between[sensor, int(size)] = (part.T @ part / size, int(chosen.sum()))
            gram = gram - between[sensor, int(size)][0]
        within.append(gram)
    residual, by_z = prior_rows(posterior.model, posterior.priors, z)
    rows = np.column_stack((-by_z[:, posterior.free], residual))
    return Linearisation(posterior, z, np.array(within), between, rows.T @ rows)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The posterior of a model that is linear about ``z``: Gaussian given the noise.

    Attributes
    ----------
    posterior
        The one it approximates.
    z
        Pinned parameters, (size,).
    within
        Gram matrix of [derivative | error] about the group means per sensor, (sensors, f+1, f+1).
    between
        Gram matrix of the group means times the size, and their count, by (sensor, group size).
    prior
        Gram matrix of the priors, (f+1, f+1).
    """

    posterior: Posterior
    z: FloatArray
    within: FloatArray
    between: dict[tuple[int, int], tuple[FloatArray, int]]
    prior: FloatArray

    def gram(self, eta: FloatArray) -> FloatArray:
        """Return the weighted Gram matrices (..., f+1, f+1) for noise coordinates (..., e)."""
        sigma, pose_sigma = self.posterior.noise(eta)
        weights = [1.0 / sigma[..., s] ** 2 for s in range(len(self.within))]
        matrices = list(self.within)
        for (sensor, size), (matrix, _) in self.between.items():
            weights.append(1.0 / (sigma[..., sensor] ** 2 + size * pose_sigma[..., sensor] ** 2))
            matrices.append(matrix)
        return np.tensordot(np.stack(weights, axis=-1), np.array(matrices), axes=1) + self.prior

    def conditional(self, eta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the Gaussian of the free parameters given the noise, and the noise's density.

        Parameters
        ----------
        eta
            (..., e).

        Returns
        -------
        mean
            Free pinned parameters, (..., f).
        cholesky
            Lower Cholesky factor of the precision, (..., f, f).
        log_marginal
            Log density of the noise coordinates with the parameters integrated out, (...).
        """
        posterior = self.posterior
        gram = self.gram(eta)
        f = len(posterior.free)
        # The scale of the parameters (rad, m) and of their information differs by many powers.
        information = np.diagonal(gram, axis1=-2, axis2=-1)[..., :f]
        if not np.all(information > 0.0):
            raise np.linalg.LinAlgError('a parameter without any information')
        scale = 1.0 / np.sqrt(information)
        scaled = gram[..., :f, :f] * scale[..., :, None] * scale[..., None, :]
        factor = np.linalg.cholesky(scaled)
        pull = np.linalg.solve(factor, (gram[..., :f, f] * scale)[..., None])
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), pull)[..., 0] * scale
        quadratic = gram[..., f, f] - np.sum(pull[..., 0] ** 2, axis=-1)
        log_root = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)) - np.log(scale), axis=-1)
        sigma, pose_sigma = posterior.noise(eta)
        sizes = posterior.rows.group_size
        sensors = posterior.rows.group_sensor
        log_scale = np.zeros(quadratic.shape)
        for sensor in range(len(self.within)):
            spare = int(np.sum(sizes[sensors == sensor] - 1))
            log_scale += 3.0 * spare * 2.0 * np.log(sigma[..., sensor])
        for (sensor, size), (_, count) in self.between.items():
            total = sigma[..., sensor] ** 2 + size * pose_sigma[..., sensor] ** 2
            log_scale += 3.0 * count * np.log(total)
        log_marginal = posterior.log_noise_prior(eta) - 0.5 * (log_scale + quadratic) - log_root
        mean = self.z[posterior.free] + step
        return mean, factor / scale[..., :, None], log_marginal


@dataclass(frozen=True, eq=False)
class Mode:
    """Where the linearised posterior peaks, and how wide it is.

    Attributes
    ----------
    z
        Pinned parameters, (size,).
    eta
        (e,).
    eta_covariance
        (e, e).
    linearisation
        About z.
    """

    z: FloatArray
    eta: FloatArray
    eta_covariance: FloatArray
    linearisation: Linearisation

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the free pinned parameters at the mode's noise, (f, f)."""
        _, factor, _ = self.linearisation.conditional(self.eta)
        root = np.linalg.inv(factor)
        return root.T @ root


def find_mode(posterior: Posterior, eta: FloatArray | None = None) -> Mode:
    """Find the mode by Gauss–Newton steps, the noise at the peak of its marginal density.

    Parameters
    ----------
    posterior
        With ``reference`` near the mode (see `start.robust_start`).
    eta
        Where to begin the search of the noise, (e,); from the errors at the reference where None.

    Raises
    ------
    InsufficientDataError
        When the steps do not settle: the rows do not determine the free parameters.
    """
    z = posterior.reference
    eta = _noise_guess(posterior) if eta is None else eta
    try:
        for _ in range(50):
            linearisation = linearise(posterior, z)
            eta = _noise_peak(linearisation, eta)
            mean, factor, _ = linearisation.conditional(eta)
            step = mean - z[posterior.free]
            z = posterior.parameters(mean)
            # The step in units of the posterior's own spread.
            if np.linalg.norm(np.swapaxes(factor, -1, -2) @ step) < 1e-3:
                linearisation = linearise(posterior, z)
                return Mode(z, eta, _noise_covariance(linearisation, eta), linearisation)
    except np.linalg.LinAlgError:
        # A parameter without any information: the same remedy as steps that never end.
        pass
    raise InsufficientDataError(
        'the fit does not settle: the observations hardly determine the parameters; '
        'measure more poses, spread further'
    )


def _noise_guess(posterior: Posterior) -> FloatArray:
    errors = posterior.rows.target - posterior.model.predict(posterior.reference, posterior.rows)
    within, mean_square = posterior.sums_of_squares(errors)
    size, sensor = posterior.rows.group_size, posterior.rows.group_sensor
    sigmas, ratios = [], []
    for index in range(len(posterior.model.sensor_names)):
        mine = sensor == index
        spare = np.sum(size[mine] - 1)
        common = np.mean(mean_square[mine]) / 3.0
        variance = np.sum(within[mine]) / (3.0 * spare) if spare > 0 else common
        sigma = np.sqrt(variance + RESOLUTION_M**2)
        sigmas.append(np.log(sigma))
        if index in posterior.separable:
            ratios.append(np.arcsinh(np.sqrt(common) / sigma))
    return np.array(sigmas + ratios)


def _noise_peak(linearisation: Linearisation, start: FloatArray) -> FloatArray:
    """Climb to the peak of the noise's log density by Newton steps no longer than 1."""
    peak = start
    for _ in range(100):
        value, gradient, precision = _noise_curvature(linearisation, peak)
        values, vectors = np.linalg.eigh(precision)
        # Uphill also where the density is not yet concave.
        step = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 0.1))
        step /= max(1.0, float(np.linalg.norm(step)))
        if np.linalg.norm(step) < 1e-4:
            break
        tries = peak + step * 0.5 ** np.arange(8.0)[:, None]
        heights = linearisation.conditional(tries)[2]
        if np.max(heights) <= value:
            break
        peak = tries[np.argmax(heights)]
    sensors = len(linearisation.within)
    return np.concatenate((peak[:sensors], np.abs(peak[sensors:])))


def _noise_covariance(linearisation: Linearisation, peak: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(_noise_curvature(linearisation, peak)[2])
    # The floor keeps a flat direction (pose_sigma near zero) proper: a std of 1.5 at most.
    return (vectors / np.maximum(values, 0.45)) @ vectors.T


def _noise_curvature(
    linearisation: Linearisation, at: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return the noise's log density, its gradient and its negative second derivative.

    Differences, all in one batch: the density costs microseconds, its derivative a page.
    """
    e, step = len(at), 0.02
    unit = step * np.eye(e)
    plus, minus = at + unit, at - unit
    corners = [
        at + a * unit[i] + b * unit[j]
        for i in range(e)
        for j in range(e)
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    value = linearisation.conditional(np.array([at, *plus, *minus, *corners]))[2]
    gradient = (value[1 : e + 1] - value[e + 1 : 2 * e + 1]) / (2.0 * step)
    four = value[2 * e + 1 :].reshape(e, e, 4)
    curvature = four @ np.array([1.0, -1.0, -1.0, 1.0]) / (4.0 * step**2)
    return float(value[0]), gradient, -0.5 * (curvature + curvature.T)


@dataclass(frozen=True, eq=False)
class LaplaceProposal:
    """Noise from a Student t; parameters given the noise from their Gaussian, with t tails.

    Together a heavy-tailed, skewed relative of the multivariate t: the width of the parameters
    goes with the noise drawn.
    """

    mode: Mode

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) of the posterior and their log density (count,)."""
        # The folded coordinates have a mirrored half: |x| has the density of x and of -x together.
        eta, _ = self._noise.sample(count, rng)
        eta = self._fold(eta)
        mean, factor, _ = self.mode.linearisation.conditional(eta)
        normal = rng.standard_normal(mean.shape)
        tail = rng.random(count) < TAIL_SHARE
        mixing = np.sqrt(rng.chisquare(TAIL_FREEDOM, count) / TAIL_FREEDOM)
        whitened = normal * np.where(tail, TAIL_WIDENING / mixing, 1.0)[:, None]
        step = np.linalg.solve(np.swapaxes(factor, -1, -2), whitened[..., None])[..., 0]
        density = self._noise_density(eta) + self._conditional_density(whitened, factor)
        return np.concatenate((mean + step, eta), axis=1), density

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (n, d), (n,)."""
        f = len(self.mode.linearisation.posterior.free)
        eta = points[:, f:]
        mean, factor, _ = self.mode.linearisation.conditional(eta)
        step = (points[:, :f] - mean)[..., None]
        whitened = (np.swapaxes(factor, -1, -2) @ step)[..., 0]
        return self._noise_density(eta) + self._conditional_density(whitened, factor)

    def dispersed(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return starts for chains: spread twice as far as the posterior, (count, d)."""
        mode = self.mode
        points, _ = self.sample(count, rng)
        centre = np.concatenate((mode.z[mode.linearisation.posterior.free], mode.eta))
        starts = centre + 2.0 * (points - centre)
        f = len(mode.linearisation.posterior.free)
        starts[:, f:] = self._fold(starts[:, f:])
        return starts

    def _fold(self, eta: FloatArray) -> FloatArray:
        sensors = len(self.mode.linearisation.within)
        return np.concatenate((eta[:, :sensors], np.abs(eta[:, sensors:])), axis=1)

    def _noise_density(self, eta: FloatArray) -> FloatArray:
        sensors = len(self.mode.linearisation.within)
        folded = eta.shape[1] - sensors
        signs = itertools.product((1.0, -1.0), repeat=folded)
        mirrored = [eta * np.array((*(1.0,) * sensors, *sign)) for sign in signs]
        return np.logaddexp.reduce([self._noise.log_density(image) for image in mirrored])

    @property
    def _noise(self) -> StudentT:
        factor: FloatArray = np.asarray(np.linalg.cholesky(self.mode.eta_covariance))
        return StudentT(self.mode.eta, factor, NOISE_FREEDOM)

    def _conditional_density(self, whitened: FloatArray, factor: FloatArray) -> FloatArray:
        f = whitened.shape[-1]
        square = np.sum(whitened**2, axis=-1)
        centre = np.log1p(-TAIL_SHARE) - 0.5 * square - 0.5 * f * np.log(2.0 * np.pi)
        tail = (
            np.log(TAIL_SHARE)
            + log_student_t(square / TAIL_WIDENING**2, f, TAIL_FREEDOM)
            - f * np.log(TAIL_WIDENING)
        )
        log_root = np.sum(np.log(np.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
        return np.logaddexp(centre, tail) + log_root
