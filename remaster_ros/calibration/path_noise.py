# SPDX-License-Identifier: Apache-2.0
"""Errors along a path: a Gaussian process over the tool's pose, common to a sensor's markers.

The errors of a sensor at one pose are nearly the same a tenth of a second later, and when the arm
returns to the pose. The errors of frames a and b of a sensor have the correlation::

  (1 - s) [a = b] + s M(d),    d² = |p_a - p_b|² / l_m² + angle(a, b)² / l_rad²

with M of Matérn's family, of order 1/2, 3/2, 5/2 or infinite (Stein 1999, Interpolation of Spatial
Data), p and angle of the nominal tool. The order, the share s of the process and its two lengths
maximise the restricted likelihood (REML, Patterson and Thompson 1971, Biometrika 58) of the
frames' means about a fit; the deviations of single markers from these means have a share and
lengths of their own, in the same proportion.

The rows are then decorrelated: the means of the frames, and the deviations of each marker, are
multiplied by the inverse Cholesky factor of these correlations, and by the share of the standard
deviation that is scatter about their mean. The rest of the noise is as in `noise`, on independent
rows. The uncertainty of the lengths and shares is not counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
from scipy.linalg import cho_factor, solve_triangular

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray, Measurements

# Start and range of the lengths in the search.
START_M, START_RAD = 0.1, 0.5
RANGE_M, RANGE_RAD = (0.01, 1.0), (0.05, 5.0)
# Standard deviation of the lengths' logarithms about the start, of a weak prior.
LOG_LENGTH_STD = 1.0
# Orders of Matérn's family; the infinite one is the squared exponential.
ORDERS = (0.5, 1.5, 2.5, np.inf)
# Range of the share of the process.
RANGE_SHARE = (1e-3, 0.9995)
# Largest number of frames of a run, whose matrix is factored in a tenth of a second. Runs count as
# independent.
MOST_FRAMES = 1_200
# Frames by which share and lengths are estimated: a minute's, hundreds of matrices of a hundredth
# of a second.
MOST_SEARCHED = 600


@dataclass(frozen=True, eq=False)
class PathNoise:
    """Correlations of errors along a path, for all sensors and rows of a session."""

    # Nominal tool, of every row: position, m, (n, 3), and turn, a matrix, (n, 9)
    position: FloatArray
    turn: FloatArray
    # Of each sensor, (sensors,)
    share: FloatArray  # Of the process in the errors of the frames' means
    marker_share: FloatArray  # In the deviations of markers from them
    length_m: FloatArray
    length_rad: FloatArray
    marker_scale: FloatArray  # How many times these lengths are those of the deviations
    order: IntArray  # Of Matérn's family, an index into `ORDERS`

    def of_frames(self, sensor: int, rows: IntArray) -> FloatArray:
        """Correlations of the errors of frames of a sensor (index), (f, f), 1 on the diagonal.

        ``rows``: index of one row of each frame.
        """
        return self._correlations(sensor, rows, float(self.share[sensor]), 1.0)

    def of_markers(self, sensor: int, rows: IntArray) -> FloatArray:
        """Correlations of one marker's deviations from the frames' means in r rows, (r, r).

        ``sensor``, ``rows``: indices.
        """
        share, scale = float(self.marker_share[sensor]), float(self.marker_scale[sensor])
        return self._correlations(sensor, rows, share, scale)

    def _correlations(self, sensor: int, rows: IntArray, share: float, scale: float) -> FloatArray:
        """Correlations of n rows (indices) of a sensor, (n, n), 1 on the diagonal.

        ``share``: of the process in the variance; ``scale``: factor on the sensor's lengths.
        """
        lengths = float(self.length_m[sensor]), float(self.length_rad[sensor])
        d = _distance(self.position[rows], self.turn[rows], *lengths)
        return _correlations(d / scale, share, int(self.order[sensor]))


@dataclass(frozen=True, eq=False)
class Decorrelation:
    """Triangular matrices that decorrelate the rows of one sensor, run by run.

    ``frames``: frames of each run, ``means``: its matrix (f, f); ``markers``: rows and matrix of
    each marker's deviations in the run.
    """

    runs: tuple[tuple[slice, FloatArray, tuple[tuple[IntArray, FloatArray], ...]], ...]

    @classmethod
    def of(
        cls,
        noise: PathNoise,
        sensor: int,
        source: IntArray,
        marker: IntArray,
        frame_start: IntArray,
        frame_size: IntArray,
        frames: slice,
    ) -> Decorrelation:
        """Matrices that decorrelate a sensor's rows, for runs of at most `MOST_FRAMES` frames.

        Runs are equal parts of the sensor's frames, one after the other, and count as independent.
        Each has a matrix for the means of its frames, and one for each marker's deviations from
        these means; none for deviations if the sensor's ``marker_share`` is at most 0.001.
        ``source``, ``marker``: index in the measurements, and index of the marker, of all n rows,
        (n,); ``frame_start``, ``frame_size``: first row and number of rows of all frames;
        ``frames``: slice of the frames of the sensor.
        """
        runs = []
        parts = -(-(frames.stop - frames.start) // MOST_FRAMES)
        for part in np.array_split(np.arange(frames.start, frames.stop), parts):
            first, last = int(part[0]), int(part[-1]) + 1
            at = source[frame_start[first:last]]
            means = _inverse_factor(noise.of_frames(sensor, at))
            stop = int(frame_start[last - 1] + frame_size[last - 1])
            rows = np.arange(int(frame_start[first]), stop)
            marker_factors = []
            if noise.marker_share[sensor] > RANGE_SHARE[0]:
                for index in np.unique(marker[rows]):
                    selection = rows[marker[rows] == index]
                    marker_factors.append(
                        (selection, _inverse_factor(noise.of_markers(sensor, source[selection])))
                    )
            runs.append((slice(first, last), means, tuple(marker_factors)))
        return cls(tuple(runs))


def path_noise(
    chain: SerialChain,
    m: Measurements,
    sensor: int,
    rows: tuple[IntArray, IntArray, IntArray],
    errors: FloatArray,
    columns: FloatArray,
    prior: FloatArray,
    before: PathNoise | None,
    sensors: int,
) -> PathNoise:
    """Path noise of a session with that of one sensor added, estimated from a fit.

    Parameters
    ----------
    chain, m
        Nominal arm, and all rows of the session.
    sensor, sensors
        Index of the sensor, and number of sensors.
    rows
        Rows of the sensor, sorted by frames: index in the measurements, (n,), number of the frame
        from 0 on, (n,), marker, (n,).
    errors, columns
        Errors of these rows, m, (n, 3), and their derivative by the fit's parameters, (n, 3, p).
    prior
        Precision of the parameters times the variance of a frame's mean, (p, p).
    before
        Path noise with the earlier sensors; None for the first.
    """
    source, frame, marker = rows
    if before is None:
        T = chain.forward(m.q)
        unit = np.zeros(sensors)
        before = PathNoise(
            T[:, :3, 3],
            T[:, :3, :3].reshape(-1, 9),
            unit.copy(),
            unit.copy(),
            unit + START_M,
            unit + START_RAD,
            unit + 1.0,
            unit.astype(np.int64),
        )
    size = np.bincount(frame)
    first = np.flatnonzero(np.diff(frame, prepend=-1))
    weight = np.sqrt(size)[:, None]
    mean = np.add.reduceat(errors, first, axis=0) / size[:, None]
    augmented_columns = np.concatenate((columns, errors[..., None]), axis=2)
    joined = np.add.reduceat(augmented_columns, first, axis=0) / weight[..., None]
    # Long recordings: the lengths of a part of them are those of all.
    part = slice(0, MOST_SEARCHED)
    joined, at = joined[part], source[first][part]
    position, turn = before.position[at], before.turn[at]
    f, p = len(joined), prior.shape[0]
    flat = joined.reshape(f, -1)

    def cost(logs: FloatArray, order: int) -> float:
        """Minus the log restricted likelihood, with the variance at its maximum."""
        share, length_m, length_rad = _natural(logs)
        d = _distance(position, turn, length_m, length_rad)
        factor = np.linalg.cholesky(_correlations(d, share, order))
        white = solve_triangular(factor, flat, lower=True, check_finite=False)
        white = white.reshape(f * 3, p + 1)
        gram = white.T @ white
        inner = gram[:p, :p] + prior
        unit = 1.0 / np.sqrt(np.maximum(np.diag(inner), np.finfo(float).tiny))
        root = cho_factor(inner * np.outer(unit, unit) + 1e-10 * np.eye(p), lower=True)
        pull = solve_triangular(root[0], unit * gram[:p, p], lower=True)
        residual_square = max(float(gram[p, p] - pull @ pull), 1e-300)
        logdet = 3.0 * np.sum(np.log(np.diag(factor)))
        logdet += np.sum(np.log(np.diag(root[0])) - np.log(unit))
        # A weak prior on the lengths: a path may not show them.
        weak = 0.5 * (logs[1] ** 2 + logs[2] ** 2) / LOG_LENGTH_STD**2
        return float(logdet + 0.5 * (3 * f - p) * np.log(residual_square) + weak)

    start = np.array([4.0, 0.0, 0.0])
    tries = [
        (*_minimised(partial(cost, order=order), start), order) for order in range(len(ORDERS))
    ]
    _, best, order = min(tries, key=lambda result: result[0])
    share, length_m, length_rad = _natural(best)
    marker_share, scale = _of_markers(
        errors - mean[frame],
        frame,
        marker,
        f,
        _distance(position, turn, length_m, length_rad),
        order,
    )
    values = {
        'share': share,
        'marker_share': marker_share,
        'length_m': length_m,
        'length_rad': length_rad,
        'marker_scale': scale,
        'order': order,
    }
    arrays = {name: getattr(before, name).copy() for name in values}
    for name, value in values.items():
        arrays[name][sensor] = value
    return PathNoise(before.position, before.turn, **arrays)


def _minimised(cost: Callable[[FloatArray], float], start: FloatArray) -> tuple[float, FloatArray]:
    """Least cost near a start (d,), and its position (d,), by 60 evaluations at most."""
    simplex = start + np.concatenate((np.zeros((1, len(start))), 0.7 * np.eye(len(start))))
    found = scipy.optimize.minimize(
        cost,
        start,
        method='Nelder-Mead',
        options={'xatol': 0.1, 'fatol': 0.1, 'maxfev': 60, 'initial_simplex': simplex},
    )
    return float(found.fun), np.asarray(found.x)


def _natural(logs: FloatArray) -> tuple[float, float, float]:
    """Share of the process and its lengths, m and rad, each clipped to its range.

    ``logs``: logit of the share, and logs of the lengths over `START_M` and `START_RAD`, (3,).
    """
    share = float(np.clip(1.0 / (1.0 + np.exp(-logs[0])), *RANGE_SHARE))
    length_m = float(np.clip(START_M * np.exp(logs[1]), *RANGE_M))
    length_rad = float(np.clip(START_RAD * np.exp(logs[2]), *RANGE_RAD))
    return share, length_m, length_rad


def _of_markers(
    deviations: FloatArray,
    frame: IntArray,
    marker: IntArray,
    frames: int,
    distance: FloatArray,
    order: int,
) -> tuple[float, float]:
    """Share and scale of the process in the deviations of single markers, by likelihood.

    (0.0, 1.0) if there is one marker, or if each marker is in half of the frames or fewer.
    ``deviations``: of rows from their frames' means, m, (n, 3), of which those of the first
    ``frames`` frames are used; ``frame, marker``: of these rows, (n,); ``distance``: between
    the frames, (f, f); ``order``: index into `ORDERS`.
    """
    series: dict[bytes, tuple[IntArray, list[FloatArray]]] = {}
    for candidate in np.unique(marker):
        of_marker = (marker == candidate) & (frame < frames)
        if of_marker.sum() > frames // 2:
            at = frame[of_marker]
            series.setdefault(at.tobytes(), (at, []))[1].append(deviations[of_marker])
    if len(np.unique(marker)) < 2 or not series:
        return 0.0, 1.0

    def cost(logs: FloatArray) -> float:
        share, scale = _natural_of_markers(logs)
        squares = logdet = count = 0.0
        correlations = _correlations(distance / scale, share, order)
        for at, several in series.values():
            values = np.concatenate(several, axis=1)
            factor = np.linalg.cholesky(correlations[np.ix_(at, at)])
            white = solve_triangular(factor, values, lower=True, check_finite=False)
            squares += float(np.sum(white**2))
            logdet += values.shape[1] * float(np.sum(np.log(np.diag(factor))))
            count += values.size
        weak = 0.5 * (logs[1] / LOG_LENGTH_STD) ** 2
        return logdet + 0.5 * count * float(np.log(max(squares, 1e-300))) + weak

    # A process at the edge of what is seen is begun from either side.
    tries = [_minimised(cost, np.array([logit, 0.0])) for logit in (-4.0, 1.0)]
    return _natural_of_markers(min(tries, key=lambda candidate: candidate[0])[1])


def _natural_of_markers(logs: FloatArray) -> tuple[float, float]:
    """Share of the process, and scale of its lengths from 0.1 to 10, from (2,): logit and log."""
    share = float(np.clip(1.0 / (1.0 + np.exp(-logs[0])), *RANGE_SHARE))
    return share, float(np.clip(np.exp(logs[1]), 0.1, 10.0))


def _distance(
    position: FloatArray, turn: FloatArray, length_m: float, length_rad: float
) -> FloatArray:
    """Distances of f poses in lengths of the process, (f, f).

    ``position``: m, (f, 3); ``turn``: rotation matrices, (f, 9); lengths in m and rad.
    """
    # A rotation by a small angle moves the columns of its matrix by sqrt(2) times it in all.
    place = np.concatenate((position / length_m, turn / (np.sqrt(2.0) * length_rad)), axis=1)
    square = np.sum(place**2, axis=1)
    square_distance = square[:, None] + square - 2.0 * place @ place.T
    return np.sqrt(np.maximum(square_distance, 0.0))


def _correlations(distance: FloatArray, share: float, order: int) -> FloatArray:
    """Correlations by distances in lengths of the process, (f, f), with 1 on the diagonal.

    ``share``: of the process in the variance; ``order``: index into `ORDERS`.
    """
    d = np.sqrt(2.0 * min(ORDERS[order], 2.5)) * distance
    if ORDERS[order] == np.inf:
        process = np.exp(-0.5 * distance**2)
    elif ORDERS[order] == 0.5:
        process = np.exp(-d)
    elif ORDERS[order] == 1.5:
        process = (1.0 + d) * np.exp(-d)
    else:
        process = (1.0 + d + d**2 / 3.0) * np.exp(-d)
    result = share * process
    result[np.diag_indices(len(result))] = 1.0
    return np.asarray(result)


def _inverse_factor(correlations: FloatArray) -> FloatArray:
    """Matrix (f, f) that decorrelates f errors with correlations (f, f).

    The inverse Cholesky factor, times the root of one minus the mean correlation
    (`scatterless`): the part of the errors that is constant over the path is absorbed by the
    registration, and cannot be seen in the scatter.
    """
    factor = np.linalg.cholesky(correlations)
    inverse = solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False)
    return np.asarray(np.sqrt(1.0 - scatterless(correlations)) * inverse)


def scatterless(correlations: FloatArray) -> float:
    """Share of the variance that is common to all errors: the mean correlation, at most 0.999."""
    return min(float(np.mean(correlations)), 0.999)
