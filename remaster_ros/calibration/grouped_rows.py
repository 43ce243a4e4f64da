# SPDX-License-Identifier: Apache-2.0
"""Observations sorted for the estimators: by sensor, then by pose, then by frame.

If a sensor measures orientations of bodies, these are further rows after those of all positions:
three numbers each, rad, with a separate noise (`model` has their prediction).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from remaster_ros.calibration.path_noise import Decorrelation, PathNoise
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements

Bodies = tuple[tuple[int, int], ...]
"""(sensor, marker) of each body whose orientation is fitted."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Observations sorted by sensor, then by pose, then by frame."""

    source: IntArray  # Index of each row in the `Measurements` it came from, (n,)
    q: FloatArray  # rad, (n, k)
    marker: IntArray  # Marker index, (n,)
    # Measured positions in the base coordinates of the reference registrations, m, (n, 3); 0 for
    # an orientation, whose prediction is the rotation from the measured to the modelled one
    target: FloatArray
    # (sensor index, slice of its rows) of each sensor present. The orientations of sensor
    # ``turning[i]`` have the index S + i, S being the number of sensors.
    spans: tuple[tuple[int, slice], ...]
    # Groups of rows that share an error, one sensor at one pose: first row, number of rows and
    # sensor of each, (groups,)
    group_start: IntArray
    group_size: IntArray
    group_sensor: IntArray
    # Index of each row's frame, ascending from 0, (n,): the markers of one frame share an error,
    # too. None if each row is a frame of its own.
    frame: IntArray | None = None
    # Measured orientations of the last r rows in the base coordinates of the reference
    # registrations, (r, 3, 3); None if none are fitted
    turned: FloatArray | None = None
    turning: tuple[int, ...] = ()  # Sensors of these orientations
    # Index of each row's body, (n,); -1 if it has none. None as ``turned``.
    body: IntArray | None = None
    # Point measured by a sensor on the tool in its own frame, m, (n, 3); 0 in rows of other
    # sensors, None without a sensor on the tool. ``target`` is then the origin of the measured
    # target, which is frame N.
    lever: FloatArray | None = None
    # Measured position of each row in the base coordinates of the reference, m, (n, 3); None if
    # that is ``target``
    place: FloatArray | None = None
    # Of each sensor whose errors are correlated along the path; () where none are
    decorrelation: tuple[Decorrelation, ...] = ()

    @classmethod
    def of(cls, measurements: Measurements, rows: IntArray, reference: FloatArray) -> Rows:
        """Positions of some rows of the measurements, sorted by sensor, pose and frame.

        ``rows``: indices of the measurements, in any order; ``reference``: T_R_N, (sensors, 4, 4),
        by which targets are converted to base coordinates.
        """
        keys = [rows, measurements.pose[rows], measurements.sensor[rows]]
        if measurements.frame is not None:
            keys.insert(1, measurements.frame[rows])
        source = rows[np.lexsort(keys)]
        sensor, pose = measurements.sensor[source], measurements.pose[source]
        new_group = (np.diff(sensor) != 0) | (np.diff(pose) != 0)
        group_start = np.concatenate(([0], np.flatnonzero(new_group) + 1)).astype(np.int64)
        frame = None
        if measurements.frame is not None:
            number = measurements.frame[source]
            new_frame = new_group | (np.diff(number) != 0) | (number[1:] < 0)
            if not new_frame.all():
                frame = np.concatenate(([0], np.cumsum(new_frame)))
        edges = np.searchsorted(sensor, np.arange(len(reference) + 1))
        return cls(
            source=source,
            q=measurements.q[source],
            marker=measurements.marker[source],
            target=apply(reference[sensor], measurements.position[source]),
            spans=tuple(
                (index, slice(int(edges[index]), int(edges[index + 1])))
                for index in range(len(reference))
                if edges[index] < edges[index + 1]
            ),
            group_start=group_start,
            group_size=np.diff(np.append(group_start, len(source))),
            group_sensor=sensor[group_start],
            frame=frame,
        )

    @classmethod
    def with_turns(
        cls,
        measurements: Measurements,
        rows: IntArray,
        reference: FloatArray,
        bodies: Bodies,
        on_tool: Sequence[int] = (),
    ) -> Rows:
        """Positions as of `of`, and behind them the orientations of bodies, where they are finite.

        ``bodies``: (sensor, marker) of each body, indices; ``on_tool``: indices of sensors on
        the tool, for whose positions ``lever`` is set: the measured point in the sensor's own
        frame. The same as `of` without bodies or measured orientations.
        """
        points = cls.of(measurements, rows, reference)
        if not bodies or measurements.orientation is None:
            return points
        number = np.full((len(reference), int(measurements.marker.max()) + 1), -1)
        for index, (sensor, marker) in enumerate(bodies):
            number[sensor, marker] = index

        def body_of(rows: IntArray) -> IntArray:
            return np.asarray(number[measurements.sensor[rows], measurements.marker[rows]])

        seen = np.isfinite(measurements.orientation[rows]).all(axis=1) & (body_of(rows) >= 0)
        turns = cls.of(replace(measurements, frame=None), rows[seen], reference)
        turning = tuple(sorted({sensor for sensor, _ in bodies}))
        n, sensors = len(points), len(reference)
        source = np.concatenate((points.source, turns.source))
        sensors_of = measurements.sensor[source]
        R_N_B = Rotation.from_quat(measurements.orientation[turns.source]).as_matrix()
        target, lever, place = points.target, None, np.concatenate((points.target, turns.target))
        moving = np.isin(sensors_of[:n], on_tool)
        if moving.any():
            R_N_C = Rotation.from_quat(measurements.orientation[points.source[moving]])
            lever = np.zeros((len(source), 3))
            lever[:n][moving] = -R_N_C.inv().apply(measurements.position[points.source[moving]])
            target = target.copy()
            target[moving] = reference[sensors_of[:n][moving], :3, 3]
        frame = points.frame
        if frame is not None:
            frame = np.concatenate((frame, frame[-1] + 1 + np.arange(len(turns))))
        return cls(
            source=source,
            q=measurements.q[source],
            marker=measurements.marker[source],
            target=np.concatenate((target, np.zeros((len(turns), 3)))),
            spans=points.spans
            + tuple(
                (sensors + turning.index(sensor), slice(n + span.start, n + span.stop))
                for sensor, span in turns.spans
            ),
            group_start=np.concatenate((points.group_start, n + turns.group_start)),
            group_size=np.concatenate((points.group_size, turns.group_size)),
            group_sensor=np.concatenate(
                (points.group_sensor, sensors + np.searchsorted(turning, turns.group_sensor))
            ),
            frame=frame,
            turned=reference[sensors_of[n:], :3, :3] @ R_N_B,
            turning=turning,
            body=body_of(source),
            lever=lever,
            place=place,
        )

    def along_path(self, noise: PathNoise | None) -> Rows:
        """Copy with the matrices that decorrelate errors along a path (`decorrelated`).

        ``noise``: correlations of the errors; if it is None, these rows themselves are
        returned.
        """
        if noise is None:
            return self
        found = []
        for sensor, span in self.of_points.spans:
            first, last = np.searchsorted(self.frame_start, (span.start, span.stop)).tolist()
            found.append(
                Decorrelation.of(
                    noise,
                    sensor,
                    self.source,
                    self.marker,
                    self.frame_start,
                    self.frame_size,
                    slice(first, last),
                )
            )
        return replace(self, decorrelation=tuple(found))

    def decorrelated(self, values: FloatArray) -> FloatArray:
        """Vectors (n, 3, ...) multiplied so that errors along the path are independent.

        The values themselves, no copy, if there is no correlation.
        """
        if not self.decorrelation:
            return values
        flat = values.reshape(len(self), -1)
        size = self.frame_size[:, None].astype(flat.dtype)
        means = self.frame_sum(flat) / size
        differences = flat - np.repeat(means, self.frame_size, axis=0)
        for decorrelation in self.decorrelation:
            for frames, factor, markers in decorrelation.runs:
                means[frames] = factor.astype(flat.dtype) @ means[frames]
                for rows, marker_factor in markers:
                    differences[rows] = marker_factor.astype(flat.dtype) @ differences[rows]
        differences += np.repeat(means, self.frame_size, axis=0)
        return differences.reshape(values.shape)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.source)

    @property
    def points(self) -> int:
        """Number of positions, which are the first rows."""
        return len(self) - (0 if self.turned is None else len(self.turned))

    @property
    def measured(self) -> FloatArray:
        """Measured positions in the base coordinates of the reference, (n, 3)."""
        return self.target if self.place is None else self.place

    def whole(self, rows: BoolArray) -> BoolArray:
        """Mask (n,) extended to both halves (position and orientation) of each reading in it.

        ``rows``: the mask, which is returned itself if no orientations are fitted.
        """
        if self.turned is None:
            return rows
        return np.asarray(np.isin(self.source, self.source[rows]))

    @property
    def of_points(self) -> Rows:
        """Rows of the positions only, which are the first; the same rows without orientations."""
        if self.turned is None:
            return self
        count = int(np.searchsorted(self.group_start, self.points))
        return replace(self.of_groups(0, count), turning=())

    def group_sum(self, values: FloatArray) -> FloatArray:
        """Sums over the rows of each group, (groups, ...), of values (n, ...).

        A group is the rows of one sensor at one pose.
        """
        return _sum(self._rows_of_groups, values)

    def blocks(self, rows: int) -> list[tuple[int, int]]:
        """Split the groups into runs (first, end), end exclusive, of about ``rows`` rows each.

        First and end are indices of groups. No group is split, so that a run is longer if a
        group is.
        """
        number = self.group_start // max(1, rows)
        edges = np.flatnonzero(np.diff(number)) + 1
        cuts = [0, *edges.tolist(), len(self.group_start)]
        return list(itertools.pairwise(cuts))

    def of_groups(self, first: int, last: int) -> Rows:
        """Rows of the groups from index ``first`` to before ``last``; itself if these are all."""
        if first == 0 and last == len(self.group_start):
            return self
        start = int(self.group_start[first])
        stop = int(self.group_start[last - 1] + self.group_size[last - 1])
        spans = (
            (sensor, slice(max(span.start, start) - start, min(span.stop, stop) - start))
            for sensor, span in self.spans
        )
        turned = self.turned
        if turned is not None:
            turned = turned[max(start - self.points, 0) : max(stop - self.points, 0)]
        return replace(
            self.picked(slice(start, stop)),
            spans=tuple((sensor, span) for sensor, span in spans if span.start < span.stop),
            group_start=self.group_start[first:last] - start,
            group_size=self.group_size[first:last],
            group_sensor=self.group_sensor[first:last],
            frame=None if self.frame is None else self.frame[start:stop] - self.frame[start],
            turned=turned if turned is not None and len(turned) else None,
        )

    def picked(self, rows: slice | IntArray) -> Rows:
        """Copy with some rows (slice or indices) of each array of n rows, without decorrelation.

        The arrays that describe groups, spans and measured orientations are not changed, and
        fit all rows: the caller has to replace them.
        """
        names = ('source', 'q', 'marker', 'target', 'frame', 'body', 'lever', 'place')
        columns: dict[str, Any] = {
            name: value[rows] for name in names if (value := getattr(self, name)) is not None
        }
        return replace(self, decorrelation=(), **columns)

    @property
    def group_of_row(self) -> IntArray:
        """Index of each row's group, (n,)."""
        return np.repeat(np.arange(len(self.group_start)), self.group_size)

    @cached_property
    def frame_start(self) -> IntArray:
        """First row of each frame, (frames,)."""
        if self.frame is None:
            return np.arange(len(self))
        return np.flatnonzero(np.diff(self.frame, prepend=-1))

    @cached_property
    def frame_size(self) -> IntArray:
        """Number of rows of each frame, (frames,)."""
        return np.diff(np.append(self.frame_start, len(self)))

    @cached_property
    def first_frame(self) -> IntArray:
        """First frame of each group, (groups,)."""
        return np.searchsorted(self.frame_start, self.group_start)

    @cached_property
    def group_frames(self) -> IntArray:
        """Number of frames of each group, (groups,)."""
        return np.diff(np.append(self.first_frame, len(self.frame_start)))

    @cached_property
    def group_of_frame(self) -> IntArray:
        """Index of each frame's group, (frames,)."""
        return np.repeat(np.arange(len(self.group_start)), self.group_frames)

    @cached_property
    def mean_frame_size(self) -> FloatArray:
        """Harmonic mean of the frames' sizes in each group, (groups,)."""
        inverse = np.add.reduceat(1.0 / self.frame_size, self.first_frame)
        # Groups alike have the same number to the last digit.
        return np.round(self.group_frames / inverse, 9)

    def frame_sum(self, values: FloatArray) -> FloatArray:
        """Sum over the rows of each frame, (frames, ...), of values (n, ...)."""
        return _sum(self._rows_of_frames, values)

    def sum_of_frames(self, values: FloatArray) -> FloatArray:
        """Sum over the frames of each group, (groups, ...), of values (frames, ...)."""
        return _sum(self._frames_of_groups, values)

    @cached_property
    def _rows_of_groups(self) -> csr_array:
        """Indicator matrix (groups, n) with 1 for each row of a group."""
        return _members(self.group_start, len(self))

    @cached_property
    def _rows_of_frames(self) -> csr_array:
        """Matrix (frames, n) with 1 for each row of a frame."""
        return _members(self.frame_start, len(self))

    @cached_property
    def _frames_of_groups(self) -> csr_array:
        """Matrix (groups, frames) with 1 for each frame of a group."""
        return _members(self.first_frame, len(self.frame_start))


def _members(start: IntArray, count: int) -> csr_array:
    """Indicator matrix (runs, count) of consecutive runs of ``count`` elements.

    ``start``: first index of each run, ascending from 0, (runs,).
    """
    edges = np.append(start, count)
    return csr_array((np.ones(count, np.int8), np.arange(count), edges), (len(start), count))


def _sum(members: csr_array, values: FloatArray) -> FloatArray:
    """Sums of runs of values, (runs, ...), from values (n, ...).

    ``members``: of `_members`, (runs, n). If each run is a single value, the values themselves
    are returned, not a copy.
    """
    if members.shape[0] == members.shape[1]:
        return values
    # A tenth of the time of `np.add.reduceat`.
    total: FloatArray = members @ values.reshape(len(values), -1)
    return total.reshape(-1, *values.shape[1:])
