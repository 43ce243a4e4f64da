# SPDX-License-Identifier: Apache-2.0
"""Meaning of the columns of a table: joints, points, orientations, time, names and others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain as flat

from remaster_ros.importing.text_table import TextTable


@dataclass
class Columns:
    """Meaning of each column of a table, by index from 0; None and empty if there is none."""

    # Base to tip.
    joints: tuple[int, ...] = ()
    from_joints: tuple[int, ...] = ()
    # Measured torques of the joints, N m; () if there are none.
    efforts: tuple[int, ...] = ()
    # Marker ('' for a single one without a name) -> columns X, Y and Z, their standard deviations,
    # and the quaternion x, y, z, w if it was measured.
    points: dict[str, tuple[int, ...]] = field(default_factory=dict)
    stds: dict[str, tuple[int, ...]] = field(default_factory=dict)
    orientations: dict[str, tuple[int, ...]] = field(default_factory=dict)
    # Columns of an orientation without a stated convention: three angles, or a quaternion whose
    # components have no letters.
    ambiguous_orientation: tuple[int, ...] = ()
    # Kind (``name``, ``time``, ``pose``, …) -> columns.
    others: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    # Column -> unit of its header.
    units: dict[int, str] = field(default_factory=dict)
    # Column -> where its meaning comes from: ``header``, ``told`` (by the user) or ``place``.
    origin: dict[int, str] = field(default_factory=dict)

    @property
    def point(self) -> tuple[int, ...]:
        """Columns X, Y and Z of all markers, one marker after the other."""
        return tuple(flat.from_iterable(self.points.values()))

    def first_of_kind(self, kind: str) -> int | None:
        """Index of the first column of a kind such as ``time``; None if there is none."""
        return next(iter(self.others.get(kind, ())), None)


Table = tuple[TextTable, Columns]


@dataclass(frozen=True)
class ColumnChoice:
    """Columns that the user chose, by name or by number from 1; '' and () if not chosen."""

    joints: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    time: str = ''
    names: str = ''


def claim(found: Columns, columns: Sequence[int], taken: set[int]) -> None:
    """Add columns to `taken`, and note in `found.origin` that their header gave the meaning."""
    taken.update(columns)
    found.origin.update(dict.fromkeys(columns, 'header'))
