"""Which errors of some rows have one variance: channels of the sensors, and groups of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.types import IntArray


@dataclass(frozen=True)
class Channel:
    """Errors of one sensor that have one noise.

    Attributes
    ----------
    sensor
        Its index.
    direction
        'along' the line of sight, 'across' it, or '' for all axes alike.
    axes
        Which axes of the rows' frames these are: first and behind the last.
    """

    sensor: int
    direction: str
    axes: tuple[int, int]

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return self.axes[1] - self.axes[0]


@dataclass(frozen=True, eq=False)
class ErrorGroup:
    """Errors of one channel that have one variance.

    The variance is sigma² + frame_size frame_sigma² + size pose_sigma².

    Attributes
    ----------
    channel
        Its index.
    kind
        'rows' for the deviations from the means of the frames, 'frames' for those of the frames'
        means from the mean of their pose, 'poses' for the poses' means.
    frame_size
        Harmonic mean M of the rows of a pose's frames; 0 of 'rows'.
    size
        m M for m frames in a pose, which is the number of its rows where the frames are of one
        size; 0 but of 'poses'.
    groups
        The rows' groups that these errors belong to, (g,): of 'frames' those with several.
    freedom
        Number of independent errors.
    """

    channel: int
    kind: Literal['rows', 'frames', 'poses']
    frame_size: float
    size: float
    groups: IntArray
    freedom: int


def error_groups(channels: Sequence[Channel], rows: Rows) -> tuple[ErrorGroup, ...]:
    """Sort the groups of each channel by their frames; what has no independent error is none."""
    found = []
    for index, channel in enumerate(channels):
        mine = np.flatnonzero(rows.group_sensor == channel.sensor)
        frames, size = rows.group_frames[mine], rows.mean_frame_size[mine]

        def add(
            kind: Literal['rows', 'frames', 'poses'],
            frame_size: float,
            size: float,
            groups: IntArray,
            errors: int,
            channel: Channel = channel,
            index: int = index,
        ) -> None:
            if errors > 0:
                freedom = channel.dimension * errors
                found.append(ErrorGroup(index, kind, frame_size, size, groups, freedom))

        add('rows', 0.0, 0.0, mine, int(np.sum(rows.group_size[mine] - frames)))
        for value in np.unique(size).tolist():
            alike = mine[size == value]
            number = frames[size == value]
            add('frames', value, 0.0, alike[number > 1], int(np.sum(number - 1)))
            for count in np.unique(number).tolist():
                groups = alike[number == count]
                add('poses', value, count * value, groups, len(groups))
    return tuple(found)
