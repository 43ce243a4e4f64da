# SPDX-License-Identifier: Apache-2.0
"""Data frames (pandas, or objects with its columns, index and itertuples) as text tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.named import first_names
from remaster_ros.importing.text_table import TextTable, table_of_text

# Name of a column that counts rows; `columns` knows the word.
_INDEX = 'index'


def is_frame(given: Any) -> bool:
    """Whether an object is a data frame with the interface of pandas.

    It has ``columns``, ``index`` and ``itertuples``.
    """
    return all(hasattr(given, name) for name in ('columns', 'index', 'itertuples'))


def tables_of(frames: Sequence[Any], names: Sequence[str]) -> list[TextTable]:
    """Data frames as text tables, one for each; `names`: what the tables are called in messages.

    The index becomes a column, ``time`` or ``index``, unless the index of each frame just
    counts its rows from 0 on. Raises InputError if there are several frames and one has the
    same index label twice.
    """
    plain = all(_counts(frame) for frame in frames)
    for frame, name in zip(frames, names):
        labels = [*frame.index]
        if len({*labels}) < len(labels) and len(frames) > 1:
            twice = next(label for label in labels if labels.count(label) > 1)
            raise InputError(f'{name}: two rows have the index {twice!r}; give each row its own')
    return [_table_of(frame, name, not plain) for frame, name in zip(frames, names)]


def _counts(frame: Any) -> bool:
    """Whether the index of a frame counts the rows from 0 on."""
    return [*frame.index] == [*range(len(frame.index))]


def _table_of(frame: Any, name: str, with_index: bool) -> TextTable:
    """Text table of a data frame; its index is the first column if `with_index`.

    Levels of column names are joined by a blank. A table whose columns are merely counted, as
    those of an array, has no header; a number among names becomes a name, such as 'column 3'.
    Rows without a value are left out, with a note.
    """
    header = [' '.join(map(str, c)) if isinstance(c, tuple) else str(c) for c in frame.columns]
    named = not all(map(_is_number, header))
    # A header with numbers would be read as a row of data.
    header = [f'column {text}' if _is_number(text) else text for text in header]
    rows = [[_cell(value) for value in row] for row in frame.itertuples(index=False, name=None)]
    empty = [str(i) for i, row in enumerate(rows) if not any(row)]
    if with_index:
        timed = all(hasattr(label, 'isoformat') for label in frame.index)
        header = ['time' if timed and 'time' not in header else _INDEX, *header]
        # A row of empty cells is left out by the reader, so that the others keep their numbers.
        rows = [[_cell(label) if any(row) else '', *row] for label, row in zip(frame.index, rows)]
    text = io.StringIO()
    writer = csv.writer(text, delimiter='\t', lineterminator='\n')
    writer.writerows([header] * named + rows)
    table = table_of_text(text.getvalue(), Path(name))
    note = f'{name}, row{"s" * (len(empty) > 1)} {first_names(empty)}: no value, left out'
    return replace(
        table,
        counted='row',
        lines=tuple(line - 1 - named for line in table.lines),
        rows_in_order=0 if with_index else len(rows),
        notes=(*table.notes, *(note,) * bool(empty)),
    )


def _is_number(label: str) -> bool:
    """Whether the label of a column is a number, as Python writes it."""
    try:
        float(label)
    except ValueError:
        return False
    return True


def _cell(value: Any) -> str:
    """A value as text: full precision, ISO 8601 for times, '' for NaN and None."""
    if value is None or value != value:
        return ''
    text = value.isoformat() if hasattr(value, 'isoformat') else str(value)
    return ' '.join(text.split())
