# SPDX-License-Identifier: Apache-2.0
"""Channels of the sensors and groups of errors: which errors of some rows have one variance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.types import IntArray


@dataclass(frozen=True)
class Channel:
    """Errors of one sensor, along some axes, with one noise."""

    sensor: int  # Index of the sensor
    direction: str  # 'along' the line of sight, 'across' it, or '' for all axes alike
    axes: tuple[int, int]  # Axes of the rows' frames: first and behind the last

    @property
    def dimension(self) -> int:
        """Number of axes of the channel: 1 along or 2 across the line of sight, or 3."""
        return self.axes[1] - self.axes[0]


@dataclass(frozen=True, eq=False)
class ErrorGroup:
    """Errors of one channel with one variance.

    The variance is sigma² + frame_size frame_sigma² + size pose_sigma².
    """

    channel: int  # Index of the channel
    # 'rows' for the deviations from the means of the frames, 'frames' for those of the frames'
    # means from the mean of their pose, 'poses' for the poses' means
    kind: Literal['rows', 'frames', 'poses']
    frame_size: float  # Harmonic mean M of the rows of a pose's frames; 0 of 'rows'
    # m M for m frames in a pose, which is the number of its rows where the frames are of one size;
    # 0 but of 'poses'
    size: float
    # Groups of rows that these errors belong to, (g,): for 'frames' those with several frames
    groups: IntArray
    freedom: int  # Number of independent errors


def error_groups(channels: Sequence[Channel], rows: Rows) -> tuple[ErrorGroup, ...]:
    """Error groups of each channel, in the order of the channels; groups without errors left out.

    For each channel that of kind 'rows' (rows' deviations from their frame's mean), then for
    each size of frame that of 'frames' (frames' from their pose's mean), and 'poses' (poses'
    means) by number of frames; sizes and numbers ascend.
    """
    found = []
    for index, channel in enumerate(channels):
        groups_of_sensor = np.flatnonzero(rows.group_sensor == channel.sensor)
        frames, size = rows.group_frames[groups_of_sensor], rows.mean_frame_size[groups_of_sensor]

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

        add(
            'rows',
            0.0,
            0.0,
            groups_of_sensor,
            int(np.sum(rows.group_size[groups_of_sensor] - frames)),
        )
        for value in np.unique(size).tolist():
            alike = groups_of_sensor[size == value]
            number = frames[size == value]
            add('frames', value, 0.0, alike[number > 1], int(np.sum(number - 1)))
            for count in np.unique(number).tolist():
                groups = alike[number == count]
                add('poses', value, count * value, groups, len(groups))
    return tuple(found)
