# SPDX-License-Identifier: Apache-2.0
"""Predicted error of the arm by the posterior: section V-C of Van Wyk et al.

For draws of the posterior and configurations of the arm: the distance from the marker's position
by the applied model to its position by the draw, with and without the sensor's noise. The applied
model has offsets at zero (before) or the estimate (after). Two versions:

*Invariant.* Both positions in the sensor's frame, each by its own registrations and markers:
rotations of joint 1 that cancel with the registration, or of the last joint that cancel with the
marker, do not count. At visited configurations this predicts the measure of eq. 18.

*The paper's.* Both positions in the robot base, only the offsets differ, the marker is that of the
estimate. Offsets that are not identifiable count in full: nearly half of the paper's "Vernier"
error is its offset of joint 1, which is a rotation of the sensor. If the fit holds such an offset
at 0 it adds nothing; in the paper's chain it wanders.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.types import FloatArray, IntArray, Measurements

RANDOM_CONFIGURATIONS = 1000
# Number of pairs of a configuration and a draw for each table, for means and quantiles to half a
# per cent. The paper takes 2000 draws for each configuration.
PAIRS = 100_000
# Largest number of visited rows; of more a random sample is taken.
MOST_ROWS = 10_000
_BLOCK_ROWS = 50


class Distances(NamedTuple):
    """Distances, m, one per pair of a configuration and a draw, (pairs,) each."""

    before: FloatArray
    before_offsets_only: FloatArray
    after: FloatArray
    after_offsets_only: FloatArray


@dataclass(frozen=True, eq=False)
class Predictive:
    """Posterior as predictions use it: model, estimate, draws and noise."""

    model: Model  # Whose parameters were drawn
    after: FloatArray  # Pinned parameters of the estimate, (size,)
    draws: FloatArray  # Pinned parameters of the posterior's draws, (draws, size)
    # Noise of each draw and sensor, all its parts together, m, (draws, sensors, 2): along the line
    # of sight, and per axis across it
    sigma: FloatArray

    @cached_property
    def mean_offsets(self) -> FloatArray:
        """Means of the offsets over the draws, rad, (k,): the paper's estimate."""
        return self.model.offsets(self.draws).mean(axis=0)

    def without_extension(self) -> Predictive:
        """Same posterior without effects, which are known at visited rows only."""
        core = self.model.core
        return replace(
            self,
            model=replace(self.model, extension=None),
            after=self.after[:core],
            draws=self.draws[:, :core],
        )


def random_configurations(
    model: Model, seen: Measurements, count: int, rng: np.random.Generator
) -> Measurements:
    """Rows at ``count`` joint configurations drawn uniformly within the joint limits.

    Neither collisions nor lines of sight are checked: the whole workspace counts, as in the paper.
    The rows go through the sensors in turn, each with its first marker in ``seen``; each is a pose
    of its own. Measured columns are those of the first row of ``seen`` and without meaning.
    """
    followed = [seen.marker[np.flatnonzero(seen.sensor == s)[0]] for s in np.unique(seen.sensor)]
    sensor = np.arange(count) % len(followed)
    rows = np.arange(count)
    # Over one turn of a continuous joint, whose limits are infinite.
    low, high = (
        np.where(np.isfinite(limit), limit, turn)
        for limit, turn in ((model.chain.lower, -np.pi), (model.chain.upper, np.pi))
    )
    return replace(
        seen.select(np.zeros(count, dtype=np.int64)),
        observation=rows,
        pose=rows,
        configuration=rows,
        sensor=np.unique(seen.sensor)[sensor],
        marker=np.array(followed)[sensor],
        q=rng.uniform(low, high, (count, len(low))),
        # Of the marker's own place: a sensor on the tool has measured nothing from there.
        orientation=None,
    )


class PredictedAccuracy(NamedTuple):
    """Marker positions at n configurations, and their errors with the estimate applied."""

    place: FloatArray  # Position by the estimate, in the robot base, m, (n, 3)
    error: FloatArray  # Mean distance over the draws, without the sensor's noise, m, (n,)


def predicted_accuracy(
    predictive: Predictive, seen: Measurements, count: int, rng: np.random.Generator
) -> PredictedAccuracy:
    """Predicted accuracy at ``count`` random configurations, with registrations drawn, too.

    Marker positions by the estimate, and their mean distances from those by draws of all
    parameters. Configurations are of `random_configurations`; ``seen``: measurements that it
    takes sensors and markers from.
    """
    core = predictive.without_extension()
    m = random_configurations(core.model, seen, count, rng)
    taken = rng.permutation(len(core.draws))[: max(1, PAIRS // count)]
    places, errors = np.empty((count, 3)), np.empty(count)
    for block in np.array_split(np.arange(count), -(-count // _BLOCK_ROWS)):
        rows = Rows.of(m, block, core.model.reference)
        place = core.model.predict(core.after, rows)
        drawn = core.model.predict(core.draws[taken], rows)
        places[rows.source] = place
        errors[rows.source] = np.linalg.norm(drawn - place, axis=-1).mean(axis=0)
    return PredictedAccuracy(places, errors)


class ToolPlaces(NamedTuple):
    """Marker positions at one configuration, in the robot base, m (Fig. 5 of the paper)."""

    # With offsets at zero and as estimated, (3,)
    before: FloatArray
    after: FloatArray
    # With the offsets of draws, without and with the noise of a reading, (draws, 3)
    drawn: FloatArray
    noisy: FloatArray


def tool_places(
    predictive: Predictive, seen: Measurements, row: int, count: int, rng: np.random.Generator
) -> ToolPlaces:
    """Positions of the marker at the configuration of a row, by draws of the offsets.

    The paper's version: only offsets are drawn, the marker is that of the estimate. ``seen``:
    measurements; ``row``: index of the row; ``count``: largest number of draws.
    """
    core = predictive.without_extension()
    model, taken = core.model, rng.permutation(len(core.draws))[:count]
    q, sensor = seen.q[row], seen.sensor[row]
    marker = model.markers(model.natural(core.after))[seen.marker[row]]
    offsets = np.concatenate(
        (
            np.zeros((1, model.joints)),
            predictive.mean_offsets[None],
            model.offsets(core.draws[taken]),
        )
    )
    before, after, *drawn = model.chain.positions(q, marker, offsets)
    noise = rng.standard_normal((len(taken), 3)) * core.sigma[taken, sensor, 1:]
    return ToolPlaces(before, after, np.array(drawn), np.array(drawn) + noise)


def theoretical_distances(
    predictive: Predictive,
    before: FloatArray,
    measurements: Measurements,
    chosen: IntArray,
    rng: np.random.Generator,
) -> tuple[Distances, Distances]:
    """Predicted errors of section V-C at rows of the measurements, m, in two versions.

    First the invariant version: positions in the sensor's frame, with all parameters drawn;
    then the paper's: in the robot base, with only the offsets drawn. ``before``: pinned
    parameters with offsets at zero, of which the first (size,) are used; ``measurements``: all
    rows of the session (those that the extension was made for); ``chosen``: indices of the
    rows; of more than 10,000 a random sample is taken.
    """
    rows = rng.permutation(chosen)[:MOST_ROWS]
    draws, before = len(predictive.draws), before[: predictive.model.size]
    per_block = min(draws, -(-PAIRS // len(rows)))
    order = rng.permutation(draws)
    blocks = np.array_split(rows, -(-len(rows) // _BLOCK_ROWS))
    parts = []
    for index, block in enumerate(blocks):
        # Every block of rows takes other draws, so that all draws are used.
        taken = order[(index * per_block + np.arange(per_block)) % draws]
        seen = predictive.model.rows(measurements, block).of_points
        parts.append(_block(predictive, before, seen, taken, rng))
    invariant, paper = np.concatenate(parts, axis=-1)
    return Distances(*invariant), Distances(*paper)


def _block(
    predictive: Predictive,
    before: FloatArray,
    rows: Rows,
    taken: IntArray,
    rng: np.random.Generator,
) -> FloatArray:
    """The four `Distances` of some rows and draws, m, (2, 4, pairs): invariant, then the paper's.

    Versions as of `theoretical_distances`. ``before``: pinned parameters with offsets at zero,
    (size,); ``taken``: indices of the draws.
    """
    model, draws = predictive.model, predictive.draws[taken]
    sensor = rows.group_sensor[rows.group_of_row]
    predicted = model.seen(predictive.after, rows)
    sight = predicted - model.reference[sensor, :3, 3]
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    along, across = np.moveaxis(predictive.sigma[taken][:, sensor], -1, 0)
    raw = rng.standard_normal((len(taken), len(rows), 3))
    deeper = (along - across) * np.einsum('dni,ni->dn', raw, sight)
    noise = across[..., None] * raw + deeper[..., None] * sight
    in_sensor = model.seen(before, rows), predicted, model.seen(draws, rows)
    markers = model.markers(model.natural(predictive.after))[rows.marker]
    in_base = (
        model.chain.positions(rows.q, markers, offsets)
        for offsets in (
            model.offsets(before),
            predictive.mean_offsets,
            model.offsets(draws)[:, None, :],
        )
    )
    distances: list[FloatArray] = []
    for *points, drawn in (in_sensor, in_base):
        noisy = drawn + noise
        distances += [
            _distances_between(place, prediction)
            for prediction in points
            for place in (noisy, drawn)
        ]
    return np.reshape(distances, (2, 4, -1))


def _distances_between(places: FloatArray, other_places: FloatArray) -> FloatArray:
    """Distances between points (..., 3) and others, which broadcast, m, flattened.

    Three times as fast as `numpy.linalg.norm`.
    """
    shift = places - other_places
    distances: FloatArray = np.sqrt(np.einsum('...i,...i->...', shift, shift))
    return distances.ravel()
