# SPDX-License-Identifier: Apache-2.0
"""Rules between the rows of observations.csv: order of numbers and times, poses, frames."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterator, MutableMapping
from typing import NamedTuple

import numpy as np

from remaster_ros.types import (
    IntArray,
    Measurements,
)

SPLITS = ('optimization', 'validation', 'reference')


class RowKeys(NamedTuple):
    """Fields of a row of observations.csv that the rules between rows depend on."""

    line: int
    observation: int
    pose: int
    configuration: int
    split: int
    stamp_s: float
    sensor: int
    marker: int
    frame: int


class SequenceRules:
    """Rules between the rows of observations.csv, and the rows accepted so far.

    Observation numbers are unique and grow with time, time never runs backwards, a pose
    belongs to one split and a configuration to one pose. The rows of a frame are of one
    configuration and of different markers.
    """

    def __init__(self) -> None:
        self._last: RowKeys | None = None
        self._of_observation: MutableMapping[int, RowKeys] = {}
        self._of_pose: MutableMapping[int, RowKeys] = {}
        self._of_configuration: MutableMapping[int, RowKeys] = {}
        self._of_frame: MutableMapping[tuple[int, int], RowKeys] = {}
        self._in_frame: MutableMapping[tuple[int, int, int], RowKeys] = {}

    def branch(self) -> SequenceRules:
        """Return a copy, to which rows can be added without changing this one."""
        rules = SequenceRules()
        rules._last = self._last
        rules._of_observation = ChainMap({}, self._of_observation)
        rules._of_pose = ChainMap({}, self._of_pose)
        rules._of_configuration = ChainMap({}, self._of_configuration)
        rules._of_frame = ChainMap({}, self._of_frame)
        rules._in_frame = ChainMap({}, self._in_frame)
        return rules

    def problem(self, row: RowKeys) -> str:
        """Return the rule that the next row breaks ("column …: …; remedy"); '' if valid.

        The row is not added: see `accept`.
        """
        same = self._of_observation.get(row.observation)
        if same is not None:
            return (
                f'column observation: {row.observation} is already on line {same.line}; '
                'number every row once'
            )
        last = self._last
        if last is not None and row.observation < last.observation:
            return (
                f'column observation: {row.observation} comes after {last.observation}; '
                'number the rows in the order measured'
            )
        if last is not None and row.stamp_s < last.stamp_s:
            return (
                f'column stamp_s: {row.stamp_s} is before the row above it ({last.stamp_s}): '
                'time runs backwards; give the rows in the order measured'
            )
        same = self._of_pose.get(row.pose)
        if same is not None and same.split != row.split:
            return (
                f'column split: pose {row.pose} is {SPLITS[same.split]} on line '
                f'{same.line} and {SPLITS[row.split]} here; give a pose one split'
            )
        same = self._of_configuration.get(row.configuration)
        if same is not None and same.pose != row.pose:
            return (
                f'column configuration: {row.configuration} belongs to pose {same.pose} on line '
                f'{same.line} and to pose {row.pose} here; give a configuration one pose'
            )
        same = self._of_frame.get((row.sensor, row.frame))
        if row.frame >= 0 and same is not None and same.configuration != row.configuration:
            return (
                f'column frame: {row.frame} belongs to configuration {same.configuration} on line '
                f'{same.line} and to {row.configuration} here; give every frame its own number'
            )
        same = self._in_frame.get((row.sensor, row.frame, row.marker))
        if row.frame >= 0 and same is not None:
            return (
                f'column marker: frame {row.frame} of this sensor has this marker on line '
                f'{same.line} already; a frame has each marker once'
            )
        return ''

    def accept(self, row: RowKeys) -> None:
        """Add a valid row; it is not checked again."""
        self._last = row
        self._of_observation[row.observation] = row
        self._of_pose.setdefault(row.pose, row)
        self._of_configuration.setdefault(row.configuration, row)
        if row.frame >= 0:
            self._of_frame.setdefault((row.sensor, row.frame), row)
            self._in_frame[row.sensor, row.frame, row.marker] = row


def split_indices(m: Measurements) -> IntArray:
    """Return each row's index into `SPLITS`: 0 optimization, 1 validation, 2 reference, (n,)."""
    index = m.is_validation.astype(np.int64)
    if m.is_reference is not None:
        index[m.is_reference] = SPLITS.index('reference')
    return index


def row_keys(m: Measurements, first_line: int) -> Iterator[RowKeys]:
    """Return an iterator of the keys of every row; the first row is on line ``first_line``."""
    lines = range(first_line, first_line + len(m))
    frame = np.full(len(m), -1) if m.frame is None else m.frame
    columns = (
        *(m.observation, m.pose, m.configuration, split_indices(m), m.stamp_s),
        *(m.sensor, m.marker, frame),
    )
    # Plain Python numbers: dictionaries of NumPy scalars are slow.
    return map(RowKeys, lines, *(column.tolist() for column in columns))
