# SPDX-License-Identifier: Apache-2.0
"""Smooth functions for errors outside the model, as columns next to the model's.

Functions of the position in front of a sensor, of time, of each joint's own angle, of time for
each zero-offset; and a displacement of each link and a tilt of each axis, constant in the link's
frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.noise import NoiseModel
from remaster_ros.types import FloatArray, IntArray

# Degree of the polynomials of time, and number of harmonics of a joint's angle.
TIME_DEGREE, HARMONICS = 3, 2
POSITION_DEGREE = 2
# Largest number of rows; of larger sessions the rows of evenly spread poses.
MOST_ROWS = 10_000
GOLDEN = 0.5 * (5.0**0.5 - 1.0)


def evenly(count: int, share: float) -> IntArray:
    """Indices, ascending from 0, of an evenly spread ``share`` (0 to 1) of ``count`` elements.

    The choice follows multiples of the golden ratio's inverse: the share is the same among
    every second or third element, such as rows of several markers in turn, unlike with every
    k-th element.
    """
    return np.flatnonzero(np.arange(count) * GOLDEN % 1.0 < share)


def spread_poses(rows: Rows) -> Rows:
    """All rows, or of more than 10,000 (`MOST_ROWS`) the rows of evenly spread poses."""
    if len(rows) <= MOST_ROWS:
        return rows
    first = evenly(len(rows.group_start), MOST_ROWS / len(rows))
    kept = np.flatnonzero(np.isin(rows.group_of_row, first))
    size = rows.group_size[first]
    cuts = [
        (sensor, *np.searchsorted(kept, (s.start, s.stop)).tolist()) for sensor, s in rows.spans
    ]
    return replace(
        rows.picked(kept),
        spans=tuple((sensor, slice(low, high)) for sensor, low, high in cuts),
        group_start=np.cumsum(size) - size,
        group_size=size,
        group_sensor=rows.group_sensor[first],
    )


def whitened(mode: Mode, rows: Rows, families: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Columns (n, 3, c) of families of functions in units of the noise at a mode, by name.

    With 'errors', measured less modelled, (n, 3, 1), and 'model', the derivative by the free
    parameters, (n, 3, f), in these units, too.
    """
    posterior = mode.linearisation.posterior
    model = posterior.model
    columns = {
        'errors': (rows.target - model.predict(mode.z, rows))[:, :, None],
        'model': model.jacobian(mode.z, rows)[:, :, posterior.free],
        **families,
    }
    split = sorted({c.sensor for c in posterior.noise_model.channels if c.direction})
    noise_model = NoiseModel.of(rows, model.reference, split)
    noise = posterior.noise(mode.eta)
    return {name: noise_model.whitened(part, noise) for name, part in columns.items()}


def of_position(rows: Rows, degree: int = POSITION_DEGREE) -> FloatArray:
    """Polynomials of the measured position, of degree 1 or up to 2, without the constant.

    Separate for sensors and axes (`by_sensor` splits them): (n, 3, 9 sensors) or (n, 3, 27
    sensors).
    """
    measured = rows.measured
    place = np.empty_like(measured)
    for _, span in rows.spans:
        centred = measured[span] - measured[span].mean(axis=0)
        place[span] = centred / max(float(np.std(centred)), 1e-9)
    if degree == 1:
        return _by_sensor(rows, place)
    first, second = np.triu_indices(3)
    products = place[:, first] * place[:, second]
    return _by_sensor(rows, np.concatenate((place, products), axis=1))


def of_time(rows: Rows, seconds: FloatArray, degree: int = TIME_DEGREE) -> FloatArray:
    """Polynomials of time, s, (n,), without the constant, separate for sensors and axes.

    Legendre polynomials over the range of times, up to the degree: (n, 3, 3 degree sensors).
    """
    return _by_sensor(rows, _polynomials(seconds, degree))


def of_joint_times(
    mode: Mode, rows: Rows, seconds: FloatArray, degree: int = TIME_DEGREE
) -> FloatArray:
    """Displacements by zero-offsets that change with time, (n, 3, degree k), m per rad.

    Blocks of k columns for Legendre polynomials of degree 1 to ``degree`` over the range of
    times ``seconds``, s, (n,).
    """
    by_joints = mode.linearisation.posterior.model.inner_pose(mode.z, rows).by_joints
    functions = _polynomials(seconds, degree)
    return np.concatenate(
        [by_joints * function[:, None, None] for function in functions.T], axis=2
    )


def _polynomials(seconds: FloatArray, degree: int) -> FloatArray:
    """Legendre polynomials of time, s, (n,), over its range, without the constant, (n, degree)."""
    early, late = seconds.min(), seconds.max()
    share = (2.0 * seconds - early - late) / max(late - early, 1e-9)
    return legendre.legvander(share, degree)[:, 1:]


def of_joint_angles(mode: Mode, rows: Rows, harmonics: int = HARMONICS) -> FloatArray:
    """Displacements by joint errors that are harmonics of their joint's own angle.

    (n, 3, 2 harmonics k), in blocks of k columns: sine and cosine of the angle, then of its
    double. For a joint that slides half a turn is the measured travel: a sine of its position
    is then as smooth as one of an angle.
    """
    model = mode.linearisation.posterior.model
    by_joints = model.inner_pose(mode.z, rows).by_joints
    least, most = rows.q.min(axis=0), rows.q.max(axis=0)
    travelled = np.pi * (rows.q - 0.5 * (least + most)) / np.maximum(most - least, 1e-9)
    angles = np.where(model.chain.slides, travelled, rows.q)
    return np.concatenate(
        [
            by_joints * wave(order * angles)[:, None, :]
            for order in range(1, harmonics + 1)
            for wave in (np.sin, np.cos)
        ],
        axis=2,
    )


def of_links(mode: Mode, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """Errors by a displacement and by a tilt of each joint's frame, (n, 3, 3 k) each.

    Along and about the x, y, z axes of the frame after the joint, m per m and m per rad, joint by
    joint.
    """
    model = mode.linearisation.posterior.model
    frames = model.chain.frames(rows.q, model.offsets(mode.z))
    pose = model.inner_pose(mode.z, rows)
    # (n, k, 3 axes, 3): the directions of the frames' axes.
    axes = np.swapaxes(frames[..., :3, :3], -1, -2)
    arms = pose.points[:, None, :] - frames[..., :3, 3]
    turned = np.cross(axes, arms[:, :, None, :])

    def columns(vectors: FloatArray) -> FloatArray:
        return np.swapaxes(vectors.reshape(len(rows), -1, 3), 1, 2)

    return columns(axes), columns(turned)


def by_sensor(rows: Rows, columns: FloatArray) -> dict[int, FloatArray]:
    """Split functions of position or time (n, 3, c sensors) by sensor: index -> (n, 3, c)."""
    parts = np.split(columns, len(rows.spans), axis=2)
    return {sensor: part for (sensor, _), part in zip(rows.spans, parts, strict=True)}


def _by_sensor(rows: Rows, functions: FloatArray) -> FloatArray:
    """Functions (n, c) along each axis, separate for each sensor, (n, 3, 3 c sensors)."""
    columns = np.zeros((len(rows), 3, len(rows.spans), 3, functions.shape[1]))
    for place, (_, span) in enumerate(rows.spans):
        for axis in range(3):
            columns[span, axis, place, axis] = functions[span]
    return columns.reshape(len(rows), 3, -1)
