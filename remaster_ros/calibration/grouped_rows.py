"""Observations sorted for the estimators: by sensor, then by pose, then by frame."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray, IntArray, Measurements


@dataclass(frozen=True, eq=False)
class Rows:
    """Observations sorted by sensor, then by pose, then by frame.

    Attributes
    ----------
    source
        Index of each row in the `Measurements` it came from, (n,).
    q
        rad, (n, k).
    marker
        Marker index, (n,).
    target
        Measured positions in the base coordinates of the reference registrations, m, (n, 3).
    spans
        (sensor index, slice of its rows) of every sensor present.
    group_start, group_size, group_sensor
        The rows of one sensor at one pose share an error: where each group starts, how many rows
        and which sensor it has, (groups,).
    frame
        Number of each row's frame, ascending from 0, (n,): the markers of one frame share an
        error, too. None where every row is a frame by itself.
    """

    source: IntArray
    q: FloatArray
    marker: IntArray
    target: FloatArray
    spans: tuple[tuple[int, slice], ...]
    group_start: IntArray
    group_size: IntArray
    group_sensor: IntArray
    frame: IntArray | None = None

    @classmethod
    def of(cls, measurements: Measurements, rows: IntArray, reference: FloatArray) -> Rows:
        """Sort the given rows of the measurements; `reference` is T_R_N, (sensors, 4, 4)."""
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

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.source)

    def group_sum(self, values: FloatArray) -> FloatArray:
        """Sum over the rows of each group, (groups, ...), of values (n, ...)."""
        return _sum(self._rows_of_groups, values)

    def blocks(self, rows: int) -> list[tuple[int, int]]:
        """Cut the groups into runs (first, behind the last) of about so many rows each."""
        number = self.group_start // max(1, rows)
        edges = np.flatnonzero(np.diff(number)) + 1
        cuts = [0, *edges.tolist(), len(self.group_start)]
        return list(itertools.pairwise(cuts))

    def of_groups(self, first: int, last: int) -> Rows:
        """Return the rows of the groups from ``first`` to before ``last``."""
        if first == 0 and last == len(self.group_start):
            return self
        start = int(self.group_start[first])
        stop = int(self.group_start[last - 1] + self.group_size[last - 1])
        spans = (
            (sensor, slice(max(span.start, start) - start, min(span.stop, stop) - start))
            for sensor, span in self.spans
        )
        return Rows(
            source=self.source[start:stop],
            q=self.q[start:stop],
            marker=self.marker[start:stop],
            target=self.target[start:stop],
            spans=tuple((sensor, span) for sensor, span in spans if span.start < span.stop),
            group_start=self.group_start[first:last] - start,
            group_size=self.group_size[first:last],
            group_sensor=self.group_sensor[first:last],
            frame=None if self.frame is None else self.frame[start:stop] - self.frame[start],
        )

    @property
    def group_of_row(self) -> IntArray:
        """Index of each row's group, (n,)."""
        return np.repeat(np.arange(len(self.group_start)), self.group_size)

    @cached_property
    def frame_start(self) -> IntArray:
        """Where each frame starts, (frames,)."""
        if self.frame is None:
            return np.arange(len(self))
        return np.flatnonzero(np.diff(self.frame, prepend=-1))

    @cached_property
    def frame_size(self) -> IntArray:
        """Rows of each frame, (frames,)."""
        return np.diff(np.append(self.frame_start, len(self)))

    @cached_property
    def first_frame(self) -> IntArray:
        """The first frame of each group, (groups,)."""
        return np.searchsorted(self.frame_start, self.group_start)

    @cached_property
    def group_frames(self) -> IntArray:
        """Frames of each group, (groups,)."""
        return np.diff(np.append(self.first_frame, len(self.frame_start)))

    @cached_property
    def group_of_frame(self) -> IntArray:
        """Index of each frame's group, (frames,)."""
        return np.repeat(np.arange(len(self.group_start)), self.group_frames)

    @cached_property
    def mean_frame_size(self) -> FloatArray:
        """Harmonic mean of the frames' rows in each group, (groups,)."""
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
        return _members(self.group_start, len(self))

    @cached_property
    def _rows_of_frames(self) -> csr_array:
        return _members(self.frame_start, len(self))

    @cached_property
    def _frames_of_groups(self) -> csr_array:
        return _members(self.first_frame, len(self.frame_start))


def _members(start: IntArray, count: int) -> csr_array:
    """Return which of so many neighbours are of each run, (runs, count)."""
    edges = np.append(start, count)
    return csr_array((np.ones(count, np.int8), np.arange(count), edges), (len(start), count))


def _sum(members: csr_array, values: FloatArray) -> FloatArray:
    """Return the sums of runs of values, or these where each is a run by itself."""
    if members.shape[0] == members.shape[1]:
        return values
    # A tenth of the time of `np.add.reduceat`.
    total: FloatArray = members @ values.reshape(len(values), -1)
    return total.reshape(-1, *values.shape[1:])
