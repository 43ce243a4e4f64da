"""Is any structure left? Checks after the search, of what no cause explains.

Smooth structure over the place in a sensor's volume and over time competes in the search itself
(the effects without a cause), against all that is tried there; what is too weak to win may still
be more than chance where the place alone is asked for (`errors_by_place`). Then follow readings of
another configuration, held-out poses with larger errors than poses left out of the fit in turn,
and errors beyond the accuracy that a sensor states. Single gross errors are no structure: they are
listed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.errors_by_place import errors_by_place
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.gain import GROSS, rms
from remaster_ros.discovery.guard import Unexplained
from remaster_ros.discovery.held_out_poses import compare_held_out
from remaster_ros.discovery.moved_meanwhile import far_off, moved_text
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Of one check where nothing is wrong.
SIGNIFICANCE = 0.001
# Fewer readings of another configuration may be chance or carelessness.
FEWEST_MISPAIRED = 2
# Gross errors that are compared with the places of all rows.
MOST_COMPARED = 200
# Observations that a sentence lists.
LISTED = 5


def structure_left(
    data: Residuals,
    solution: Solution,
    fit: FitResult,
    located: Sequence[FoundEffect],
) -> tuple[tuple[Unexplained, ...], tuple[tuple[int, str], ...]]:
    """Return all structure that no cause explains, and the gross errors among held-out rows.

    Parameters
    ----------
    data, solution
        What the search worked on, and what is in the model.
    fit
        The sampled fit with it.
    located
        Structure without a cause that the search found.

    Returns
    -------
    unexplained
        The structure.
    gross
        (observation, what is wrong) of every held-out row.
    """
    checks = _Checks(data, solution, fit)
    unexplained = (
        *(
            Unexplained(found.place, found.driver, found.size_m, found.p_value, found.cause)
            for found in located
        ),
        *errors_by_place(data, solution, SIGNIFICANCE),
        *checks.pairing(),
        *far_off(data.context, checks.errors, checks.gross & ~checks.mispaired),
        *checks.held_out(),
        *checks.beyond_stated(),
    )
    return unexplained, tuple(checks.gross_held_out())


@dataclass(frozen=True, eq=False)
class _Checks:
    """The checks of one session of n rows."""

    data: Residuals
    solution: Solution
    fit: FitResult

    @property
    def errors(self) -> FloatArray:
        """Measured minus modelled positions in the sensor frames, m, (n, 3)."""
        return self.fit.residuals_after

    @cached_property
    def limit(self) -> FloatArray:
        """Length from which on the error of a row is gross, m, (n,)."""
        noise = self.data.noise_model.sensor_noise(self.solution.noise)
        limit: FloatArray = GROSS * noise.total
        return limit[self.data.context.sensor]

    @cached_property
    def gross(self) -> BoolArray:
        """Rows that were set aside, or have an error that large, (n,)."""
        left_out = [observation for observation, _ in self.fit.left_out]
        gross: BoolArray = np.isin(self.data.context.measurements.observation, left_out)
        return gross | (np.linalg.norm(self.errors, axis=1) > self.limit)

    @cached_property
    def predicted(self) -> FloatArray:
        """Modelled positions in the sensor frames, m, (n, 3)."""
        return self.data.context.measurements.position - self.errors

    @cached_property
    def mispaired(self) -> BoolArray:
        """Gross rows that lie where the marker was at the configuration before or after, (n,)."""
        measurements = self.data.context.measurements
        near = np.zeros(len(measurements), bool)
        for rows in self._series():
            for one, other in ((rows[1:], rows[:-1]), (rows[:-1], rows[1:])):
                away = np.linalg.norm(measurements.position[one] - self.predicted[other], axis=1)
                # All configurations of a pose have the marker near one place.
                apart = measurements.pose[one] != measurements.pose[other]
                near[one] |= apart & (away < self.limit[one])
        return near & self.gross

    def _series(self) -> Iterator[IntArray]:
        """Give the rows of each marker that each sensor measured, in the order of time."""
        context = self.data.context
        for sensor in range(len(context.sensor_names)):
            for marker in range(len(context.marker_names)):
                rows = np.flatnonzero((context.sensor == sensor) & (context.marker == marker))
                yield rows[np.argsort(context.elapsed_s[rows], kind='stable')]

    def pairing(self) -> Iterator[Unexplained]:
        """Readings that belong to another configuration."""
        count = int(self.mispaired.sum())
        if count < FEWEST_MISPAIRED:
            return
        measurements = self.data.context.measurements
        gross = np.flatnonzero(self.gross)
        # That a gross error ends by chance within the limit of one of two places: as often as it
        # lies within it of the places of other poses.
        some = gross[:: 1 + len(gross) // MOST_COMPARED].tolist()
        chance = min(1.0, 2.0 * np.mean([self._share_near(row) for row in some]))
        p_value = float(scipy.stats.binom.sf(count - 1, len(gross), chance))
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
        """Return the share of places of other poses that a reading lies near, at least one's."""
        measurements = self.data.context.measurements
        others = (measurements.sensor == measurements.sensor[row]) & (
            measurements.pose != measurements.pose[row]
        )
        away = np.linalg.norm(self.predicted[others] - measurements.position[row], axis=1)
        return float((1 + np.sum(away < self.limit[row])) / (1 + len(away)))

    def gross_held_out(self) -> Iterator[tuple[int, str]]:
        """Give the gross errors among the held-out rows, which no fit leaves out."""
        measurements = self.data.context.measurements
        for row in np.flatnonzero(self.gross & measurements.is_validation).tolist():
            length = float(np.linalg.norm(self.errors[row]))
            yield int(measurements.observation[row]), f'held out, off by {1e3 * length:.1f} mm'

    def held_out(self) -> Iterator[Unexplained]:
        """Held-out poses with larger errors than poses that were left out of the fit in turn."""
        data = self.data
        held_out = data.context.measurements.is_validation & ~self.gross
        compared = compare_held_out(data, self.solution, np.flatnonzero(held_out))
        if compared is None or compared.p_value > SIGNIFICANCE:
            return
        moved = [
            text
            for sensor in range(len(data.context.sensor_names))
            if (text := moved_text(data.context, self.errors, sensor))
        ]
        yield Unexplained(
            where='held_out_poses',
            driver='time' if moved else 'unknown',
            size_m=rms(self.errors, held_out),
            p_value=compared.p_value,
            next=' '.join(
                [
                    f'The errors on the held-out poses are {compared.ratio:.1f} times those on '
                    'poses left out of the fit in turn, both in units of what is uncertain of '
                    'their prediction: what is held out lies elsewhere, or something changed in '
                    'between.',
                    *(moved or ['Compare where and when the two were measured.']),
                ]
            ),
        )

    def beyond_stated(self) -> Iterator[Unexplained]:
        """Errors larger than what the sensor itself states allows."""
        for check in self.fit.noise_checks:
            if check.stated_m is None or check.explained is not False:
                continue
            stating = the('sensor', check.sensor)
            yield Unexplained(
                where='noise',
                driver='stated_std',
                size_m=check.error_m,
                p_value=np.nan,
                next=(
                    f'{stating[:1].upper()}{stating[1:]} states {1e3 * check.stated_m:.3f} mm per '
                    f'axis for a reading, but the mean error is {1e3 * check.error_m:.3f} mm: '
                    'the arm does not repeat itself so well, the sensor is worse than it states, '
                    'or a cause is missing. Measure one pose twenty times, coming from elsewhere '
                    'each time.'
                ),
            )
