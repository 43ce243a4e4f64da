# SPDX-License-Identifier: Apache-2.0
"""A data frame with no more of pandas than the import uses, for machines without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any


class Frame:
    """Columns by their names, and an index."""

    def __init__(self, columns: dict[Any, Sequence[Any]], index: Sequence[Any] | None = None):
        self._values = {name: list(values) for name, values in columns.items()}
        size = len(next(iter(self._values.values())))
        self.columns = [*self._values]
        self.index = list(range(size)) if index is None else list(index)

    def itertuples(
        self, index: bool = True, name: str | None = 'Row'
    ) -> Iterator[tuple[Any, ...]]:
        assert (index, name) == (False, None)
        return zip(*self._values.values(), strict=True)

    def take(self, rows: Sequence[int]) -> Frame:
        """Return some of the rows, with their labels."""
        return Frame(
            {name: [values[i] for i in rows] for name, values in self._values.items()},
            [self.index[i] for i in rows],
        )
