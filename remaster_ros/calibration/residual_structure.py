# SPDX-License-Identifier: Apache-2.0
"""Omnibus test for structure in the residuals of a fit.

The residuals at the mode, in units of the noise, are two independent parts: the means of each
sensor's rows at a pose, and the deviations from these means. In each part the model's own columns
are projected out, and an F test shows whether a family of smooth functions (`smooth_functions`)
explains more of the remainder than noise would: functions of each sensor's position and time, and
of the joint angles. With too few poses for a whole family, its simplest functions are tested. Two
more tests show whether one reading resembles the next: from pose to pose, and within the poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.noise_check import NoiseCheck
from remaster_ros.calibration.smooth_functions import (
    HARMONICS,
    POSITION_DEGREE,
    TIME_DEGREE,
    by_sensor,
    of_joint_angles,
    of_joint_times,
    of_links,
    of_position,
    of_time,
    spread_poses,
    whitened,
)
from remaster_ros.types import FloatArray, Measurements

# Probability of a false alarm in any of the tests, with noise as in the model.
FAMILY_WISE_ERROR = 0.01
# Fewest remaining degrees of freedom for each function of a family that is tested.
LEAST_REST = 2.0
# Length, of functions with unit length, below which a direction outside the model's columns counts
# as the model's own: a rotation of the sensor is a function of measured and modelled positions.
ABSORBED = 0.03
FEWEST_POSES = 12
# Degree of the polynomials, and number of harmonics, with enough poses.
LARGEST = {
    'position': POSITION_DEGREE,
    'time': TIME_DEGREE,
    'joint_angle': HARMONICS,
    'joint_time': TIME_DEGREE,
    'link': 1,
    'axis': 1,
}
OF_THE_ARM = ('joint_angle', 'joint_time', 'link', 'axis')
# Simulated readings without noise leave rounding errors, which have structure.
LEAST_NOISE_M = 1e-6


class StructureTest(Struct, frozen=True):
    """One test of the residuals, as fit.json has it."""

    # What the residuals were compared with: 'position', 'time', 'joint_angle', zero-offsets by
    # 'joint_time', displacements of a 'link' and tilts of an 'axis' that are constant in their
    # frames, 'reading_before'; 'orientation' if measured orientations give other offsets;
    # 'held_out' if residuals on held-out poses were compared with those on left-out poses
    driver: str
    between_poses: bool  # True for the means of the poses, False for the deviations from them
    p_value: float  # Probability of as much structure by chance
    sensor: str = ''  # Name of the sensor; '' for all sensors
    # For 'held_out': ratio of the typical errors, each in units of its standard deviation
    ratio: float | None = None
    found: bool = False  # Whether it is significant among all tests; set when it is written

    @property
    def chance(self) -> str:
        """Probability by chance as text: 'p = 0.0123', or 'p < 0.0001'."""
        return 'p < 0.0001' if self.p_value < 1e-4 else f'p = {self.p_value:.4f}'

    def words(self, timed: bool = True) -> str:
        """Clause on what the test shows: 'the error of tracker follows time within the poses'.

        Of 'held_out': by what factor the error on held-out poses is larger than on poses left
        out of the fit. ``timed``: whether readings have times; else it says 'the order of the
        rows' in place of time.
        """
        where = 'from pose to pose' if self.between_poses else 'within the poses'
        of_sensor = f' of {self.sensor}' if self.sensor else ''
        if self.driver == 'held_out':
            return (
                f'on held-out poses the error{of_sensor} {where} is {self.ratio:.1f} times '
                'as large as on poses left out of the fit: something changed between them, or the '
                'model does not hold where they lie'
            )
        time = 'time' if timed else 'the order of the rows'
        what = {
            'position': 'follows the position in front of the sensor',
            'time': f'follows {time}',
            'joint_angle': "follows the joints' angles",
            'joint_time': f'looks like that of zero-offsets that change with {time}',
            'link': 'looks like that of links of other lengths',
            'axis': 'looks like that of tilted axes',
            'reading_before': 'resembles that of the reading before',
            'orientation': 'differs between positions and orientations, which fit other offsets',
        }[self.driver]
        return f'the error{of_sensor} {what} {where}'


@dataclass(frozen=True)
class ResidualStructure:
    """All tests; empty if there are far too few poses, or readings without noise."""

    tests: tuple[StructureTest, ...]  # All tests that were made
    too_few: bool = False  # Whether there are too few poses for reliable tests

    @property
    def found(self) -> tuple[StructureTest, ...]:
        """Significant tests, smallest p-value first: p below 0.01 over the number of tests."""
        limit = FAMILY_WISE_ERROR / max(1, len(self.tests))
        return tuple(
            sorted((t for t in self.tests if t.p_value < limit), key=lambda test: test.p_value)
        )


def errors_are_left(checks: Sequence[NoiseCheck], structure: ResidualStructure | None) -> bool:
    """Whether the residuals have structure, or exceed the known noise of a sensor.

    ``structure``: None if it was not tested.
    """
    unexplained = any(check.explained is False for check in checks)
    return unexplained or (structure is not None and bool(structure.found))


def residual_structure(mode: Mode, measurements: Measurements) -> ResidualStructure:
    """Tests of the residuals of a fit at its mode.

    No tests if all noise is below 1 µm (`LEAST_NOISE_M`) or there are fewer than 12 poses of
    sensors. ``mode``: of the posterior of the fitted rows; ``measurements``: source of the rows,
    whose ``stamp_s`` gives their order.
    """
    posterior = mode.linearisation.posterior
    rows = spread_poses(posterior.rows)
    if np.all(posterior.noise(mode.eta).sigma < LEAST_NOISE_M):
        return ResidualStructure(())
    too_few = len(np.unique(measurements.pose[rows.source])) < FEWEST_POSES
    if len(rows.group_start) < FEWEST_POSES:
        return ResidualStructure((), too_few)
    seconds = measurements.stamp_s[rows.source]
    families = _families(mode, rows, seconds)
    white = whitened(mode, rows, families)
    size = rows.group_size[:, None, None]
    middle = {name: rows.group_sum(part) / size for name, part in white.items()}
    deviations = {
        name: _deviations(part, middle[name][rows.group_of_row]) for name, part in white.items()
    }
    between = {name: _flat(part * np.sqrt(size)) for name, part in middle.items()}
    within = {name: _flat(part) for name, part in deviations.items()}
    basis = _basis(between['model'])
    remainder = _without(basis, between['errors'])
    sensors = [posterior.model.sensor_names[sensor] for sensor, _ in rows.spans]
    pairs = [*((driver, '') for driver in OF_THE_ARM)]
    pairs += itertools.product(('position', 'time'), sensors)
    tests = [_explained(driver, sensor, between, remainder, basis) for driver, sensor in pairs]
    tests.append(_from_pose_to_pose(remainder, basis, rows, seconds))
    if np.any(rows.group_size > 1):
        basis = _basis(within['model'])
        remainder = _without(basis, within['errors'])
        # The deviations from the mean of n rows are n - 1 independent numbers.
        dependent = 3 * len(rows.group_start)
        tests += [
            _explained(driver, '', within, remainder, basis, dependent) for driver in OF_THE_ARM
        ]
        tests.append(_within_poses(remainder.reshape(-1, 3), rows, seconds))
    return ResidualStructure(tuple(test for test in tests if test is not None), too_few)


def _families(mode: Mode, rows: Rows, seconds: FloatArray) -> dict[str, FloatArray]:
    """Columns (n, 3, c) of smooth functions for each driver and degree, by `_family_key`.

    A driver is a quantity that the errors may depend on: the joints' angles or times, links,
    axes; and, for each sensor separately, position and time. ``seconds``: times of the rows, s,
    (n,).
    """
    names = mode.linearisation.posterior.model.sensor_names
    families = {
        _family_key('joint_angle', '', degree): of_joint_angles(mode, rows, degree)
        for degree in range(1, LARGEST['joint_angle'] + 1)
    }
    for degree in range(1, LARGEST['joint_time'] + 1):
        columns = of_joint_times(mode, rows, seconds, degree)
        families[_family_key('joint_time', '', degree)] = columns
    for driver, columns in zip(('link', 'axis'), of_links(mode, rows), strict=True):
        families[_family_key(driver, '', 1)] = columns
    for driver, of_driver in (
        ('position', lambda degree: of_position(rows, degree)),
        ('time', lambda degree: of_time(rows, seconds, degree)),
    ):
        for degree in range(1, LARGEST[driver] + 1):
            for sensor, columns in by_sensor(rows, of_driver(degree)).items():
                families[_family_key(driver, names[sensor], degree)] = columns
    return families


def _family_key(driver: str, sensor: str, degree: int) -> str:
    """Key in `_families` of a driver's functions, '<driver> <degree> <sensor>'.

    ``sensor``: its name, '' for functions of the joints, common to all sensors.
    """
    return f'{driver} {degree} {sensor}'


def _deviations(columns: FloatArray, middle: FloatArray) -> FloatArray:
    """Deviations (n, 3, c) of columns from the means of their poses, ``middle``, (n, 3, c).

    If a pose is one configuration measured repeatedly, all quantities that the joints
    determine are equal in its rows: the deviations are rounding and set to zero.
    """
    deviations = columns - middle
    rounding = 1e-9 * np.linalg.norm(columns, axis=(0, 1))
    deviations[:, :, np.linalg.norm(deviations, axis=(0, 1)) <= rounding] = 0.0
    return deviations


def _flat(columns: FloatArray) -> FloatArray:
    """Columns (n, 3, c) as (3 n, c)."""
    return columns.reshape(-1, columns.shape[2])


def _basis(columns: FloatArray) -> FloatArray:
    """Orthonormal basis (n, b) of columns (n, c) of any lengths; b is their rank."""
    length = np.linalg.norm(columns, axis=0)
    kept = length > 1e-12 * np.max(length, initial=0.0)
    directions, singular, _ = np.linalg.svd(columns[:, kept] / length[kept], full_matrices=False)
    basis: FloatArray = directions[:, singular > 1e-9 * np.max(singular, initial=0.0)]
    return basis


def _without(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns (n, c) less their projection on a basis (n, b)."""
    remainder: FloatArray = columns - basis @ (basis.T @ columns)
    return remainder


def _explained(
    driver: str,
    sensor: str,
    columns: Mapping[str, FloatArray],
    remainder: FloatArray,
    basis: FloatArray,
    dependent: int = 0,
) -> StructureTest | None:
    """Test whether a driver's functions explain the remainder (n, 1) after the model's columns.

    The functions of the highest degree with enough rows; None if there are too few rows for any
    degree. ``driver``: as of `StructureTest`; ``sensor``: its name, '' for all; ``columns``: by
    `_family_key`; ``basis``: of the model's columns, (n, b); ``dependent``: how many of the n
    numbers depend on the others: 0 for means of poses.
    """
    for degree in range(LARGEST[driver], 0, -1):
        found = _f_test(columns[_family_key(driver, sensor, degree)], remainder, basis, dependent)
        if found is not None:
            return StructureTest(driver, dependent == 0, found.p_value, sensor)
    return None


class Explained(NamedTuple):
    """P-value of an F test, and the share of squares that a family of functions explains."""

    p_value: float  # Probability of as much by chance
    # Explained share of the sum of squares after the model, in the rows with functions that are
    # not zero, less the share of noise that the functions explain
    share: float


def explained_of_poses(
    rows: Rows, model: FloatArray, family: FloatArray, errors: FloatArray
) -> Explained | None:
    """Test whether functions explain the means of the poses in addition to the model's columns.

    ``model, family, errors``: in units of the noise, (n, 3, c), (n, 3, f) and (n, 3). None if
    there are too many functions for the poses.
    """

    def of_poses(columns: FloatArray) -> FloatArray:
        size = rows.group_size[:, None, None]
        return _flat(rows.group_sum(columns) / np.sqrt(size))

    basis = _basis(of_poses(model))
    return _f_test(of_poses(family), _without(basis, of_poses(errors[:, :, None])), basis)


def _f_test(
    family: FloatArray, remainder: FloatArray, basis: FloatArray, dependent: int = 0
) -> Explained | None:
    """Test whether columns (n, c) explain the remainder (n, 1) in addition to a basis (n, b).

    None if the basis contains them all, or fewer than 2 degrees of freedom are left for each
    (`LEAST_REST`). ``dependent``: how many of the n numbers are not independent of the others.
    """
    length = np.linalg.norm(family, axis=0)
    directions, singular, _ = np.linalg.svd(
        _without(basis, family / np.where(length > 0.0, length, 1.0)), full_matrices=False
    )
    functions = directions[:, singular > ABSORBED]
    freedom = len(remainder) - dependent - basis.shape[1] - functions.shape[1]
    if functions.shape[1] == 0 or freedom < LEAST_REST * functions.shape[1]:
        return None
    explained, total = float(np.sum((functions.T @ remainder) ** 2)), float(np.sum(remainder**2))
    variance = (total - explained) / freedom
    ratio = explained / functions.shape[1] / variance
    concerned = float(np.sum(remainder[np.any(family != 0.0, axis=1)] ** 2))
    share = max(0.0, explained - functions.shape[1] * variance) / concerned
    return Explained(float(scipy.special.fdtrc(functions.shape[1], freedom, ratio)), share)


def _from_pose_to_pose(
    remainder: FloatArray, basis: FloatArray, rows: Rows, seconds: FloatArray
) -> StructureTest | None:
    """Test whether the mean error of a pose resembles that of the poses before and after it.

    Poses of each sensor are in order of time (``seconds`` of the rows, (n,)). None if the
    model's parameters leave fewer than two degrees of freedom. ``remainder``: means of g poses
    less what the model's columns explain, (3 g, 1); ``basis``: of these columns, (3 g, b).

    The remainder is M e with a projection M. Of the ratio e' M A M e / e' M e, where A e is
    half the sum of the errors of both neighbours, mean and variance follow from traces; its
    distribution is nearly a beta distribution (Durbin and Watson 1951,
    doi:10.1093/biomet/38.1-2.159).
    """
    time = rows.group_sum(seconds) / rows.group_size
    order = np.lexsort((time, rows.group_sensor))
    neighbours = np.diff(rows.group_sensor[order], prepend=-1) == 0

    def shifted(columns: FloatArray) -> FloatArray:
        """A times columns (3 g, c): half the sum of both neighbours' columns."""
        blocks = columns.reshape(len(order), 3, -1)[order]
        result = np.zeros_like(blocks)
        result[1:] += blocks[:-1] * neighbours[1:, None, None]
        result[:-1] += blocks[1:] * neighbours[1:, None, None]
        back = np.empty_like(result)
        back[order] = 0.5 * result
        return back.reshape(columns.shape)

    along = shifted(basis)
    small = basis.T @ along
    freedom = len(remainder) - basis.shape[1]
    if freedom < 2:
        return None
    first = -float(np.trace(small))
    second = 1.5 * int(np.sum(neighbours)) - 2.0 * np.sum(along**2) + np.sum(small * small.T)
    mean = first / freedom
    variance = 2.0 * (freedom * second - first**2) / (freedom**2 * (freedom + 2.0))
    ratio = float(np.sum(remainder * shifted(remainder)) / np.sum(remainder**2))
    # From -1 to 1.
    middle = 0.5 * (mean + 1.0)
    precision = middle * (1.0 - middle) / (0.25 * variance) - 1.0
    p_value = scipy.special.betainc(
        (1.0 - middle) * precision, middle * precision, 0.5 * (1.0 - ratio)
    )
    return StructureTest('reading_before', True, float(p_value))


def _within_poses(errors: FloatArray, rows: Rows, seconds: FloatArray) -> StructureTest | None:
    """Test whether the deviation of a reading resembles that of the one before at the same pose.

    In random order the sum of the products of neighbours of n deviations d is -Σ d² / n on
    average; a t test over the poses with more than two rows, None if they are fewer than 12.
    ``errors``: deviations in units of the noise, (n, 3).
    """
    group = rows.group_of_row
    order = np.lexsort((seconds, group))
    product = np.sum(errors[order][1:] * errors[order][:-1], axis=1)
    product[np.diff(group[order]) != 0] = 0.0
    chained = np.bincount(group[order][1:], product, len(rows.group_size))
    squares = rows.group_sum(np.sum(errors**2, axis=1))
    several = rows.group_size > 2
    if np.sum(several) < FEWEST_POSES:
        return None
    excess = (chained + squares / rows.group_size)[several]
    score = excess.mean() / (excess.std(ddof=1) / np.sqrt(len(excess)))
    p_value = float(scipy.special.stdtr(len(excess) - 1, -score))
    return StructureTest('reading_before', False, p_value)
