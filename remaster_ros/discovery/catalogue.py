"""All cells that can be tried, with what each of their columns displaces at hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Columns that are worked on at a time.
CHUNK = 1024


@dataclass(frozen=True, eq=False)
class Catalogue:
    """All cells that can be tried on these rows, with their columns at hand.

    Attributes
    ----------
    cells
        As the effects gave them.
    starts
        First column of each cell, and the number of columns, (cells + 1,).
    at
        Joint of each column, -1 where it displaces, (columns,).
    features
        Added angles of the columns at joints, (n, joint columns), in order.
    shifts
        Displacements of the other columns, (n, 3, others), in order.
    position
        Where each column is among the features or the shifts, (columns,).
    """

    cells: tuple[Cell, ...]
    starts: IntArray
    at: IntArray
    features: FloatArray
    shifts: FloatArray
    position: IntArray
    jacobian: FloatArray

    @classmethod
    def of(cls, data: Residuals, cells: Sequence[Cell]) -> Catalogue:
        """Compute all columns on the rows of the residuals, in single precision."""
        context = data.part
        at, features, shifts = [], [], []
        for cell in cells:
            columns = cell.columns(context)
            values = columns.values.astype(np.float32)
            if columns.at is None:
                at += [-1] * cell.size
                shifts.append(values)
            else:
                at += [columns.at] * cell.size
                features.append(values)
        joint = np.array(at, dtype=np.int64)
        position = np.where(joint >= 0, np.cumsum(joint >= 0), np.cumsum(joint < 0)) - 1
        n = len(data)
        return cls(
            tuple(cells),
            np.cumsum([0, *(cell.size for cell in cells)]),
            joint,
            np.concatenate([np.zeros((n, 0), np.float32), *features], axis=1),
            np.concatenate([np.zeros((n, 3, 0), np.float32), *shifts], axis=2),
            position,
            context.jacobian.astype(np.float32),
        )

    @cached_property
    def cheap(self) -> BoolArray:
        """Which cells are not too many to be tried again and again, (cells,)."""
        return np.array([not EFFECTS[cell.name].costly for cell in self.cells], dtype=bool)

    @cached_property
    def structure(self) -> BoolArray:
        """Which cells locate structure and claim no cause, (cells,)."""
        return np.array([not EFFECTS[cell.name].is_cause for cell in self.cells], dtype=bool)

    def which(self, cells: Sequence[Cell]) -> BoolArray:
        """Return which cells of the catalogue are among others, (cells,)."""
        found = np.zeros(len(self.cells), dtype=bool)
        found[[self.places[cell.key] for cell in cells if cell.key in self.places]] = True
        return found

    @cached_property
    def places(self) -> dict[object, int]:
        """Index of each cell by its key."""
        return {cell.key: index for index, cell in enumerate(self.cells)}

    def block(self, columns: IntArray) -> NDArray[np.float32]:
        """Return displacements of the given columns, (n, 3, c), single precision."""
        at, position = self.at[columns], self.position[columns]
        angle = at >= 0
        turned: NDArray[np.float32] = np.take(self.jacobian, at[angle], axis=2)
        turned *= np.take(self.features, position[angle], axis=1)[:, None]
        if angle.all():
            return turned
        block = np.empty((len(self.jacobian), 3, len(columns)), np.float32)
        block[:, :, angle] = turned
        block[:, :, ~angle] = np.take(self.shifts, position[~angle], axis=2)
        return block

    @cached_property
    def joint(self) -> IntArray:
        """Joint of the columns of each cell, -1 where they displace, (cells,)."""
        return self.at[self.starts[:-1]]

    @cached_property
    def sizes(self) -> IntArray:
        """Number of columns of each cell, (cells,)."""
        return np.diff(self.starts)

    @cached_property
    def penalised(self) -> BoolArray:
        """Which cells are free forms with a penalty, (cells,)."""
        return np.array([cell.penalty is not None for cell in self.cells], dtype=bool)

    def columns(self, batch: IntArray) -> IntArray:
        """Return the columns of some cells, one cell after the other."""
        edges = zip(self.starts[batch], self.starts[batch + 1], strict=True)
        return np.concatenate([np.arange(first, last) for first, last in edges])

    def batches(self, chosen: IntArray, *, by_joint: bool = False) -> Iterator[IntArray]:
        """Give batches of cells of equal size and kind, about `CHUNK` columns each.

        Where wanted of one joint each.
        """
        alike = np.stack((self.sizes, self.penalised, self.joint * by_joint), axis=1)[chosen]
        kinds, kind_of = np.unique(alike, axis=0, return_inverse=True)
        for kind, (size, _, _) in enumerate(kinds):
            mine = chosen[kind_of.ravel() == kind]
            step = max(1, CHUNK // int(size))
            for start in range(0, len(mine), step):
                yield mine[start : start + step]
