# SPDX-License-Identifier: Apache-2.0
"""Is any structure left in the residuals of a fit? A light omnibus test.

The residuals at the mode, in units of the noise, fall into two independent parts: the means of
each sensor's rows at a pose, and the deviations from these. In each part the model's own columns
are projected out, and an F test asks whether a family of smooth functions (`smooth_functions`)
explains more of the rest than noise would: of each sensor's position and time, of the joints'
angles. Where there are too few poses for all of a family, its simplest functions are tested. Two
more tests ask whether one reading resembles the next: pose after pose, and within the poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

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

# Of all tests together, where noise is as the model has it.
FAMILY_WISE_ERROR = 0.01
# A family of functions is tested where so many times its number remain to judge the noise by.
LEAST_REST = 2.0
# Of functions of unit length, directions shorter than this beside the model's are the model's own:
# a turn of the sensor is a function of the measured as of the modelled position.
ABSORBED = 0.03
FEWEST_POSES = 12
# Degree of the polynomials, and number of harmonics, where there are poses enough.
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


@dataclass(frozen=True)
class StructureTest:
    """One of the tests."""

    # What the residuals were held against: 'position', 'time', 'joint_angle', zero-offsets by
    # 'joint_time', displacements of a 'link' and tilts of an 'axis' that are constant in their
    # frames, 'reading_before'; 'orientation' where measured orientations ask for other offsets;
    # 'held_out' where those on held-out poses were held against those on poses left out
    driver: str
    between_poses: bool  # Whether in the means of the poses or in the deviations from them
    p_value: float  # Of so much or more by chance
    sensor: str = ''  # Whose; '' where that of all
    # Of 'held_out': of the typical errors, each in units of what is uncertain of it
    ratio: float | None = None

    @property
    def chance(self) -> str:
        """How probable so much is by chance, for people."""
        return 'p < 0.0001' if self.p_value < 1e-4 else f'p = {self.p_value:.4f}'

    def words(self, timed: bool = True) -> str:
        """Return what the residuals follow, for people; ``timed``: whether there are times."""
        where = 'from pose to pose' if self.between_poses else 'within the poses'
        whose = f' of {self.sensor}' if self.sensor else ''
        if self.driver == 'held_out':
            return (
                f'on held-out poses the error{whose} {where} is {self.ratio:.1f} times '
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
        return f'the error{whose} {what} {where}'


@dataclass(frozen=True)
class ResidualStructure:
    """All of the tests; none where there are far too few poses, or readings without noise."""

    tests: tuple[StructureTest, ...]  # All that were made
    too_few: bool = False  # Whether there are too few poses to rely on them

    @property
    def found(self) -> tuple[StructureTest, ...]:
        """Return the tests that fire, the clearest first."""
        limit = FAMILY_WISE_ERROR / max(1, len(self.tests))
        return tuple(
            sorted((t for t in self.tests if t.p_value < limit), key=lambda test: test.p_value)
        )


def errors_are_left(checks: Sequence[NoiseCheck], structure: ResidualStructure | None) -> bool:
    """Return whether the residuals have structure, or are more than the noise that is known."""
    unexplained = any(check.explained is False for check in checks)
    return unexplained or (structure is not None and bool(structure.found))


def residual_structure(mode: Mode, measurements: Measurements) -> ResidualStructure:
    """Test the residuals of a fit at its mode.

    Parameters
    ----------
    mode
        Of the posterior of the rows fitted.
    measurements
        That the rows were taken from; their ``stamp_s`` tells which came first.
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
    apart = {name: _apart(part, middle[name][rows.group_of_row]) for name, part in white.items()}
    between = {name: _flat(part * np.sqrt(size)) for name, part in middle.items()}
    within = {name: _flat(part) for name, part in apart.items()}
    basis = _basis(between['model'])
    rest = _without(basis, between['errors'])
    sensors = [posterior.model.sensor_names[sensor] for sensor, _ in rows.spans]
    asked = [*((driver, '') for driver in OF_THE_ARM)]
    asked += itertools.product(('position', 'time'), sensors)
    tests = [_explained(driver, sensor, between, rest, basis) for driver, sensor in asked]
    tests.append(_from_pose_to_pose(rest, basis, rows, seconds))
    if np.any(rows.group_size > 1):
        basis = _basis(within['model'])
        rest = _without(basis, within['errors'])
        # The deviations from the mean of n rows are n - 1 independent numbers.
        lost = 3 * len(rows.group_start)
        tests += [_explained(driver, '', within, rest, basis, lost) for driver in OF_THE_ARM]
        tests.append(_within_poses(rest.reshape(-1, 3), rows, seconds))
    return ResidualStructure(tuple(test for test in tests if test is not None), too_few)


def _families(mode: Mode, rows: Rows, seconds: FloatArray) -> dict[str, FloatArray]:
    """Return the functions of every driver, of a sensor's for itself, and of every degree."""
    names = mode.linearisation.posterior.model.sensor_names
    families = {
        _named('joint_angle', '', degree): of_joint_angles(mode, rows, degree)
        for degree in range(1, LARGEST['joint_angle'] + 1)
    }
    for degree in range(1, LARGEST['joint_time'] + 1):
        columns = of_joint_times(mode, rows, seconds, degree)
        families[_named('joint_time', '', degree)] = columns
    for driver, columns in zip(('link', 'axis'), of_links(mode, rows), strict=True):
        families[_named(driver, '', 1)] = columns
    for driver, of_driver in (
        ('position', lambda degree: of_position(rows, degree)),
        ('time', lambda degree: of_time(rows, seconds, degree)),
    ):
        for degree in range(1, LARGEST[driver] + 1):
            for sensor, columns in by_sensor(rows, of_driver(degree)).items():
                families[_named(driver, names[sensor], degree)] = columns
    return families


def _named(driver: str, sensor: str, degree: int) -> str:
    return f'{driver} {degree} {sensor}'


def _apart(columns: FloatArray, middle: FloatArray) -> FloatArray:
    """Return the deviations (n, 3, c) of columns from the means of their poses.

    Where a pose is one configuration measured again, all that the joints determine is the same in
    its rows: what is left of a column is rounding, and no function.
    """
    apart = columns - middle
    rounding = 1e-9 * np.linalg.norm(columns, axis=(0, 1))
    apart[:, :, np.linalg.norm(apart, axis=(0, 1)) <= rounding] = 0.0
    return apart


def _flat(columns: FloatArray) -> FloatArray:
    return columns.reshape(-1, columns.shape[2])


def _basis(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of columns (n, c), (n, b), of whatever lengths."""
    length = np.linalg.norm(columns, axis=0)
    kept = length > 1e-12 * np.max(length, initial=0.0)
    left, singular, _ = np.linalg.svd(columns[:, kept] / length[kept], full_matrices=False)
    basis: FloatArray = left[:, singular > 1e-9 * np.max(singular, initial=0.0)]
    return basis


def _without(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Return columns (n, c) less what they have in common with a basis (n, b)."""
    rest: FloatArray = columns - basis @ (basis.T @ columns)
    return rest


def _explained(
    driver: str,
    sensor: str,
    columns: Mapping[str, FloatArray],
    rest: FloatArray,
    basis: FloatArray,
    lost: int = 0,
) -> StructureTest | None:
    """Test whether the columns of a driver explain the rest (n, 1) that the model's leave.

    Those of the highest degree for which there are rows enough; None where there are for none.
    """
    for degree in range(LARGEST[driver], 0, -1):
        found = _f_test(columns[_named(driver, sensor, degree)], rest, basis, lost)
        if found is not None:
            return StructureTest(driver, lost == 0, found.p_value, sensor)
    return None


class Explained(NamedTuple):
    """What a family of functions explains of the means of the poses."""

    p_value: float  # Of so much or more by chance
    # Of the sum of squares that the model leaves in the rows where the functions are not zero,
    # less what they explain of noise
    share: float


def explained_of_poses(
    rows: Rows, model: FloatArray, family: FloatArray, errors: FloatArray
) -> Explained | None:
    """Test whether functions explain the means of the poses beside the model's columns.

    Parameters
    ----------
    rows
        n rows.
    model, family, errors
        In units of the noise, (n, 3, c), (n, 3, f) and (n, 3).

    Returns
    -------
    Explained or None
        None where there are too many functions for the poses.
    """

    def of_poses(columns: FloatArray) -> FloatArray:
        size = rows.group_size[:, None, None]
        return _flat(rows.group_sum(columns) / np.sqrt(size))

    basis = _basis(of_poses(model))
    return _f_test(of_poses(family), _without(basis, of_poses(errors[:, :, None])), basis)


def _f_test(
    family: FloatArray, rest: FloatArray, basis: FloatArray, lost: int = 0
) -> Explained | None:
    """Test whether columns (n, c) explain the rest (n, 1) beside a basis (n, b).

    ``lost`` of the n numbers are not independent of the others.
    """
    length = np.linalg.norm(family, axis=0)
    left, singular, _ = np.linalg.svd(
        _without(basis, family / np.where(length > 0.0, length, 1.0)), full_matrices=False
    )
    own = left[:, singular > ABSORBED]
    freedom = len(rest) - lost - basis.shape[1] - own.shape[1]
    if own.shape[1] == 0 or freedom < LEAST_REST * own.shape[1]:
        return None
    explained, total = float(np.sum((own.T @ rest) ** 2)), float(np.sum(rest**2))
    variance = (total - explained) / freedom
    ratio = explained / own.shape[1] / variance
    concerned = float(np.sum(rest[np.any(family != 0.0, axis=1)] ** 2))
    share = max(0.0, explained - own.shape[1] * variance) / concerned
    return Explained(float(scipy.special.fdtrc(own.shape[1], freedom, ratio)), share)


def _from_pose_to_pose(
    rest: FloatArray, basis: FloatArray, rows: Rows, seconds: FloatArray
) -> StructureTest:
    """Test whether the mean error of a pose resembles that of the pose before.

    The rest is M e with a projection M. Of the ratio e' M A M e / e' M e, A being half the sum of
    either neighbour, mean and variance follow from traces; its distribution is nearly a beta one
    (Durbin and Watson 1951, doi:10.1093/biomet/38.1-2.159).
    """
    time = rows.group_sum(seconds) / rows.group_size
    order = np.lexsort((time, rows.group_sensor))
    neighbours = np.diff(rows.group_sensor[order], prepend=-1) == 0

    def shifted(columns: FloatArray) -> FloatArray:
        """Return A times columns (3 g, c): half the sum of the neighbours' on either side."""
        blocks = columns.reshape(len(order), 3, -1)[order]
        result = np.zeros_like(blocks)
        result[1:] += blocks[:-1] * neighbours[1:, None, None]
        result[:-1] += blocks[1:] * neighbours[1:, None, None]
        back = np.empty_like(result)
        back[order] = 0.5 * result
        return back.reshape(columns.shape)

    along = shifted(basis)
    small = basis.T @ along
    freedom = len(rest) - basis.shape[1]
    first = -float(np.trace(small))
    second = 1.5 * int(np.sum(neighbours)) - 2.0 * np.sum(along**2) + np.sum(small * small.T)
    mean = first / freedom
    variance = 2.0 * (freedom * second - first**2) / (freedom**2 * (freedom + 2.0))
    ratio = float(np.sum(rest * shifted(rest)) / np.sum(rest**2))
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
    average; a t test over the poses.
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
