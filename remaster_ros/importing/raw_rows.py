# SPDX-License-Identifier: Apache-2.0
"""Rows of joint angles and points in SI, of a table or a bag, before a session is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import inverse_poses
from remaster_ros.types import AngleUnit, BoolArray, FloatArray, IntArray, SensorKind

# A marker whose extent is less than this share of the largest one is not on the arm. A marker on
# the first link would move so little only within a fiftieth of the arm's reach from its axis.
STATIC = 0.02


@dataclass(frozen=True, eq=False)
class RawRows:
    """Rows of joint angles and points in SI, in the order measured."""

    source: tuple[str, ...]  # File and line of each row, for messages, n texts
    joint_columns: tuple[str, ...]  # Names of the k joint columns
    # rad and m, (n, k) and (n, 3); NaN where unknown
    q: FloatArray
    from_q: FloatArray
    position: FloatArray
    std: FloatArray
    stamp_s: FloatArray | None  # s, (n,); None where there are no times
    # ``pose``, ``configuration``, ``split``, ``sensor``, ``marker`` -> n texts, where given
    labels: dict[str, list[str]]
    # (n,); NaN and -1 where unknown
    temperature_c: FloatArray
    samples: FloatArray
    columns: dict[str, str]  # Column -> its meaning in words
    description: tuple[str, ...]  # How the files were read and joined, a line each
    warnings: tuple[str, ...]  # A sentence each
    # Marker -> names of its columns X, Y and Z; empty for a bag
    points: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    length_unit: str = 'm'  # Unit of the points in the file
    # Unit of the joints in the table; None if they are those of the URDF in SI, as in a bag
    angle_unit: AngleUnit | None = None
    # Index of the reading of each row, (n,): rows of one reading were measured at the same time.
    # None if each row is a reading of its own
    reading: IntArray | None = None
    # Quaternion x, y, z, w of the marker in the sensor's frame, (n, 4), NaN if unknown; None if
    # no orientation was measured
    orientation: FloatArray | None = None
    # Orientation whose convention (Euler order, quaternion order) the columns do not state, (n, 3)
    # or (n, 4), with its unit ('' if not stated) and column names
    ambiguous_orientation: FloatArray | None = None
    ambiguous_unit: str = ''
    ambiguous_columns: str = ''
    # Joint column -> (coupled joint column, 1 or -1), as the controller of this file counts
    coupling: Mapping[str, tuple[str, Literal[1, -1]]] = field(default_factory=dict)
    maker: str = ''  # Manufacturer of the controller; '' if unknown
    # Kind of the instrument that measured the points; '' if unknown
    instrument: Literal['', SensorKind] = ''
    effort: FloatArray | None = None  # Measured torques, N m, (n, k); None if not measured

    def in_order(self) -> RawRows:
        """Rows sorted by their times, with a warning added if they were not sorted.

        The same rows if they have no times, or these rise already.
        """
        if self.stamp_s is None:
            return self
        order = np.argsort(self.stamp_s, kind='stable')
        if np.all(np.diff(order) > 0):
            return self
        picked: dict[str, Any] = {
            name: value[order]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(
            self,
            **picked,
            source=tuple(self.source[i] for i in order),
            labels={kind: [names[i] for i in order] for kind, names in self.labels.items()},
            warnings=(*self.warnings, 'the rows were put in the order of their times'),
        )


def from_tool(rows: RawRows) -> RawRows:
    """Rows of a sensor on the tool with each measured pose inverted.

    `position` and `orientation` become the pose of the sensor in the frame of its target, in
    place of that of the target in the sensor's frame.

    Raises
    ------
    InputError
        A row without an orientation.
    """
    orientation = np.full((1, 4), np.nan) if rows.orientation is None else rows.orientation
    unknown = np.isnan(orientation).any(axis=1)
    if unknown.any():
        which = f'reading {int(np.argmax(unknown)) + 1} has no orientation'
        raise InputError(
            f'--on-tool: {which} (qx, qy, qz, qw), without which what a sensor on the tool '
            'measures tells nothing; add the columns, or leave such rows out'
        )
    position, orientation = inverse_poses(rows.position, orientation)
    return replace(rows, position=position, orientation=orientation)


def moving_markers(raw: FloatArray) -> BoolArray:
    """Mask of the markers that move with the arm, (markers,).

    A marker does if its extent along an axis is over 2 % (`STATIC`) of the largest one of all
    markers. `raw`: readings, (markers, n, 3), NaN where missing; a marker never seen does not.
    """
    seen = np.isfinite(raw[:, :, 0])
    extent = np.array(
        [
            np.ptp(marker_points[at], axis=0).max() if at.any() else 0.0
            for marker_points, at in zip(raw, seen)
        ]
    )
    return np.asarray(extent > STATIC * extent.max(initial=0.0))
