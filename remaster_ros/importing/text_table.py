# SPDX-License-Identifier: Apache-2.0
"""Text tables of any program: encoding, separator, decimal sign, and cells by line."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing import by_axis
from remaster_ros.importing.makers import READERS, UNPACKERS
from remaster_ros.importing.makers.named import NamedColumns, first_names
from remaster_ros.importing.units import bare, is_unit, split_unit
from remaster_ros.session.files import cpu_limited, read_limited
from remaster_ros.types import IntArray

TABLE_LIMIT = 256 * 1024**2
# Limit of processor time for reading a file, s, and for each MiB of it: five times that of the
# slowest plain table (test_reading_time).
CPU_S, CPU_S_PER_MIB = 30.0, 5.0
# An export of Motive with five skeletons and 300 markers has 4,000 columns; the longest name seen
# (a path of SpatialAnalyzer) has 200 characters.
MOST_COLUMNS, LONGEST_NAME = 5_000, 1_000
# Separators in order of preference if several explain a table equally well; blanks come last.
SEPARATORS = {';': 'semicolons', '\t': 'tabs', ',': 'commas', '|': 'bars', ' ': 'blanks'}
# Number of lines from which the separator is found.
SEEN_LINES = 2000
# Stands for the encoding of a table that was no text file: a workbook, an array.
CELLS = 'cells'
_COMMENT = re.compile(r'\s*(?:#|//|%|!|\*)\s*')
_PLAIN = re.compile(r'[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?', re.ASCII)
# Groups of three digits, as spreadsheets like to write thousands, and then a decimal sign.
_THOUSANDS = re.compile(r'[+-]?\d{1,3}(?:([.,])\d{3})(?:\1\d{3})*[.,]\d+', re.ASCII)
# A number whose unit stands in its cell, as spreadsheets show one.
_WITH_UNIT = re.compile(r'([+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(°|º|deg|rad|gon|µm|μm|mm|cm|m|in)')
# Marks that programs write in a field without a value.
_MISSING = {
    *('nan', 'none', 'null', 'nil', 'na', 'n/a', 'n.a.', '#n/a', '#na', '#nv', '<na>', 'nat'),
    *('-', '--', '---', '–', '—', '?'),
}
# Groups of three digits separated by blanks or apostrophes; a number that shows that a column
# does not have such groups.
_GROUPED = re.compile("[+-]?\\d{1,3}(?:[ \u00a0\u2009\u202f'’]\\d{3})+(?:[.,]\\d+)?", re.ASCII)
_BETWEEN_GROUPS = re.compile("[ \u00a0\u2009\u202f'’]")
_UNGROUPED = re.compile(r'[+-]?\d{4,}(?:[.,]\d*)?', re.ASCII)
# The line below the names of a table in Markdown, and the frame of one in ASCII.
_ORNAMENT = re.compile(r'[\s|+:=-]+')
_NUMBERS = re.compile(r'(?<![\w.,])[+-]?\d+(?:[.,]\d*)?(?!\w)')
_LIST = re.compile(r'[\[(]([^\[\]()]*)[\])]')
# Numbers in the cell of a row: joints, points and matrices have fewer. An empty cell of such a
# column stands for as many columns. A number of double precision with blanks has fewer letters.
_LONGEST_LIST, _LONGEST_NUMBER = 100, 40
_MARKUP = re.compile(r'\s*<(?:!DOCTYPE|\?xml|html|table)\b', re.IGNORECASE)
_NEVER = re.compile(r'(?!)')
# Blanks, but not those before a unit in brackets: `X [mm]  Y [mm]`.
_BLANKS = re.compile(r'\s+(?![\[(])')
# A row of the table has the joints of the smallest arm at least.
_FEWEST_NUMBERS = 2
# A later separator is preferred if it gives this factor more numbers: titles give some.
_MORE = 1.25
# Words that name a line which sums up those above it.
_SUMS = {
    *('mean', 'average', 'avg', 'median', 'min', 'minimum', 'max', 'maximum', 'range', 'rms'),
    *('std', 'stdev', 'stddev', 'dev', 'deviation', 'sigma', 'sum', 'total', 'value', 'error'),
    *('mittelwert', 'mittel', 'summe', 'spannweite', 'standardabweichung', 'moyenne', 'somme'),
    *('media', 'promedio', 'suma', 'somma'),
}
# First words of other lines that are no rows: of pages, and at the end.
_PAGES = {
    *('page', 'seite', 'pagina', 'página', 'sheet', 'blatt', 'end', 'ende', 'fin', 'fine', 'eof'),
    *('report', 'bericht', 'rapport', 'number', 'count', 'anzahl', 'nombre', 'points', 'punkte'),
    *('printed', 'gedruckt', 'created', 'erstellt', 'total', 'summe'),
}
_WORD = re.compile(r'[^\W\d_]+')
_SHOWN = 40


@dataclass(frozen=True, eq=False, kw_only=True)
class TextTable(NamedColumns):
    """Cells of a table as text, with the line of each row in the file."""

    path: Path  # The file, for messages
    # Character encoding of the file, such as ``UTF-8``; `CELLS` if it was no text file
    encoding: str
    part: str = ''  # Sheet of a workbook that has several tables
    counted: str = 'line'  # What `lines` counts, for messages
    # Rows of a data frame whose index counts from 0, dropped rows included; 0 for other tables
    rows_in_order: int = 0
    separator: str = ''
    preamble: str = ''  # Title and comment lines

    def describe(self) -> str:
        """File, number of rows, separator, decimal sign and encoding, as text.

        Of a maker's format its name in place of these, of a workbook or array 'rows of cells'.
        """
        if self.kind:
            return f'{self.path}: {len(self.rows)} rows of {self.kind}'
        if self.encoding == CELLS:
            return f'{self.path}: {len(self.rows)} rows of cells'
        sign = 'comma' if self.decimal == ',' else 'point'
        header = '' if self.has_header else ', no header'
        return (
            f'{self.path}: {len(self.rows)} rows; {SEPARATORS.get(self.separator, "cells")} '
            f'between the columns, decimal {sign}, {self.encoding}{header}'
        )

    def at(self, row: int) -> str:
        """File and line of a row, counted from 0."""
        return f'{self.path}, {self.counted} {self.lines[row]}'

    def at_rows(self, rows: Iterable[int]) -> str:
        """File and lines of rows, counted from 0, of which the first five are listed."""
        lines = [str(self.lines[row]) for row in rows]
        return f'{self.path}, {self.counted}{"s" * (len(lines) > 1)} {first_names(lines)}'

    def fault(self, row: int, column: int, problem: str) -> InputError:
        """InputError on one cell, with file, line, column and content; both indices from 0."""
        cell = self.rows[row][column]
        shown = repr(cell if len(cell) <= 40 else cell[:40] + '…')
        return InputError(f'{self.at(row)}, column {self.names[column]}: {shown} {problem}')

    def number(self, row: int, column: int) -> float | None:
        """Number in a cell; None if it is empty or a mark for a missing value.

        Indices from 0. Raises InputError if it is other text.
        """
        cell = self.rows[row][column]
        value = parse_number(cell, self.decimal) if cell else None
        if value is None and not is_missing(cell):
            raise self.fault(row, column, 'is not a number; correct it or remove the row')
        return value

    def select(self, rows: Iterable[int]) -> TextTable:
        """Table with some of the rows (indices from 0), in the order given."""
        kept = list(rows)
        return replace(
            self,
            rows=tuple(self.rows[row] for row in kept),
            lines=tuple(self.lines[row] for row in kept),
        )


def is_missing(cell: str) -> bool:
    """Whether a cell is empty or a mark for a missing value: ``n/a``, ``-``, …, in any case."""
    return not cell or cell.lower() in _MISSING


def parse_number(cell: str, decimal: str) -> float | None:
    """Finite number of a cell; None if the cell is no number.

    `decimal`: decimal sign, ',' or '.'. The other one is allowed between groups of three digits if
    the decimal sign follows.
    """
    other = '.' if decimal == ',' else ','
    if _THOUSANDS.fullmatch(cell) and cell.count(decimal) == 1 and _last_sign(cell) == decimal:
        cell = cell.replace(other, '')
    if not _PLAIN.fullmatch(cell) or other in cell:
        return None
    value = float(cell.replace(',', '.'))
    return value if abs(value) < float('inf') else None


def read_table(
    path: Path, separator: str = '', decimal: str = '', encoding: str = ''
) -> TextTable:
    """Read a file with one table; separator, decimal sign and encoding are found if not given.

    Raises
    ------
    InputError
        One line naming file, line and remedy: no text, no numbers, rows of unequal length, or
        several tables.
    """
    tables = read_tables(path, separator, decimal, encoding)
    if len(tables) > 1:
        listed = ', '.join(table.part for table in tables)
        raise InputError(f'{path}: {len(tables)} tables ({listed}); name one with --sheet')
    return tables[0]


def table_of_text(text: str, path: Path) -> TextTable:
    """Table of a tab-separated text in memory; `path` is its name in messages.

    Raises InputError as `read_table`.
    """
    return _table(text, path, '\t', '.', CELLS)


def read_tables(
    path: Path,
    separator: str = '',
    decimal: str = '',
    encoding: str = '',
    sheets: Sequence[str] = (),
) -> list[TextTable]:
    """Read the tables of a file: one of each sheet of a workbook, else one.

    `sheets` are the names of the sheets to read; () for all with numbers. Raises InputError as
    `read_table`, for an unknown sheet, and if reading exceeds 30 s of processor time and 5 s for
    each MiB.
    """
    data = read_limited(path, TABLE_LIMIT, 'name the table')
    if data.startswith(b'\x1f\x8b'):
        data = _decompressed(data, path)
    limit_s = CPU_S + CPU_S_PER_MIB * len(data) / 1024**2
    refusal = (
        f'{path}: not read after {limit_s:.0f} s of processor time, many times what a file of its '
        'size takes; take out what is no row of joints or points'
    )
    with cpu_limited(limit_s, refusal):
        for unpack in UNPACKERS:
            try:
                parts = unpack(data)
            except InputError as error:
                raise InputError(f'{path}: {error}') from None
            if parts is not None:
                return _tables_of_sheets(parts, path, decimal, sheets)
        text, encoding = decode(data, path, encoding)
        return [_table(text, path, separator, decimal, encoding)]


def _tables_of_sheets(
    parts: Mapping[str, str], path: Path, decimal: str, sheets: Sequence[str]
) -> list[TextTable]:
    """Tables with rows of numbers, of the sheets of a workbook or the arrays of an archive.

    `parts`: name -> tab-separated text. Sheets that are no tables are left out, with a note on the
    first table, unless the user named them. Raises InputError if none is left or a name is
    unknown.
    """
    folded = {name.casefold(): name for name in parts}
    for name in sheets:
        if name.casefold() not in folded:
            raise InputError(f'--sheet {name}: {path} has {", ".join(parts) or "none"}')
    chosen = [folded[name.casefold()] for name in sheets] or [*parts]
    tables: list[TextTable] = []
    problems = []
    for name in chosen:
        try:
            tables.append(_table(parts[name], path, '\t', decimal, CELLS, name))
        except InputError as error:
            # Notes, charts and lists of parameters stand on sheets of their own.
            if sheets or len(chosen) == 1:
                raise
            problems.append(f'{name} left out: {error}')
    if not tables:
        raise InputError(
            problems[0] if problems else f'{path}: no sheet that is shown has anything in it'
        )
    if len(tables) == 1:
        tables = [replace(tables[0], part='')]
    else:
        tables = [replace(table, path=Path(f'{path}:{table.part}')) for table in tables]
    tables[0] = replace(tables[0], notes=(*tables[0].notes, *problems))
    return tables


def _table(
    text: str, path: Path, separator: str, decimal: str, encoding: str, part: str = ''
) -> TextTable:
    """Table of a text, by the makers' readers or as plain text.

    `part` is the sheet of a workbook; `separator` and `decimal` are found if ''. Raises InputError
    as `read_table`.
    """
    for read in READERS:
        try:
            found = read(text)
        except InputError as error:
            raise InputError(f'{path}, {error}') from None
        if found is not None:
            return _bounded(TextTable(path=path, encoding=encoding, part=part, **vars(found)))
    if _MARKUP.match(text):
        raise InputError(f'{path}: this is HTML or XML, not a table; save it as CSV')
    text = text.replace('\r\n', '\n').replace('\r', '\n').replace('\u2212', '-')
    lines = [
        (number, line)
        for number, line in enumerate(text.split('\n'), start=1)
        if line.strip().strip(''.join(SEPARATORS)) and not _is_ornament(line)
    ]
    comment = _COMMENT
    plain = [line for _, line in lines if not comment.match(line)]
    if not any(len(_NUMBERS.findall(line)) >= _FEWEST_NUMBERS for line in plain):
        # Names of points may begin as comments do.
        comment, plain = _NEVER, [line for _, line in lines]
    separator = separator or _find_separator(plain[:SEEN_LINES])
    split = _with_lists_as_columns(
        [(number, line, _split(line, separator, path, number)) for number, line in lines]
    )
    width, first, usual = _first_row(split, path, comment)
    if width > MOST_COLUMNS:
        raise _too_wide(path, split[first][0], width)
    header, preamble, named = _header(split[:first], width, separator, path)
    written = [cells for _, _, cells in split[:named]]
    rows: list[tuple[str, ...]] = []
    at, dropped = [], []
    # Titles may hold numbers; below the names, and where there are none, that is a damaged row.
    above = [entry for entry in split[named:first] if not comment.match(entry[1])]
    damaged = [
        entry
        for entry in above
        if any(map(str.isalnum, entry[1]) if named else map(_is_number, entry[2]))
    ]
    for number, line, cells in (*damaged, *split[first:]):
        if comment.match(line):
            preamble += f'\n{line}'
            continue
        if cells in written:
            # Files that were put together have their names again.
            continue
        # A separator at the end of a line is no further column.
        while len(cells) > width and not cells[-1]:
            cells = cells[:-1]
        numbered = not (named or rows) and _are_counted(cells)
        if numbered or _is_no_row(cells, usual, width):
            dropped.append(f'{number} ({line.strip()[:_SHOWN]})')
            continue
        if len(cells) != width:
            raise InputError(
                f'{path}, line {number}: {len(cells)} columns, where most rows have {width}; '
                'give every row all columns, empty where unknown'
            )
        rows.append(tuple(cells))
        at.append(number)
    while width > 1 and not any(row[width - 1] for row in rows):
        width -= 1
    rows = [row[:width] for row in rows]
    rows, header = _without_units(_without_thousands_separators(rows), header)
    names = tuple(header[:width]) if header else tuple(map(str, range(1, width + 1)))
    try:
        report = by_axis.wide(names, rows, at, lambda cell: _is_number(cell) or not cell)
    except InputError as error:
        raise InputError(f'{path}, {error}') from None
    if report is not None and not header:
        raise InputError(
            f'{path}: rows of X, Y and Z, and no header that tells which is measured; give '
            'it one, such as name;axis;nominal;measured'
        )
    if report is not None:
        names, rows, at = tuple(report[0]), report[1], report[2]
    for name, count in Counter(names).items():
        if name and count > 1:
            raise InputError(f'{path}: two columns are named {name!r}; name them differently')
    found_table = TextTable(
        kind='',
        path=path,
        encoding=encoding,
        part=part,
        separator=separator,
        decimal=decimal or _find_decimal(rows),
        names=tuple(name or str(i) for i, name in enumerate(names, start=1)),
        rows=tuple(rows),
        lines=tuple(at),
        preamble=preamble,
        has_header=bool(header),
        notes=(f'{path}, line{"s" * (len(dropped) > 1)} {first_names(dropped)}: no row, left out',)
        * bool(dropped),
    )
    return _bounded(found_table)


def _bounded(table: TextTable) -> TextTable:
    """Return the table, unchanged, if its columns are not too many, nor their names too long.

    Raises InputError for over 5000 columns, or a name of over 1000 characters.
    """
    if len(table.names) > MOST_COLUMNS:
        raise _too_wide(table.path, min(table.lines, default=1), len(table.names))
    for name in table.names:
        if len(name) > LONGEST_NAME:
            raise InputError(
                f'{table.path}: a column is named {name[:_SHOWN]!r}… ({len(name)} characters); '
                f'give it a name of {LONGEST_NAME} at the most'
            )
    return table


def _too_wide(path: Path, line: int, width: int) -> InputError:
    """InputError of a line with `width` columns, more than MOST_COLUMNS."""
    return InputError(
        f'{path}, line {line}: {width} columns, where {MOST_COLUMNS} at the most are read; give a '
        'line to each configuration, and leave out columns that are neither joints nor points'
    )


def _decompressed(data: bytes, path: Path) -> bytes:
    """Content of gzip data, as of PolyScope's programs.

    Raises InputError if damaged or larger than 256 MiB.
    """
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            unpacked = packed.read(TABLE_LIMIT + 1)
    except (OSError, EOFError, zlib.error):
        raise InputError(f'{path}: packed with gzip, and damaged; take another copy') from None
    if len(unpacked) > TABLE_LIMIT:
        raise InputError(f'{path}: unpacked it is larger than {TABLE_LIMIT // 1024**2} MiB')
    return unpacked


def decode(data: bytes, path: Path, encoding: str = '') -> tuple[str, str]:
    """Text of a file, and the name of its encoding in capitals.

    The `encoding` that is given; else a byte order mark decides, then zeros between Latin letters
    (UTF-16), then whether the bytes are valid UTF-8; else it is Windows' Latin alphabet, which has
    a letter for almost each byte, or Latin-1. Raises InputError if the text contains null
    characters, or the given encoding is unknown or does not fit.
    """
    even, odd = data[:64:2], data[1:64:2]
    if encoding:
        guesses: Sequence[str] = (encoding,)
    elif data.startswith((b'\xff\xfe', b'\xfe\xff')):
        guesses = ('utf-16',)
    elif len(data) > 3 and not any(odd):
        guesses = ('utf-16-le',)
    elif len(data) > 3 and not any(even):
        guesses = ('utf-16-be',)
    else:
        guesses = ('utf-8-sig', 'cp1252', 'latin-1')
    for guess in guesses:
        try:
            text = data.decode(guess)
        except UnicodeDecodeError:
            continue
        except LookupError:
            raise InputError(f'--encoding {encoding}: Python has no such encoding') from None
        if '\0' in text:
            break
        return text, 'UTF-8' if guess == 'utf-8-sig' else guess.upper()
    raise InputError(
        f'{path}: this is no text in {" or ".join(guesses)}; save the table as CSV in UTF-8'
    )


def _split(line: str, separator: str, path: Path, number: int) -> list[str]:
    """Cells of a line without outer blanks. Raises InputError if its quotes are not balanced.

    For the separator ' ' any run of white space separates, but not before a bracket, as of a
    unit. `path`, `number`: for the message.
    """
    if separator == ' ':
        return _BLANKS.split(line.strip())
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise InputError(f'{path}, line {number}: {error}; correct the quotes') from None
    return [cell.strip() for cell in cells]


def _is_ornament(line: str) -> bool:
    """Whether a line is the rule below the header of a table in Markdown or ASCII."""
    return ('--' in line or '==' in line) and bool(_ORNAMENT.fullmatch(line))


def _list_in_cell(cell: str) -> list[str]:
    """Numbers of a list in a cell such as `[0.1, -1.5]`; [] if the cell is no list."""
    found = _LIST.fullmatch(cell) if len(cell) <= _LONGEST_LIST * _LONGEST_NUMBER else None
    cells = re.split(r'\s*[,;]\s*|\s+', found[1].strip()) if found else []
    return cells if 1 < len(cells) <= _LONGEST_LIST and all(map(_PLAIN.fullmatch, cells)) else []


def _with_lists_as_columns(
    split: list[tuple[int, str, list[str]]],
) -> list[tuple[int, str, list[str]]]:
    """Lines of a table with each list in a cell split into a cell for each number.

    A line is its number, text and cells. The first line with lists tells which columns are
    lists, and of how many numbers. In these a missing list becomes empty cells, and the header
    ``name`` becomes ``name x`` to ``name z`` for three numbers, else ``name 1`` and so on.
    """
    first = next((cells for *_, cells in split[:SEEN_LINES] if any(map(_list_in_cell, cells))), [])
    widths = [len(_list_in_cell(cell)) for cell in first]
    if not first:
        return split
    wide = []
    for number, line, cells in split:
        parts: list[str] = []
        for i, cell in enumerate(cells):
            width = widths[i] if len(cells) == len(widths) else 0
            if width and not _list_in_cell(cell) and not is_missing(cell):
                # The name of a column of lists.
                parts += [
                    f'{cell} {suffix}' for suffix in ('xyz' if width == 3 else range(1, width + 1))
                ]
            elif width and is_missing(cell):
                parts += width * ['']
            else:
                parts += _list_in_cell(cell) or [cell]
        wide.append((number, line, parts))
    return wide


def _without_thousands_separators(rows: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Cells without the blanks or apostrophes between groups of three digits.

    Columns that also have a number of four or more digits without them are not changed.
    """
    columns = [*zip(*rows)]
    for i, column in enumerate(columns):
        # One search over the whole column, as logs are large.
        if not _BETWEEN_GROUPS.search('\n'.join(column)):
            continue
        grouped = {cell for cell in column if _GROUPED.fullmatch(cell)}
        if grouped and not any(map(_UNGROUPED.fullmatch, column)):
            plain = {cell: _BETWEEN_GROUPS.sub('', cell) for cell in grouped}
            columns[i] = tuple(plain.get(cell, cell) for cell in column)
    return [*zip(*columns)]


def _without_units(
    rows: list[tuple[str, ...]], header: list[str]
) -> tuple[list[tuple[str, ...]], list[str]]:
    """Rows and header, with the unit that all cells of a column have moved into the header.

    A header that has a unit already keeps it. Columns without a header, with several units, or
    with a cell without one, are not changed.
    """
    header = list(header)
    columns = [*zip(*rows)]
    for i, column in enumerate(columns):
        if not _WITH_UNIT.fullmatch(next((cell for cell in column if not is_missing(cell)), '')):
            continue
        found = {cell: _WITH_UNIT.fullmatch(cell) for cell in column if not is_missing(cell)}
        units = {'' if match is None else match[2] for match in found.values()}
        if len(units) != 1 or '' in units or i >= len(header):
            continue
        (unit,) = units
        plain = {cell: match[1] for cell, match in found.items() if match}
        columns[i] = tuple(plain.get(cell, cell) for cell in column)
        if not split_unit(header[i])[1]:
            header[i] = f'{header[i]} [{unit}]'
    return [*zip(*columns)], header


def _find_separator(lines: Sequence[str]) -> str:
    """Separator that gives most numbers in lines of the commonest number of cells.

    An earlier one of `SEPARATORS` is kept unless a later one gives over 1.25 times as many. '
    ' if none gives lines with two numbers.
    """
    best, most = ' ', 0
    for separator in SEPARATORS:
        split = []
        for line in lines:
            try:
                split.append(_split(line, separator, Path(), 0))
            except InputError:
                continue
        widths = Counter(
            len(cells) for cells in split if sum(map(_count_numbers, cells)) >= _FEWEST_NUMBERS
        )
        width = widths.most_common(1)[0][0] if widths else 0
        count = sum(
            sum(map(_count_numbers, cells)) for cells in split if len(cells) == width and width > 1
        )
        if count > _MORE * most:
            best, most = separator, count
    return best


def _is_number(cell: str) -> bool:
    """Whether a cell is a number, also with thousands separators or a unit."""
    # Many cells of a wide table are empty.
    return bool(
        cell
        and (_PLAIN.fullmatch(cell) or _THOUSANDS.fullmatch(cell) or _WITH_UNIT.fullmatch(cell))
    )


def _count_numbers(cell: str) -> int:
    """Number of numbers in a cell, which may be a list: 0 for other text."""
    return int(_is_number(cell)) or len(_list_in_cell(cell))


def _is_row(cells: Sequence[str]) -> bool:
    """Whether a line has at least two cells with numbers."""
    return sum(map(_is_number, cells)) >= _FEWEST_NUMBERS


def _is_no_row(cells: Sequence[str], usual: IntArray, width: int) -> bool:
    """Whether a line below the header is no row, but a sum, a page title or a remark.

    False for damaged rows, which are to be refused: a row that was cut off still has a number
    in one of the columns `usual` (indices of those with numbers in most rows). False, too, if
    `usual` is empty. `width`: number of columns.
    """
    if not len(usual):
        return False
    title = next(filter(None, cells), '').lower()
    words = _WORD.findall(title)
    if words and {*words} <= _SUMS and not any(map(str.isdigit, title)):
        return True
    page = bool(words) and words[0] in _PAGES
    if len(cells) == width and not page and _is_number(cells[usual[0]]):
        return False
    found = [cells[i] for i in usual[: np.searchsorted(usual, len(cells))]]
    if len(cells) == width and all(is_missing(cell) or _is_number(cell) for cell in found):
        return page and not any(map(_is_number, found))
    return page or not any(is_missing(cell) or _is_number(cell) for cell in found)


def _first_row(
    split: list[tuple[int, str, list[str]]], path: Path, comment: re.Pattern[str]
) -> tuple[int, int, IntArray]:
    """Number of columns, index of the first row, and indices of the usual columns of numbers.

    The number of columns is that of most lines with two numbers; usual columns have numbers in
    most of these. `split`: lines (number, text, cells); `comment`: pattern at the begin of
    comment lines, which are no rows; `path`: for messages. Raises InputError if no line has
    two numbers.
    """
    rows = [
        (i, cells)
        for i, (_, line, cells) in enumerate(split)
        if _is_row(cells) and not comment.match(line)
    ]
    if not rows:
        raise InputError(
            f'{path}: no row with two numbers; is it a table? name its separator with '
            '--separator if it has an unusual one'
        )
    width = Counter(len(cells) for _, cells in rows).most_common(1)[0][0]
    full = [(i, [*map(_is_number, cells)]) for i, cells in rows if len(cells) == width]
    # A title of as many words has its numbers elsewhere.
    usual = 2 * np.sum([numbers for _, numbers in full], axis=0) > len(full)
    first = next(
        (i for i, numbers in full if 2 * np.sum(usual & numbers) > usual.sum()), full[0][0]
    )
    return width, first, np.flatnonzero(usual)


def _header(
    above: list[tuple[int, str, list[str]]], width: int, separator: str, path: Path
) -> tuple[list[str], str, int]:
    """Names of the columns, title lines, and index of the first line below the names.

    `above`: lines (number, text, cells) before the first row of numbers; the index counts in
    it. The names are the lowest line with `width` cells (number of columns), also in a
    comment; cells of a line above them are put before names that occur twice. A line of units
    below the names is put into them in brackets, and the index is that of the line below it.
    Title lines are the other lines as one text. [] and index 0 if there are no names. Raises
    InputError if over half of the cells of a line below the names are units, but not all.
    `path`: for messages.
    """
    names: list[str] = []
    over: list[str] = []
    preamble = []
    named = 0
    for at, (number, line, cells) in enumerate(above, start=1):
        mark = _COMMENT.match(line)
        if mark:
            # NumPy and many trackers write the names into a comment.
            cells = _split(line[mark.end() :], separator, path, number)
            if len(cells) == width and not cells[0]:
                cells[0] = line.strip()[0]
        while len(cells) > width and not cells[-1]:
            cells = cells[:-1]
        given = [cell for cell in cells if cell]
        if len(cells) != width or len(given) < _FEWEST_NUMBERS or (_is_row(cells) and not mark):
            preamble.append(line)
            over = cells if len(cells) <= width and not _is_row(cells) else []
        elif names and all(map(is_unit, given)):
            names = [
                f'{name} [{bare(unit)}]' if unit else name for name, unit in zip(names, cells)
            ]
            named = at
        elif names and 2 * sum(map(is_unit, given)) > len(given):
            wrong = next(cell for cell in given if not is_unit(cell))
            raise InputError(
                f'{path}, line {number}: {wrong!r}, where a unit is expected, as beside it'
            )
        else:
            names, named, over = _with_group_names(over or names, cells), at, []
    return names, '\n'.join(preamble), named


def _are_counted(cells: Sequence[str]) -> bool:
    """Whether column names are only the numbers 0, 1, 2, …, as programs write them.

    A first name that is empty (of an index) is skipped; False if fewer than two are left.
    """
    given = [cell for cell in cells[:1] if cell] + [*cells[1:]]
    return len(given) >= _FEWEST_NUMBERS and given == [str(i) for i in range(len(given))]


def _with_group_names(over: Sequence[str], names: list[str]) -> list[str]:
    """Column names with the group's name in front, for names that occur more than once.

    `over`: cells of the line above, in which an empty cell continues the group to its left.
    """
    group, groups = '', []
    for cell in (*over, *[''] * (len(names) - len(over))):
        group = cell or group
        groups.append(group)
    count = Counter(names)
    return [
        f'{group} {name}' if name and group and count[name] > 1 else name
        for group, name in zip(groups, names)
    ]


def _find_decimal(rows: Sequence[Sequence[str]]) -> str:
    """Decimal sign of a table: ',' if it is the last sign of more numbers than '.', else '.'."""
    signs: Counter[str] = Counter()
    for cells in rows:
        for cell in cells:
            if _is_number(cell):
                signs[_last_sign(cell)] += 1
    return ',' if signs[','] > signs['.'] else '.'


def _last_sign(cell: str) -> str:
    """The last point or comma of a number; '' if it has none."""
    return next((letter for letter in reversed(cell) if letter in '.,'), '')
