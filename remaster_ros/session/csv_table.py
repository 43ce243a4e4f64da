"""A CSV file's cells as columns of numbers and names; every fault names line and column."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.types import BoolArray, FloatArray, IntArray

_NUMBER = re.compile(r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_NUMBER_CHARACTERS = re.compile(r'[0-9+\-.eE,]*')
_INTEGER_CHARACTERS = re.compile(r'[0-9+\-,]*')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')


class Table:
    """Cells as text by column name, with what an error message needs to name a place."""

    def __init__(self, path: Path, names: list[str], lines: list[str], first_line: int) -> None:
        self.path = path
        self.first_line = first_line
        self.rows = len(lines)
        width = len(names)
        for number, line in enumerate(lines, start=first_line):
            # Without quotes, counting commas is counting columns.
            found = len(split_line(line, path, number)) if '"' in line else line.count(',') + 1
            if found != width:
                raise InputError(
                    f'{path}, line {number}: {found} columns instead of the {width} of the '
                    'header; give every column, empty where unknown'
                )
        text = ','.join(lines)
        # One flat list: millions of cells in a list per row would keep the garbage collector busy.
        cells = split_line(text, path, first_line) if '"' in text else text.split(',')
        self.cells = {name: cells[i::width] for i, name in enumerate(names)}

    def fault(self, row: int, column: str, problem: str) -> InputError:
        """Return the error for one cell."""
        cell = self.cells[column][row]
        shown = repr(cell if len(cell) <= 40 else cell[:40] + '…')
        line = self.first_line + row
        return InputError(f'{self.path}, line {line}, column {column}: {shown} {problem}')

    def refuse(self, wrong: BoolArray, problems: Mapping[str, str]) -> None:
        """Raise the fault of the first True of `wrong`, (n, columns); `problems` by column."""
        for row, column in np.argwhere(wrong)[:1]:
            name = list(problems)[column]
            raise self.fault(int(row), name, problems[name])

    def integers(self, column: str, least: int | None = None) -> IntArray:
        """Return a column of integers.

        With `least` it is an optional column, of integers from `least` (above -1) on; -1 stands
        for an empty cell.
        """
        given = self.cells[column]
        cells = given if least is None else [cell or '-1' for cell in given]
        try:
            values = np.array(list(map(int, cells)), dtype=np.int64)
        except (ValueError, OverflowError):
            values = None
        # int() also reads 1_000, blanks and other scripts' digits.
        if values is None or not _INTEGER_CHARACTERS.fullmatch(','.join(cells)):
            row = next(i for i, cell in enumerate(cells) if not _INTEGER.fullmatch(cell))
            raise self.fault(row, column, 'is not an integer; correct it')
        if least is not None:
            few = (values < least) & (np.array(given) != '')
            self.refuse(
                few[:, None], {column: f'is less than {least}; leave it empty where unknown'}
            )
        return values

    def numbers(self, columns: Sequence[str], optional: bool = False) -> FloatArray:
        """Return columns of finite numbers, (n, len(columns)); NaN where optional and empty."""
        result = np.empty((self.rows, len(columns)))
        for i, column in enumerate(columns):
            cells = self.cells[column]
            empty, blank = (cells.count(''), 'nan') if optional else (0, '')
            try:
                result[:, i] = [float(cell or blank) for cell in cells]
            except ValueError:
                raise self._not_a_number(column, optional) from None
            # float() also reads nan, inf, 1_000, blanks and other scripts' digits.
            plain = _NUMBER_CHARACTERS.fullmatch(','.join(cells))
            if not plain or np.count_nonzero(np.isfinite(result[:, i])) + empty < self.rows:
                raise self._not_a_number(column, optional)
        return result

    def whole_or_empty(self, columns: Sequence[str]) -> FloatArray:
        """Return optional columns of which a row fills all or none."""
        values = self.numbers(columns, optional=True)
        unknown = np.isnan(values)
        problem = (
            f'is empty though others of {columns[0]} … {columns[-1]} are not; fill all of them or '
            'none'
        )
        self.refuse(unknown & ~unknown.all(axis=1, keepdims=True), dict.fromkeys(columns, problem))
        return values

    def choices(self, column: str, names: Sequence[str], remedy: str) -> IntArray:
        """Return the index of every cell among `names`."""
        index = {name: i for i, name in enumerate(names)}
        values = np.array([index.get(cell, -1) for cell in self.cells[column]], dtype=np.int64)
        self.refuse(values[:, None] < 0, {column: remedy})
        return values

    def _not_a_number(self, column: str, optional: bool) -> InputError:
        row = next(
            row
            for row, cell in enumerate(self.cells[column])
            if not (optional and not cell)
            and not (_NUMBER.fullmatch(cell) and math.isfinite(float(cell)))
        )
        remedy = 'leave the field empty where unknown' if optional else 'leave the row out'
        return self.fault(row, column, f'is not a finite number; correct it or {remedy}')


def split_line(line: str, path: Path, number: int) -> list[str]:
    """Return the cells of one line; an `InputError` where its quotes do not close."""
    if '"' not in line:
        return line.split(',')
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError(f'{path}, line {number}: {error}; correct the quotes') from None
