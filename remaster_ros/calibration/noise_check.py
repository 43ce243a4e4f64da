# SPDX-License-Identifier: Apache-2.0
"""Comparison of the error after a fit with the sensor's noise, without the fitted noise.

The fitted noise contains the errors that the model leaves: of a tracker that was moved, of a
compliant joint, of a sensor with a wrong scale. Two figures depend less on the model: the standard
error of a reading by the scatter of its samples, and the scatter of the errors of joint solutions
of one pose, which the sensor measures at one place. If no samples show it, noise is no more than
the error of an uncalibrated arm: nobody calibrates arms with a worse instrument, and a wrong model
leaves errors of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from remaster_ros.calibration.noise import MEDIAN_LENGTH
from remaster_ros.calibration.outliers import (
    CERTAIN,
    LARGEST_SHARE,
    gross_probability,
    robust_scale,
)
from remaster_ros.calibration.priors import UNCALIBRATED_ERROR_M
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements

# Largest ratio of the error to the noise within poses. Errors common to all solutions of a pose
# belong to the noise too: 0.5 mm to 0.23 mm in the source paper, together 2.4 times the scatter.
MOST = 2.5
# Largest ratio of the scatter within poses to the stated noise. A compliant joint has another
# error at each solution of a pose; scatter above this ratio is neither the sensor's nor that of an
# arm with usual repeatability.
SCATTER = 5.0
# Share of the worst errors that the comparison leaves out: gross errors are named elsewhere.
WORST_SHARE = 0.05
LARGEST_SPREAD = 2.0
# Ratio of the mean error to that without the worst errors from which gross errors are named.
SPOILT = 1.5
# Number of observations that a sentence lists.
LISTED = 5
MEAN_LENGTH = float(np.sqrt(8.0 / np.pi))
"""Mean length of a vector of three independent standard normal numbers."""


class NoiseCheck(Struct, frozen=True):
    """Error after a fit at one sensor, and whether noise explains it, as fit.json has it."""

    # Whether noise explains the error; None if the noise is unknown
    explained: bool | None
    # Mean 3-D error on the rows judged, without the worst twentieth and without gross errors, m
    after_m: float
    noise_m: float | None  # Mean 3-D error by the reliable noise on these rows, m
    # Standard deviation per axis of a reading (RMS) by the scatter of its samples, m; None if no
    # reading has samples
    stated_std_m: float | None
    # Standard deviation per axis of the errors within poses, m; None where no pose has two
    within_pose_std_m: float | None
    # ``observation`` of every held-out row with a single gross error: no fit leaves those out.
    # Empty if there are so many that a fit would refuse them: something changed between fitted
    # and held-out poses, or the model is wrong.
    gross: tuple[int, ...] = ()
    sensor: str = ''  # Name of the sensor
    poses: int = 1  # Number of poses judged; the mean of few may differ much from that of many
    # Ratio of the error on held-out rows to the noise: few poses determine the parameters poorly;
    # 1 on fitted rows
    spread: float = 1.0
    mean_m: float = 0.0  # Mean 3-D error on all rows judged, gross ones too, m

    @classmethod
    def of(
        cls, after_m: float, stated_m: float | None, within_m: float | None, **more: Any
    ) -> Self:
        """Comparison of an error with the noise; arguments as the attributes.

        ``explained`` is True for an error of at most 2.5 (`MOST`) times the mean length of the
        noise, with a factor for few poses; False for a larger one, or one that no instrument
        has (`is_of_no_instrument`); else None, if the noise is unknown.
        """
        check = cls(None, after_m, None, stated_m, within_m, **more)
        std, explained = check.noise_std_m, None
        noise_m = None if std is None else MEAN_LENGTH * check.spread * std
        if check.is_of_no_instrument:
            explained = False
        elif noise_m is not None:
            explained = bool(after_m <= MOST * check._few * noise_m)
        return replace(check, explained=explained, noise_m=noise_m)

    @property
    def spoilt(self) -> str:
        """Sentence on gross errors in the held-out rows; '' if their influence is small.

        Small: the mean error with them is at most 1.5 times (`SPOILT`) that without.
        """
        if not self.gross or self.mean_m <= SPOILT * self.after_m:
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
            f'{1e3 * self.after_m:.3f} mm. Compare the clocks of sensor and robot, and what was '
            'hidden or moved then.'
        )

    @property
    def noise_std_m(self) -> float | None:
        """Reliable standard deviation of the noise per axis, m; None if it is unknown.

        The larger of the stated one and that within poses, of which at most 5 times (`SCATTER`)
        the stated one counts; the known one if only one of these is known.
        """
        if self.stated_std_m is None or self.within_pose_std_m is None:
            return self.stated_std_m if self.within_pose_std_m is None else self.within_pose_std_m
        return max(self.stated_std_m, min(self.within_pose_std_m, SCATTER * self.stated_std_m))

    @property
    def is_of_no_instrument(self) -> bool:
        """Whether the error is larger than any instrument's, and the samples show no such noise.

        Larger: above 5 mm per axis (`UNCALIBRATED_ERROR_M`) as a mean length, times ``spread``
        and a factor for few poses.
        """
        most = MEAN_LENGTH * self.spread * self._few * UNCALIBRATED_ERROR_M
        shown = self.stated_std_m is not None and self.stated_std_m >= UNCALIBRATED_ERROR_M
        return bool(self.after_m > most) and not shown

    @property
    def no_instrument(self) -> str:
        """Sentence on an error that no instrument has; '' for a smaller error."""
        if not self.is_of_no_instrument:
            return ''
        return (
            f'The error at {self.sensor} is {1e3 * self.after_m:.3f} mm, and no instrument that '
            'arms are measured with has such noise, nor do its own samples show it: an arm that '
            f'nobody has calibrated errs by {1e3 * UNCALIBRATED_ERROR_M:.0f} mm at most. Check '
            'that each point stands beside its own joints, that every marker turns with the tool '
            'and was not computed from another one, and that the URDF is that of this arm; of a '
            'table "remaster import" tells what it finds wrong, without --unchecked.'
        )

    @property
    def _few(self) -> float:
        """Factor by which the mean of few poses may be larger by chance: 1 + 1 / √poses."""
        return float(1.0 + 1.0 / np.sqrt(self.poses))


def check_noise(
    measurements: Measurements,
    sensor_names: Sequence[str],
    residuals: FloatArray,
    left_out: IntArray,
    parameters: int,
) -> tuple[NoiseCheck, ...]:
    """Comparison of the error after a fit with the noise, for each sensor with rows that count.

    The worst twentieth of the rows, or the gross ones if more, is left out of the mean.
    ``measurements``: n observations; held-out rows are judged if the sensor has any, else fitted
    ones; ``sensor_names``: in index order; ``residuals``: measured minus modelled positions, m,
    (n, 3); ``left_out``: ``observation`` of every row that was not fitted; ``parameters``: number
    of fitted parameters, without those of the noise.
    """
    kept = ~np.isin(measurements.observation, left_out)
    spread = _spread(measurements.select(kept & ~measurements.is_validation), parameters)
    checks = []
    for index, name in enumerate(sensor_names):
        selection = kept & (measurements.sensor == index)
        if not selection.any():
            continue
        held_out = selection & measurements.is_validation
        judged = held_out if held_out.any() else selection
        errors = np.linalg.norm(residuals, axis=1)
        lengths = np.sort(errors[judged])
        gross = _gross(measurements, errors, held_out)
        most = len(lengths) - max(int(WORST_SHARE * len(lengths)), len(gross))
        checks.append(
            NoiseCheck.of(
                float(lengths[:most].mean()),
                _stated(measurements.select(selection)),
                _within(measurements, residuals, selection),
                gross=gross,
                sensor=name,
                poses=len(np.unique(measurements.pose[judged])),
                spread=spread if held_out.any() else 1.0,
                mean_m=float(lengths.mean()),
            )
        )
    return tuple(checks)


def _gross(measurements: Measurements, errors: FloatArray, rows: BoolArray) -> tuple[int, ...]:
    """Observation numbers of the rows that are gross with a probability above 99 % (`CERTAIN`).

    ``errors``: lengths, m, (n,); ``rows``: mask of those judged, (n,). () without rows, or if more
    than a tenth is gross (one always may be): then a fit would refuse them.
    """
    if not rows.any():
        return ()
    gross = gross_probability(errors[rows] / robust_scale(errors[rows])) > CERTAIN
    if gross.sum() > max(1.0, LARGEST_SHARE * len(gross)):
        return ()
    return tuple(measurements.observation[rows][gross].tolist())


def _spread(fitted: Measurements, parameters: int) -> float:
    """Ratio of the error at poses that were not fitted to the noise, by a linear model, 1 to 2.

    √(1 + p / (N - p - 1)) with p ``parameters`` and N numbers, three for each pose of each sensor
    and marker.
    """
    readings = np.unique(np.stack((fitted.pose, fitted.sensor, fitted.marker)), axis=1).shape[1]
    free = max(3 * readings - parameters - 1, 1)
    return float(np.sqrt(1.0 + min(parameters / free, LARGEST_SPREAD**2 - 1.0)))


def _stated(measurements: Measurements) -> float | None:
    """RMS of the standard errors of the readings per axis, by the scatter of their samples, m.

    None if no reading has a scatter, or if all are 0, which stands for an unknown one.
    """
    std = measurements.std / np.sqrt(np.maximum(measurements.samples, 1))[:, None]
    known = std[np.isfinite(std)]
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
    # A column of zeros stands for an unknown figure, not for a sensor without noise.
    return rms if rms > 0.0 else None


def _within(measurements: Measurements, residuals: FloatArray, rows: BoolArray) -> float | None:
    """Standard deviation per axis of the errors within poses, m, by the median over the rows.

    ``rows``: mask of one sensor's rows, (n,). Rows of one pose and marker are compared; None if no
    pose has two. A sensor that was moved during a pose does not influence the median.
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
    differences = (residuals[rows] - mean[group])[several]
    count = size[group][several]
    # The mean of few errors is nearer to each of them than the true mean.
    lengths = np.linalg.norm(differences, axis=1) * np.sqrt(count / (count - 1.0))
    return float(np.median(lengths)) / MEDIAN_LENGTH
