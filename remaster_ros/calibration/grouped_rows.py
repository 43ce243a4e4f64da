"""Observations sorted for the estimators: by sensor, then by pose."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray, IntArray, Measurements


@dataclass(frozen=True, eq=False)
class Rows:
    """Observations sorted by sensor, then by pose.

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
    """

    source: IntArray
    q: FloatArray
    marker: IntArray
    target: FloatArray
    spans: tuple[tuple[int, slice], ...]
    group_start: IntArray
    group_size: IntArray
    group_sensor: IntArray

    @classmethod
    def of(cls, measurements: Measurements, rows: IntArray, reference: FloatArray) -> Rows:
        """Sort the given rows of the measurements; `reference` is T_R_N, (sensors, 4, 4)."""
        order = np.lexsort((rows, measurements.pose[rows], measurements.sensor[rows]))
        source = rows[order]
        sensor, pose = measurements.sensor[source], measurements.pose[source]
        change = np.flatnonzero((np.diff(sensor) != 0) | (np.diff(pose) != 0)) + 1
        group_start = np.concatenate(([0], change)).astype(np.int64)
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
        )

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.source)

    def group_sum(self, values: FloatArray, axis: int) -> FloatArray:
        """Sum over the rows of each group; `axis` (the rows) becomes the groups."""
        return np.add.reduceat(values, self.group_start, axis=axis)

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
        )

    @property
    def group_of_row(self) -> IntArray:
        """Index of each row's group, (n,)."""
        return np.repeat(np.arange(len(self.group_start)), self.group_size)
