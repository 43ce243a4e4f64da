# SPDX-License-Identifier: Apache-2.0
"""Convention of orientations whose columns do not state it: the one that turns as the arm did.

Euler angles have 24 orders, a quaternion two, and a rotation vector looks like angles. Between two
rows the tool turned as the measured body did, up to the constant orientation of the body on the
tool and of the sensor in the room. The points give the orientation of the sensor as well. Only the
right convention agrees with both.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.calibration.arrangement import linear_fit
from remaster_ros.importing.assemble import SessionOptions, controller_of
from remaster_ros.importing.raw_rows import RawRows
from remaster_ros.kinematics.pad_angles import PadAngles
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse_poses
from remaster_ros.types import FloatArray

# Orientations closer than this to the nominal arm, rad, are computed from its joints. It covers
# a rounding to a hundredth of a degree.
COMPUTED_RAD = 2e-4
# Largest difference from the arm, rad: zero-offsets of some degrees turn the tool by so much.
# Another convention within the second value, rad, of the best one leaves the choice open.
AGREE_RAD, OTHER_RAD = 0.1, 0.02
# Largest residual, as a share of the points' extent, of a robot whose joints are right.
FITS = 0.03
# Largest difference of the sensor's orientation by the points and by the orientations, rad.
SENSOR_RAD = 0.2
# Fewer rows do not decide between conventions.
FEWEST_ROWS = 8
# At half a turn a rotation vector may as well be its opposite, rad.
_HALF_TURN_RAD = 2.9
_REFERENCES = 5
_OF_THE_ROBOT = 'are how the robot itself believes its tool to be turned, not measured'


def with_orientation(rows: RawRows, chain: SerialChain, options: SessionOptions) -> RawRows:
    """Rows with quaternions of their orientation columns, or without orientations.

    The convention is the one that agrees with the arm to 0.1 rad (`AGREE_RAD`, median).
    Orientations are dropped, with a warning, if they are computed by the robot, disagree with
    the arm or with the points, or fit in several conventions. Quaternions of stated order are
    kept unchecked for several markers or sensors, or a sensor on the tool. Rows without
    orientations are returned as they are.
    """
    if rows.ambiguous_orientation is None and rows.orientation is None:
        return rows
    options_tried = [options]
    if rows.coupling and not chain.slides.any():
        options_tried.append(replace(options, couple=(*options.couple, *rows.coupling.items())))
    joints = [
        PadAngles.of(controller_of(rows, chain, candidate), chain.joint_names).to_urdf(rows.q)
        for candidate in options_tried
    ]
    arms = [chain.forward(q) for q in joints]
    if rows.ambiguous_orientation is None:
        assert rows.orientation is not None
        several = any(len({*rows.labels.get(what, [''])}) > 1 for what in ('marker', 'sensor'))
        if options.on_tool or several:
            return rows
        by_joints = _orientation_error(rows, rows.orientation, arms, False, ignore_points=True)
        if by_joints < COMPUTED_RAD:
            return _without_orientation(rows, _OF_THE_ROBOT)
        if by_joints < AGREE_RAD < _orientation_error(rows, rows.orientation, arms, False):
            return _without_orientation(rows, 'are in another frame than the points')
        # If the joints are wrong, the arm cannot judge orientations; `sense` finds that later.
        known = np.isfinite(rows.orientation).all(axis=1)
        fits = linear_fit(chain, np.array(joints), rows.position)[0].min() < FITS
        if by_joints > AGREE_RAD and known.sum() >= FEWEST_ROWS and fits:
            return _without_orientation(rows, 'turn otherwise than the arm')
        return rows
    found = [
        (_orientation_error(rows, xyzw, arms, options.on_tool), words, xyzw)
        for words, xyzw in _conventions(rows.ambiguous_orientation, rows.ambiguous_unit)
    ]
    if not found:
        return _without_orientation(rows, 'are no quaternions')
    found.sort(key=lambda candidate: candidate[0])
    error, words, xyzw = found[0]
    alternatives = [
        other
        for differences, _, other in found[1:]
        if differences < max(2.0 * error, error + OTHER_RAD)
    ]
    if (
        min(
            _orientation_error(rows, candidate, arms, options.on_tool, ignore_points=True)
            for *_, candidate in found
        )
        < COMPUTED_RAD
    ):
        return _without_orientation(rows, _OF_THE_ROBOT)
    if error > AGREE_RAD:
        return _without_orientation(rows, 'turn otherwise than the arm, however they are read')
    if any(_differ(xyzw, other) for other in alternatives):
        return _without_orientation(rows, 'can be read in several ways, which fit the arm alike')
    return replace(
        rows,
        orientation=xyzw,
        ambiguous_orientation=None,
        warnings=(
            *rows.warnings,
            f'{rows.ambiguous_columns}: read as {words}, which turns as the arm did to '
            f'{np.degrees(error):.2f} degrees',
        ),
    )


def _without_orientation(rows: RawRows, why: str) -> RawRows:
    """Rows without orientations, with a warning that names the columns and says `why`."""
    note = f'{rows.ambiguous_columns or "the orientations"} {why}; left out'
    return replace(
        rows, orientation=None, ambiguous_orientation=None, warnings=(*rows.warnings, note)
    )


def _conventions(values: FloatArray, unit: str) -> Iterator[tuple[str, FloatArray]]:
    """Yield conventions in which columns (n, 3) or (n, 4) can be read.

    Each is its name in words and the quaternions x, y, z, w, (n, 4), NaN where a number is
    missing. `unit`: 'deg', 'rad' or ''; without it degrees if an angle is above 2.1 π, else both.
    Nothing for four numbers whose length is not 1 within 0.01.
    """
    known = np.isfinite(values).all(axis=1)
    if values.shape[1] == len('xyzw'):
        lengths = np.linalg.norm(values[known], axis=1)
        if np.all(np.abs(lengths - 1.0) < 0.01):
            yield 'a quaternion w, x, y, z', values[:, [1, 2, 3, 0]]
            yield 'a quaternion x, y, z, w', values
        return
    largest = np.abs(values[known]).max(initial=0.0)
    units = [unit] if unit else ['deg'] if largest > 2.1 * np.pi else ['rad', 'deg']
    for name in units:
        angles = np.deg2rad(values[known]) if name == 'deg' else values[known]
        ways = [(f'a rotation vector, {name}', Rotation.from_rotvec(angles))]
        for axes in itertools.product('xyz', repeat=3):
            order = ''.join(axes)
            if axes[0] != axes[1] != axes[2]:
                ways += [
                    (
                        f'angles about fixed axes {order}, {name}',
                        Rotation.from_euler(order, angles),
                    ),
                    (
                        f"angles about turned axes {order[0]}, {order[1]}', {order[2]}'', {name}",
                        Rotation.from_euler(order.upper(), angles),
                    ),
                ]
        for words, turned in ways:
            xyzw = np.full((len(values), 4), np.nan)
            xyzw[known] = turned.as_quat()
            yield words, xyzw


def _orientation_error(
    rows: RawRows,
    xyzw: FloatArray,
    arms: list[FloatArray],
    on_tool: bool,
    ignore_points: bool = False,
) -> float:
    """Median difference of measured orientations from those of the nominal arm, rad.

    `xyzw`: quaternions, (n, 4), NaN if unknown; `arms`: tool poses, (n, 4, 4), for each way to
    count the joints, of which the one with the least difference counts. `on_tool`: whether the
    sensor is on the tool. inf with fewer than 8 rows (`FEWEST_ROWS`) or, unless
    `ignore_points`, if the sensor's rotation in the base frame as fitted to the orientations
    is over 0.2 rad from the one fitted to the points.
    """
    known = np.flatnonzero(np.isfinite(xyzw).all(axis=1))
    if len(known) < FEWEST_ROWS:
        return np.inf
    position, xyzw = rows.position[known], xyzw[known]
    if on_tool:
        position, xyzw = inverse_poses(position, xyzw)
    measured = Rotation.from_quat(xyzw)
    errors = []
    for T in arms:
        arm = Rotation.from_matrix(T[known, :3, :3])
        by_points = _sensor_rotation(position, T[known])
        for first in range(min(_REFERENCES, len(known))):
            a = (measured * measured[first].inv()).as_rotvec()
            b = (arm * arm[first].inv()).as_rotvec()
            size = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
            used = (size < _HALF_TURN_RAD) & (np.arange(len(a)) != first)
            if used.sum() < FEWEST_ROWS - 2:
                continue
            sensor = Rotation.align_vectors(a[used], b[used])[0]
            if ignore_points or (sensor.inv() * by_points).magnitude() < SENSOR_RAD:
                errors.append(np.median(np.linalg.norm(a - sensor.apply(b), axis=1)[used]))
    return float(min(errors, default=np.inf))


def _sensor_rotation(position: FloatArray, T: FloatArray) -> Rotation:
    """Rotation of the base frame in the sensor's frame, from the points, (n, 3), of one marker.

    With B its inverse, e the sensor's origin, m the marker in the tool frame, and R, t the
    tool poses in `T`, (n, 4, 4): B p + e - R m = t is linear in the 15 numbers of B, e and m.
    """
    n = len(T)
    A = np.zeros((3 * n, 15))
    for axis in range(3):
        A[axis::3, 3 * axis : 3 * axis + 3] = position
        A[axis::3, 9 + axis] = 1.0
    A[:, 12:] = -T[:, :3, :3].reshape(3 * n, 3)
    B = np.linalg.lstsq(A, T[:, :3, 3].ravel(), rcond=None)[0][:9].reshape(3, 3)
    u, _, vt = np.linalg.svd(B.T)
    return Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _differ(xyzw: FloatArray, other: FloatArray) -> bool:
    """Whether two arrays of quaternions x, y, z, w, (n, 4), differ by over 5 mrad (median)."""
    known = np.isfinite(xyzw).all(axis=1)
    between = Rotation.from_quat(xyzw[known]).inv() * Rotation.from_quat(other[known])
    return bool(np.median(between.magnitude()) > OTHER_RAD / 4.0)
