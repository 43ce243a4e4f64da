"""Is any structure left? Checks after the search, of what no cause explains.

Smooth structure over the place in a sensor's volume and over time competes in the search itself
(the effects without a cause), against all that is tried there; what is too weak to win may still
be more than chance where the place alone is asked for. Then follow readings of another
configuration, a sensor that is far off in held-out rows, held-out poses with larger errors than
poses left out of the fit in turn, and errors beyond the accuracy that a sensor states. Single
gross errors are no structure: they are listed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.left_out import Contrasts, compared
from remaster_ros.calibration.moved_since import moved_since
from remaster_ros.calibration.outliers import LARGEST_SHARE
from remaster_ros.calibration.residual_structure import (
    FEWEST_POSES,
    LEAST_NOISE_M,
    explained_of_poses,
)
from remaster_ros.calibration.result import FitResult
from remaster_ros.calibration.smooth_functions import of_position
from remaster_ros.discovery.effects.sensor_field import EFFECT as SENSOR_FIELD
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.gain import GROSS, rms
from remaster_ros.discovery.guard import Unexplained, located
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.thinning import of_spread_poses
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Of one check where nothing is wrong.
SIGNIFICANCE = 0.001
# Fewer readings of another configuration may be chance or carelessness.
FEWEST_MISPAIRED = 2
# Gross errors that are compared with the places of all rows.
MOST_COMPARED = 200
# Observations that a sentence lists.
LISTED = 5
# Share of gross errors among careful measurements; for the p-value.
USUAL_GROSS = 0.01


def structure_left(
    data: Residuals,
    solution: Solution,
    fit: FitResult,
    structure: Sequence[FoundEffect],
) -> tuple[tuple[Unexplained, ...], tuple[tuple[int, str], ...]]:
    """Return all structure that no cause explains, and all single gross errors held out.

    The former includes ``structure``, which the search has located. The latter:
    (observation, what is wrong) of each held-out row with a gross error.
    """
    checks = _Checks(data, solution, fit)
    unexplained = (
        *located(structure),
        *errors_by_place(data, solution, SIGNIFICANCE),
        *checks.pairing(),
        *checks.far_off(),
        *checks.held_out(),
        *checks.beyond_stated(),
    )
    return unexplained, tuple(checks.gross_held_out())


@dataclass(frozen=True, eq=False)
class _Checks:
    """Checks of a session's n rows, after the search, for errors that no cause explains."""

    data: Residuals
    solution: Solution
    fit: FitResult

    @property
    def errors(self) -> FloatArray:
        """Measured minus modelled positions by the sampled fit, sensor frames, m, (n, 3)."""
        return self.fit.residuals_after

    @cached_property
    def limit(self) -> FloatArray:
        """Length above which an error is gross, m, (n,): `GROSS` sigmas of the row's sensor."""
        noise = self.data.noise_model.sensor_noise(self.solution.noise)
        limit: FloatArray = GROSS * noise.total
        return limit[self.data.context.sensor]

    @cached_property
    def gross(self) -> BoolArray:
        """Mask of the rows that the fit set aside, or whose error is beyond `limit`, (n,)."""
        left_out = [observation for observation, _ in self.fit.left_out]
        gross: BoolArray = np.isin(self.data.context.measurements.observation, left_out)
        return gross | (np.linalg.norm(self.errors, axis=1) > self.limit)

    @cached_property
    def predicted(self) -> FloatArray:
        """Modelled positions by the sampled fit, in the sensor frames, m, (n, 3)."""
        return self.data.context.measurements.position - self.errors

    @cached_property
    def mispaired(self) -> BoolArray:
        """Mask of the gross rows that lie where the marker was just before or after, (n,).

        At the neighbouring reading of the same sensor and marker, if that is of another pose.
        """
        measurements = self.data.context.measurements
        at_neighbour = np.zeros(len(measurements), bool)
        for rows in self._series():
            for index, other in ((rows[1:], rows[:-1]), (rows[:-1], rows[1:])):
                distances = np.linalg.norm(
                    measurements.position[index] - self.predicted[other], axis=1
                )
                # All configurations of a pose have the marker near one place.
                is_other_pose = measurements.pose[index] != measurements.pose[other]
                at_neighbour[index] |= is_other_pose & (distances < self.limit[index])
        return at_neighbour & self.gross

    def _series(self) -> Iterator[IntArray]:
        """Yield the row indices of each pair of sensor and marker, in the order of time.

        The array of a pair without rows is empty.
        """
        context = self.data.context
        for sensor in range(len(context.sensor_names)):
            for marker in range(len(context.marker_names)):
                rows = np.flatnonzero((context.sensor == sensor) & (context.marker == marker))
                yield rows[np.argsort(context.elapsed_s[rows], kind='stable')]

    def pairing(self) -> Iterator[Unexplained]:
        """Yield an entry on readings paired with the wrong configuration, if they are significant.

        Nothing if there are fewer than `FEWEST_MISPAIRED`, or chance may explain them.
        """
        count = int(self.mispaired.sum())
        if count < FEWEST_MISPAIRED:
            return
        measurements = self.data.context.measurements
        gross = np.flatnonzero(self.gross)
        # That a gross error ends by chance within the limit of one of two places: as often as it
        # lies within it of the places of other poses.
        sample = gross[:: 1 + len(gross) // MOST_COMPARED].tolist()
        chance = min(1.0, 2.0 * np.mean([self._share_near(row) for row in sample]))
        p_value = float(scipy.special.bdtrc(count - 1, len(gross), chance))
        if p_value > SIGNIFICANCE:
            return
        listed = ', '.join(map(str, measurements.observation[self.mispaired][:LISTED]))
        yield Unexplained(
            where='pairing',
            driver='neighbouring configuration',
            size_m=rms(self.errors, self.mispaired),
            p_value=p_value,
            next=(
                f'{count} readings (observations {listed}{" …" if count > LISTED else ""}) lie '
                'where the marker was at the configuration before or after their own: sensor and '
                'robot are paired wrongly. Compare the clocks of sensor and robot, wait longer '
                'after each motion, and record these configurations again.'
            ),
        )

    def _share_near(self, row: int) -> float:
        """Return the share of the sensor's rows of other poses that are predicted near a reading.

        ``row``: index of the reading; near: within its `limit`. One is added to both counts,
        so it is above 0.
        """
        measurements = self.data.context.measurements
        other_poses = (measurements.sensor == measurements.sensor[row]) & (
            measurements.pose != measurements.pose[row]
        )
        distances = np.linalg.norm(
            self.predicted[other_poses] - measurements.position[row], axis=1
        )
        return float((1 + np.sum(distances < self.limit[row])) / (1 + len(distances)))

    @cached_property
    def too_many(self) -> BoolArray:
        """Mask of gross held-out rows, not mispaired, of sensors with too many of them, (n,).

        Too many: more than `LARGEST_SHARE` of the sensor's held-out rows.
        """
        context, gross = self.data.context, self.gross & ~self.mispaired
        found = np.zeros(len(gross), dtype=bool)
        for index in range(len(context.sensor_names)):
            rows = context.measurements.is_validation & (context.sensor == index)
            if gross[rows].sum() > LARGEST_SHARE * rows.sum():
                found |= rows & gross
        return found

    def gross_held_out(self) -> Iterator[tuple[int, str]]:
        """Yield (observation, text) of each gross held-out row, except those in `too_many`."""
        measurements = self.data.context.measurements
        gross = self.gross & measurements.is_validation & ~self.too_many
        for row in np.flatnonzero(gross).tolist():
            length = float(np.linalg.norm(self.errors[row]))
            yield int(measurements.observation[row]), f'held out, off by {1e3 * length:.1f} mm'

    def far_off(self) -> Iterator[Unexplained]:
        """Yield an entry for each sensor that has rows in `too_many`.

        Steps among the fitted rows are found by the search. If held-out poses were measured
        last, a bump between the two shows in held-out rows alone.
        """
        context = self.data.context
        for index, sensor in enumerate(context.sensor_names):
            rows = context.measurements.is_validation & (context.sensor == index)
            count, total = int(self.too_many[rows].sum()), int(rows.sum())
            if not count:
                continue
            size = rms(self.errors, rows & self.too_many)
            moved = self._moved(index)
            yield Unexplained(
                where='held_out_poses',
                driver='time' if moved else 'unknown',
                size_m=size,
                p_value=float(scipy.special.bdtrc(count - 1, total, USUAL_GROSS)),
                next=moved
                or (
                    f'{f"All {total}" if count == total else f"{count} of the {total}"} held-out '
                    f'readings of {sensor} are off by {1e3 * size:.1f} mm (RMS): too many to be '
                    'single gross errors. Compare where and how they were measured with the '
                    'others.'
                ),
            )

    def _moved(self, sensor: int) -> str:
        """Return a sentence on the moment since which a sensor's errors are different; '' if none.

        ``sensor``: its index. '' without times, too.
        """
        context = self.data.context
        rows = np.flatnonzero(context.sensor == sensor)
        moved = None
        if context.has_time:
            moved = moved_since(context.measurements, rows, self.errors[rows])
        if moved is None:
            return ''
        x, y, z = 1e3 * moved.shift
        off = (
            f'the readings of {context.sensor_names[sensor]} are off by ({x:+.2f}, {y:+.2f}, '
            f'{z:+.2f}) mm in its frame'
        )
        if not moved.is_step:
            return (
                f'From about observation {moved.observation} on, {off} against those before; a '
                'step and a drift cannot be told apart. Fasten the sensor and its marker, let '
                'sensor and arm warm up, and measure the session again.'
            )
        off = f'{off}: the sensor or its marker was moved'
        m = context.measurements.select(rows)
        before = m.observation < moved.observation
        if m.is_validation[~before].all() and len(np.unique(m.pose[before & m.is_validation])) < 2:
            # A fit takes up a part of what happens amid its own rows, and one pose dates nothing.
            return (
                f'At all held-out poses {off} before them, or earlier, amid the fitted ones. '
                'Fasten both, and measure the session again.'
            )
        return (
            f'From about observation {moved.observation} on, {off} then. Fasten both, and measure '
            'the session again, or remove what was measured from there on.'
        )

    def held_out(self) -> Iterator[Unexplained]:
        """Yield an entry if errors on held-out poses are larger than on fitted poses left out.

        Fitted poses are left out of the fit in turn and predicted by the others. Gross held-out
        rows do not count. Nothing without held-out rows, or if chance may explain the difference.
        """
        data = self.data
        held_out = data.context.measurements.is_validation & ~self.gross
        found = compared_held_out(data, self.solution, np.flatnonzero(held_out))
        if not found:
            return
        _, p_value, ratio = min(found, key=lambda test: test[1])
        if p_value * len(found) > SIGNIFICANCE:
            return
        sensors = range(len(data.context.sensor_names))
        moved = [text for sensor in sensors if (text := self._moved(sensor))]
        yield Unexplained(
            where='held_out_poses',
            driver='time' if moved else 'unknown',
            size_m=rms(self.errors, held_out),
            p_value=p_value * len(found),
            next=' '.join(
                [
                    f'The errors on the held-out poses are {ratio:.1f} times those on '
                    'poses left out of the fit in turn, both in units of what is uncertain of '
                    'their prediction: what is held out lies elsewhere, or something changed in '
                    'between.',
                    *(moved or ['Compare where and when the two were measured.']),
                ]
            ),
        )

    def beyond_stated(self) -> Iterator[Unexplained]:
        """Yield an entry for each sensor whose mean error is too large for it.

        Either larger than noise of the sensor's stated standard deviation explains, or larger
        than that of any instrument.
        """
        for check in self.fit.noise_checks:
            if check.is_of_no_instrument:
                yield Unexplained('noise', 'unknown', check.after_m, None, check.no_instrument)
                continue
            if check.stated_std_m is None or check.explained is not False:
                continue
            stating = the('sensor', check.sensor)
            yield Unexplained(
                where='noise',
                driver='stated_std',
                size_m=check.after_m,
                p_value=None,
                next=(
                    f'{stating[:1].upper()}{stating[1:]} states {1e3 * check.stated_std_m:.3f} mm '
                    f'per axis for a reading, but the mean error is {1e3 * check.after_m:.3f} mm: '
                    'the arm does not repeat itself so well, the sensor is worse than it states, '
                    'or a cause is missing. Measure one pose twenty times, coming from elsewhere '
                    'each time.'
                ),
            )


def beyond_noise(data: Residuals, fit: FitResult) -> Iterator[Unexplained]:
    """Yield an entry for each sensor whose error exceeds its noise, in a session of few poses.

    Nothing with `FEWEST_POSES` poses or more, where the search can tell. Noise here is the
    scatter within poses: errors that all readings of a pose share may be something that
    changed between poses.
    """
    if len(np.unique(data.context.measurements.pose[data.rows.source])) >= FEWEST_POSES:
        return
    for check in fit.noise_checks:
        if check.explained is not False or check.noise_m is None:
            continue
        error_mm, noise_mm = 1e3 * check.after_m, 1e3 * check.noise_m
        yield Unexplained(
            where='noise',
            driver='pose',
            size_m=check.after_m,
            p_value=None,
            next=(
                f'The mean error of {the("sensor", check.sensor)} is {error_mm:.3f} mm, and what '
                f'readings of one pose differ by explains {noise_mm:.3f} mm of it. So few poses '
                f'do not show what changes from one to the next: measure at least {FEWEST_POSES}, '
                'with references in between, and search again.'
            ),
        )


def errors_by_place(
    data: Residuals, solution: Solution, significance: float
) -> Iterator[Unexplained]:
    """Yield an entry for each sensor whose errors depend on the marker's position in its frame.

    By an F test for each sensor: whether polynomials of the position up to the second degree,
    added to all causes found, explain more of the pose means than noise would. ``significance``:
    largest p-value that counts. Sensors with a field in the model, or with hardly any noise, are
    left out. The test finds errors that are too small to be named as a cause.
    """
    rows, candidates = data.rows, solution.candidates
    parts = [data.base, data.columns(candidates), data.errors[:, :, None], of_position(rows)]
    white = data.noise_model.whitened(np.concatenate(parts, axis=2), solution.noise)
    fitted = parts[0].shape[2] + parts[1].shape[2]
    model, errors, places = np.split(white, [fitted, fitted + 1], axis=2)
    pose_residuals = rows.group_sum(data.left(solution)) / rows.group_size[:, None]
    noise_m = data.noise_model.sensor_noise(solution.noise).total
    located = {
        candidate.subject for candidate in candidates if candidate.name == SENSOR_FIELD.name
    }
    families = np.split(places, len(rows.spans), axis=2)
    for (sensor, _), family in zip(rows.spans, families, strict=True):
        name = data.context.sensor_names[sensor]
        if name in located or noise_m[sensor] < LEAST_NOISE_M:
            continue
        found = explained_of_poses(rows, model, family, errors[:, :, 0])
        if found is None or found.p_value > significance:
            continue
        mean_square = np.mean(np.sum(pose_residuals[rows.group_sensor == sensor] ** 2, axis=1))
        size_m = float(np.sqrt(found.share * mean_square))
        yield Unexplained(
            where='sensor_frame',
            driver='position',
            size_m=size_m,
            p_value=found.p_value,
            next=(
                f'From pose to pose the errors follow the place in front of {the("sensor", name)} '
                f'more than chance would ({1e3 * size_m:.3f} mm RMS), but no cause stands out '
                'from all that were tried. '
                + (
                    'Measure more poses.'
                    if (sensor, name) not in data.context.sensors('controller')
                    else 'Measure the same poses with the sensor moved and turned: what follows '
                    'its volume is its own; or measure more poses.'
                )
            ),
        )


def compared_held_out(
    data: Residuals, solution: Solution, source: IntArray
) -> tuple[tuple[int, float, float], ...]:
    """Compare errors of held-out rows with errors of fitted poses left out of the fit in turn.

    Returns (kind of contrast, p-value, ratio of the typical errors) for each kind with enough
    poses, see `left_out.compared`; () without rows. ``source``: indices of the held-out rows,
    (m,), thinned to evenly spread poses if they are many.
    """
    measurements = data.context.measurements
    source = of_spread_poses(measurements, source)

    def contrasts(part: Residuals) -> Contrasts:
        columns = part.base, part.columns(solution.candidates), part.left(solution)[:, :, None]
        white = part.noise_model.whitened(np.concatenate(columns, axis=2), solution.noise)
        return Contrasts.of(part.rows, measurements, white)

    if len(source) == 0:
        return ()
    parts = contrasts(data), contrasts(data.only(source))
    return tuple(compared(*parts, solution.full_covariance))
