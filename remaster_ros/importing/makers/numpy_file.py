# SPDX-License-Identifier: Apache-2.0
"""Arrays that NumPy has saved (.npy, .npz), with a row for each configuration, as text."""

from __future__ import annotations

import io
import zipfile
from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.archive import damage_as_input_error

_FEWEST_ROWS = 2
# Largest number of values in an unpacked array.
_LIMIT = 64 * 1024**2


def read(data: bytes) -> dict[str, str] | None:
    """Arrays of a .npy or .npz file as tab-separated text, by name; None for other files.

    Arrays with equally many rows are columns of one text, by the name of the first; those of
    fewer than two rows are left out. The name is '' for a .npy file. Raises InputError for
    damaged files, arrays of over 512 MiB, or arrays that are no table.
    """
    if data.startswith(b'\x93NUMPY'):
        array = _loaded(data, '')
        # Columns of numbers alone have no names.
        labels, cells = _columns(array, '', '')
        return {'': _as_text(labels if array.dtype.names else [], cells)}
    if not data.startswith(b'PK\x03\x04'):
        return None
    arrays: dict[str, NDArray[Any]] = {}
    with damage_as_input_error(), zipfile.ZipFile(io.BytesIO(data)) as parts:
        for info in parts.infolist():
            if info.filename.endswith('.npy'):
                if info.file_size > 8 * _LIMIT:
                    raise InputError(f'{info.filename} in it has more than {_LIMIT} numbers')
                name = info.filename.removesuffix('.npy')
                arrays[name] = _loaded(parts.read(info), f'{name}: ')
    by_rows: dict[int, list[str]] = defaultdict(list)
    for name, array in arrays.items():
        if array.ndim and len(array) >= _FEWEST_ROWS:
            by_rows[len(array)].append(name)
    found = {}
    for names in by_rows.values():
        header: list[str] = []
        columns: list[list[str]] = []
        for name in names:
            names_of, array_columns = _columns(arrays[name], name, f'{name}: ')
            header += names_of
            columns += array_columns
        found[names[0]] = _as_text(header, columns)
    return found


def _loaded(data: bytes, where: str) -> NDArray[Any]:
    """Array in the bytes of a .npy file; raises InputError, beginning with `where`, if damaged."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:
        # Of a damaged head NumPy raises what its tokens and types lead to.
        what = ' '.join(str(error).split())[:80]
        raise InputError(
            f'{where}no array of numbers that can be read ({what}); save it with numpy.save as '
            'plain numbers'
        ) from None
    return np.asarray(array)


def _columns(array: NDArray[Any], name: str, where: str) -> tuple[list[str], list[list[str]]]:
    """Names of an array's columns, and their cells as text, column by column.

    The first dimension, of three at most, has the rows; the others are flattened: a matrix for
    each row becomes one column for each of its numbers. A structured array has the names of
    its fields, others begin with `name`. Raises InputError, beginning with `where`, for other
    shapes or types.
    """
    if array.dtype.names:
        fields = [_columns(array[field], field, where) for field in array.dtype.names]
        return [label for header, _ in fields for label in header], [
            column for _, field in fields for column in field
        ]
    if not 0 < array.ndim <= 3 or array.dtype.kind not in 'fiuUSM':
        raise InputError(
            f'{where}an array of shape {array.shape} and type {array.dtype}, where numbers with a '
            'row for each configuration are expected'
        )
    if array.dtype.kind == 'S':
        array = np.char.decode(array, 'latin-1')
    flat = array.reshape(len(array), -1)
    columns = [[str(value) for value in column] for column in flat.T]
    return _labels(name, len(columns)), columns


def _labels(name: str, width: int) -> list[str]:
    """Names of an array's columns: `name` alone if `width` is 1, else numbered or x, y, z.

    ``name x``, ``name y`` and ``name z`` for three, else ``name 1`` and so on.
    """
    if width == 1:
        return [name]
    return [f'{name} {suffix}' for suffix in ('xyz' if width == 3 else range(1, width + 1))]


def _as_text(header: list[str], columns: list[list[str]]) -> str:
    """Tab-separated text of columns, below a header if any; white space becomes a blank."""
    rows = [header] if header else []
    rows += [list(row) for row in zip(*columns)]
    clean = (' '.join(cell.split()) for row in rows for cell in row)
    width = len(columns)
    cells = [*clean]
    return ''.join(
        '\t'.join(cells[i : i + width]) + '\n' for i in range(0, len(cells), width or 1)
    )
