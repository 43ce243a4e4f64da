# SPDX-License-Identifier: Apache-2.0
"""Whether noise explains the error that a fit leaves, judged without the fitted noise.

The fitted noise is what the model leaves: it contains the errors of a tracker that was moved, of a
compliant joint, of a sensor with a wrong scale. Two figures depend less on the model's errors:
what the scatter of its frames leaves in their mean, which is the reading, and how far the errors
of the joint solutions of one pose differ, which the sensor measures at one place. Where no samples
show it, noise is no more than what an arm errs by that nobody has calibrated: nobody calibrates
arms with such an instrument, and a model that does not hold leaves errors of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.noise import MEDIAN_LENGTH
from remaster_ros.calibration.outliers import (
    CERTAIN,
    LARGEST_SHARE,
    gross_probability,
    robust_scale,
)
from remaster_ros.calibration.priors import UNCALIBRATED_ERROR_M
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements

# Errors that all solutions of a pose share belong to a sensor's noise as well: 0.5 mm beside
# 0.23 mm in the source paper, which makes the whole 2.4 times the scatter within poses.
MOST = 2.5
# A soft joint errs differently at each solution of a pose. Scatter within poses beyond this many
# times what the sensor states is not the sensor's, and an arm that repeats itself has no more.
SCATTER = 5.0
# The worst errors are left out of the comparison: single gross errors are named elsewhere.
WORST_SHARE = 0.05
LARGEST_SPREAD = 2.0
# Gross errors spoil a mean that is so many times the one without the worst.
SPOILT = 1.5
# Observations that a sentence lists.
LISTED = 5
MEAN_LENGTH = float(np.sqrt(8.0 / np.pi))
"""Mean length of a vector of three independent standard normal numbers."""


@dataclass(frozen=True)
class NoiseCheck:
    """The error that a fit leaves at one sensor, and what noise explains of it."""

    sensor: str  # Its name
    # Mean 3-D error on the rows judged, without the worst twentieth and without gross errors, m
    error_m: float
    # Standard deviation per axis of a reading (RMS) by the scatter of the samples that it is the
    # mean of, m; None where no reading has one
    stated_m: float | None
    # Standard deviation per axis of the errors within poses, m; None where no pose has two
    within_m: float | None
    poses: int  # That were judged. The mean of few may lie far from that of many.
    # How many times larger noise makes the error on held-out rows, as few poses determine the
    # parameters poorly; 1 on fitted rows
    spread: float = 1.0
    # ``observation`` of every held-out row that is a single gross error: no fit leaves those out.
    # None where so many are that a fit would refuse them: something changed there, or the model
    # does not hold.
    gross: tuple[int, ...] = ()
    mean_m: float = 0.0  # Mean 3-D error on all rows judged, gross ones too, m

    @property
    def spoilt(self) -> str:
        """What gross errors do to the held-out error, a sentence; '' where that is little."""
        if not self.gross or self.mean_m <= SPOILT * self.error_m:
            return ''
        listed = ', '.join(map(str, self.gross[:LISTED]))
        listed += ' …' if len(self.gross) > LISTED else ''
        are = (
            f'1 held-out reading of {self.sensor} is a gross error (observation {listed}) and '
            'makes up'
            if len(self.gross) == 1
            else f'{len(self.gross)} held-out readings of {self.sensor} are gross errors '
            f'(observation {listed}) and make up'
        )
        return (
            f'{are} most of its mean error of {1e3 * self.mean_m:.3f} mm; without them it is '
            f'{1e3 * self.error_m:.3f} mm. Compare the clocks of sensor and robot, and what was '
            'hidden or moved then.'
        )

    @property
    def noise_m(self) -> float | None:
        """Noise per axis that may be counted on, m; None where neither figure is known."""
        if self.stated_m is None or self.within_m is None:
            return self.stated_m if self.within_m is None else self.within_m
        return max(self.stated_m, min(self.within_m, SCATTER * self.stated_m))

    @property
    def noise_error_m(self) -> float | None:
        """Mean 3-D error that this noise makes on the rows judged, m."""
        return None if self.noise_m is None else MEAN_LENGTH * self.spread * self.noise_m

    @property
    def explained(self) -> bool | None:
        """Whether noise explains the error; None where the noise is unknown."""
        if self.is_of_no_instrument:
            return False
        if self.noise_error_m is None:
            return None
        return bool(self.error_m <= MOST * self._few * self.noise_error_m)

    @property
    def is_of_no_instrument(self) -> bool:
        """Whether the error is more than any instrument's that its own samples do not show."""
        most = MEAN_LENGTH * self.spread * self._few * UNCALIBRATED_ERROR_M
        shown = self.stated_m is not None and self.stated_m >= UNCALIBRATED_ERROR_M
        return bool(self.error_m > most) and not shown

    @property
    def no_instrument(self) -> str:
        """What that means, a sentence; '' of an error that is not so large."""
        if not self.is_of_no_instrument:
            return ''
        return (
            f'The error at {self.sensor} is {1e3 * self.error_m:.3f} mm, and no instrument that '
            'arms are measured with has such noise, nor do its own samples show it: an arm that '
            f'nobody has calibrated errs by {1e3 * UNCALIBRATED_ERROR_M:.0f} mm at most. Check '
            'that each point stands beside its own joints, that every marker turns with the tool '
            'and was not computed from another one, and that the URDF is that of this arm; of a '
            'table "remaster import" tells what it finds wrong, without --unchecked.'
        )

    @property
    def _few(self) -> float:
        """How much more the mean of few poses may be by chance."""
        return float(1.0 + 1.0 / np.sqrt(self.poses))


def check_noise(
    measurements: Measurements,
    sensor_names: Sequence[str],
    residuals: FloatArray,
    left_out: IntArray,
    parameters: int,
) -> tuple[NoiseCheck, ...]:
    """Compare what a fit leaves with the noise, sensor by sensor.

    ``measurements``: n observations. Those held out are judged where the sensor has any, else
    those fitted; ``sensor_names``: in index order; ``residuals``: measured minus modelled
    positions, m, (n, 3); ``left_out``: ``observation`` of every row that was not fitted;
    ``parameters``: how many were fitted, without those of the noise.
    """
    kept = ~np.isin(measurements.observation, left_out)
    spread = _spread(measurements.select(kept & ~measurements.is_validation), parameters)
    checks = []
    for index, name in enumerate(sensor_names):
        mine = kept & (measurements.sensor == index)
        if not mine.any():
            continue
        held_out = mine & measurements.is_validation
        judged = held_out if held_out.any() else mine
        errors = np.linalg.norm(residuals, axis=1)
        lengths = np.sort(errors[judged])
        gross = _gross(measurements, errors, held_out)
        most = len(lengths) - max(int(WORST_SHARE * len(lengths)), len(gross))
        checks.append(
            NoiseCheck(
                name,
                float(lengths[:most].mean()),
                _stated(measurements.select(mine)),
                _within(measurements, residuals, mine),
                len(np.unique(measurements.pose[judged])),
                spread if held_out.any() else 1.0,
                gross,
                float(lengths.mean()),
            )
        )
    return tuple(checks)


def _gross(measurements: Measurements, errors: FloatArray, rows: BoolArray) -> tuple[int, ...]:
    """Return the observations of the rows that are gross by the rule of the fit."""
    if not rows.any():
        return ()
    gross = gross_probability(errors[rows] / robust_scale(errors[rows])) > CERTAIN
    if gross.sum() > max(1.0, LARGEST_SHARE * len(gross)):
        return ()
    return tuple(measurements.observation[rows][gross].tolist())


def _spread(fitted: Measurements, parameters: int) -> float:
    """Return how many times the noise the error is where the parameters were not fitted.

    That of a linear model with the noise of poses: three numbers for each pose of each sensor and
    of each of its markers.
    """
    readings = np.unique(np.stack((fitted.pose, fitted.sensor, fitted.marker)), axis=1).shape[1]
    free = max(3 * readings - parameters - 1, 1)
    return float(np.sqrt(1.0 + min(parameters / free, LARGEST_SPREAD**2 - 1.0)))


def _stated(measurements: Measurements) -> float | None:
    """Return the RMS of the standard deviations of the readings, each a mean of its samples."""
    std = measurements.std / np.sqrt(np.maximum(measurements.samples, 1))[:, None]
    known = std[np.isfinite(std)]
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
    # A column of zeros stands for an unknown figure, not for a sensor without noise.
    return rms if rms > 0.0 else None


def _within(measurements: Measurements, residuals: FloatArray, rows: BoolArray) -> float | None:
    """Return the standard deviation per axis within poses, m, by the median over the rows.

    A sensor that was moved while one of the poses was visited does not count.
    """
    _, group = np.unique(
        np.stack((measurements.pose[rows], measurements.marker[rows])), axis=1, return_inverse=True
    )
    group = group.reshape(-1)
    size = np.bincount(group)
    mean = (
        np.stack([np.bincount(group, weights=column) for column in residuals[rows].T], axis=1)
        / size[:, None]
    )
    several = size[group] > 1
    if not several.any():
        return None
    apart = (residuals[rows] - mean[group])[several]
    count = size[group][several]
    # The mean of few lies nearer to each of them than the true one does.
    lengths = np.linalg.norm(apart, axis=1) * np.sqrt(count / (count - 1.0))
    return float(np.median(lengths)) / MEDIAN_LENGTH
