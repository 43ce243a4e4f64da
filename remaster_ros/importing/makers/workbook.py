# SPDX-License-Identifier: Apache-2.0
"""Workbooks of spreadsheets (.xlsx, .xlsm): each sheet with numbers as a text table."""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Iterator
from datetime import datetime, timedelta
from xml.etree import ElementTree

from remaster_ros.errors import InputError
from remaster_ros.importing.makers.archive import damage_as_input_error

# Largest size of an unpacked part, bytes, as of a text table.
_LIMIT = 256 * 1024**2
# Size of a sheet in Excel.
_MOST_ROWS, _MOST_COLUMNS = 1_048_576, 16_384
_CELL = re.compile(r'([A-Z]{1,3})([1-9]\d{0,6})')
# Number formats of dates and times that have no text of their own (ECMA-376, 18.8.30).
_DATE_FORMATS = {*range(14, 23), *range(27, 37), *range(45, 48), *range(50, 59)}
# Parts of a number format that are no letters of a date: quoted text, colours, conditions.
_NOT_LETTERS = re.compile(r'"[^"]*"|\\.|_.|\*.|\[(?!h|m|s)[^\]]*\]', re.IGNORECASE)
# Serial days count from here, for which 1900 counts as a leap year.
_EPOCH, _EPOCH_1904 = datetime(1899, 12, 30), datetime(1904, 1, 1)
# Spreadsheets show 15 digits. A number whose 15 digits are at least three characters shorter than
# its stored text was entered in that form.
_DIGITS, _FEWER = 15, 3
_COMMA = re.compile(r'[+-]?\d+,\d+')
_THOUSANDS = re.compile(r'[+-]?[1-9]\d{0,2},\d{3}')

Grid = dict[int, dict[int, str]]


def read(data: bytes) -> dict[str, str] | None:
    """Visible sheets of a workbook, name -> tab-separated text; None for other files.

    None also for an archive of NumPy. Raises InputError for an .xls file, and other or damaged
    archives.
    """
    if data.startswith(b'\xd0\xcf\x11\xe0'):
        raise InputError('this is a workbook of an old form (.xls); save it as .xlsx or as CSV')
    if not data.startswith(b'PK\x03\x04'):
        return None
    with damage_as_input_error(), zipfile.ZipFile(io.BytesIO(data)) as parts:
        return _sheets(parts)


def _sheets(parts: zipfile.ZipFile) -> dict[str, str] | None:
    """Visible sheets of a workbook's archive, name -> tab-separated text.

    None if it holds arrays of NumPy instead. Raises InputError for another or damaged archive.
    """
    names = {*parts.namelist()}
    if 'xl/workbook.xml' not in names:
        if any(name.endswith('.npy') for name in names):
            return None
        raise InputError(
            'a zip archive without a workbook of Excel (.xlsx) in it; save the sheet as .xlsx or '
            'as CSV'
        )
    book = _parsed(parts, 'xl/workbook.xml')
    targets: dict[str, str] = {}
    if 'xl/_rels/workbook.xml.rels' in names:
        for relation in _parsed(parts, 'xl/_rels/workbook.xml.rels'):
            target = relation.get('Target', '')
            targets[relation.get('Id', '')] = (
                target.lstrip('/') if target[:1] == '/' else f'xl/{target}'
            )
    shared: list[str] = []
    if 'xl/sharedStrings.xml' in names:
        shared = [_text_of(item) for item in _parsed(parts, 'xl/sharedStrings.xml')]
    dates = _date_styles(_parsed(parts, 'xl/styles.xml')) if 'xl/styles.xml' in names else []
    properties = next(_each(book, 'workbookPr'), None)
    since_1904 = properties is not None and properties.get('date1904') in ('1', 'true')
    found = {}
    for sheet in _each(book, 'sheet'):
        target = next((v for key, v in sheet.items() if key.endswith('}id')), '')
        part = targets.get(target, '')
        if sheet.get('state', 'visible') == 'visible' and part in names:
            grid = _grid(_parsed(parts, part), shared, dates, since_1904)
            found[sheet.get('name', part)] = _as_text(grid)
    return found


def _parsed(parts: zipfile.ZipFile, name: str) -> ElementTree.Element:
    """XML of a part. Raises InputError if it is damaged, over 256 MiB or declares entities."""
    with parts.open(name) as part:
        content = part.read(_LIMIT + 1)
    if len(content) > _LIMIT:
        raise InputError(f'{name} in it is larger than {_LIMIT // 1024**2} MiB')
    # Entities multiply; no spreadsheet declares any.
    if b'<!DOCTYPE' in content[:4096] or b'<!ENTITY' in content:
        raise InputError(f'{name} in it declares entities, which no spreadsheet does')
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f'{name} in it is damaged ({error}); take another copy') from None


def _each(element: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """Elements with a name, without its namespace, at any depth below an element."""
    return (node for node in element.iter() if _name(node) == name)


def _name(element: ElementTree.Element) -> str:
    """Name of an element without its namespace."""
    return str(element.tag).rpartition('}')[2]


def _text_of(element: ElementTree.Element) -> str:
    """Text of a cell or string, without phonetic hints."""
    texts = []
    for child in element:
        if _name(child) == 't':
            texts.append(child.text or '')
        elif _name(child) == 'r':
            texts += [part.text or '' for part in child if _name(part) == 't']
    return ''.join(texts)


def _date_styles(styles: ElementTree.Element) -> list[bool]:
    """Whether each cell style, by its number from 0, shows a date or a time."""
    custom_formats = {
        number_format.get('numFmtId'): bool(
            re.search(
                '[ymdhs]', _NOT_LETTERS.sub('', number_format.get('formatCode', '')), re.IGNORECASE
            )
        )
        for number_format in _each(styles, 'numFmt')
    }
    of_cells = next(_each(styles, 'cellXfs'), ())
    ids = [style.get('numFmtId', '0') for style in of_cells]
    return [custom_formats.get(i, i.isdigit() and int(i) in _DATE_FORMATS) for i in ids]


def _grid(
    sheet: ElementTree.Element, shared: list[str], dates: list[bool], since_1904: bool
) -> Grid:
    """Cells of a sheet with text by row and column, counted from 1.

    `shared`: strings of the book; `dates`: as `_date_styles`; `since_1904`: whether days count
    from 1904. Errors become ``nan``. Raises InputError for cells beyond a sheet's size or unknown
    strings.
    """
    grid: Grid = {}
    row_at = 0
    texts: set[tuple[int, int]] = set()
    for row in _each(sheet, 'row'):
        given = row.get('r', '')
        row_at = int(given) if given.isdigit() and len(given) <= 7 else row_at + 1
        column = 0
        for cell in row:
            if _name(cell) != 'c':
                continue
            place = _CELL.fullmatch(cell.get('r', ''))
            column = _column(place[1]) if place else column + 1
            if not (0 < row_at <= _MOST_ROWS and column <= _MOST_COLUMNS):
                raise InputError(f'cell {cell.get("r")}: a sheet of Excel ends before it')
            kind = cell.get('t', 'n')
            value = next((child.text or '' for child in cell if _name(child) == 'v'), '')
            if kind == 's':
                if not (value.isdigit() and int(value) < len(shared)):
                    raise InputError(f'cell {cell.get("r")}: {value!r} is no string of this book')
                text = shared[int(value)]
            elif kind == 'inlineStr':
                text = ''.join(_text_of(child) for child in cell if _name(child) == 'is')
            elif kind == 'e':
                text = 'nan'
            elif kind == 'n':
                style = cell.get('s', '0')
                is_date = style.isdigit() and int(style) < len(dates) and dates[int(style)]
                text = _number(value, is_date, since_1904)
            else:
                text = value
            text = ' '.join(text.split())
            if text:
                grid.setdefault(row_at, {})[column] = text
                if kind in ('s', 'inlineStr', 'str'):
                    texts.add((row_at, column))
    return _with_decimal_points(grid, texts)


def _column(letters: str) -> int:
    """Number of a column from its letters, from 1."""
    number = 0
    for letter in letters:
        number = 26 * number + ord(letter) - ord('A') + 1
    return number


def _number(value: str, is_date: bool, since_1904: bool) -> str:
    """A number as a sheet shows it: a date as ISO 8601, digits without binary rounding.

    A date below 1 is a time of day. Text that is no number stays.
    """
    try:
        number = float(value)
    except ValueError:
        return value
    if is_date and 0.0 <= number < 1.0:
        return (_EPOCH + timedelta(days=number)).time().isoformat('milliseconds')
    if is_date and number < 2_958_466.0:
        begin = _EPOCH_1904 if since_1904 else _EPOCH
        # Nearer than a millisecond no sheet has a time.
        moment = begin + timedelta(milliseconds=round(86_400_000.0 * number))
        return moment.isoformat(' ', 'milliseconds')
    short = f'{number:.{_DIGITS}g}'
    return short if len(short) <= len(value) - _FEWER else value


def _with_decimal_points(grid: Grid, texts: set[tuple[int, int]]) -> Grid:
    """Grid with points in place of decimal commas in numbers that are stored as text.

    Changed in place. Not if all of them could be thousands, such as 1,234. `texts`: row and column
    of these cells.
    """
    found = [(r, c) for r, c in texts if _COMMA.fullmatch(grid[r][c])]
    if any(not _THOUSANDS.fullmatch(grid[r][c]) for r, c in found):
        for r, c in found:
            grid[r][c] = grid[r][c].replace(',', '.')
    return grid


def _as_text(grid: Grid) -> str:
    """Text of a sheet: a tab-separated line for each row from 1 on, without empty columns."""
    columns = sorted({column for row in grid.values() for column in row})
    text = io.StringIO()
    writer = csv.writer(text, delimiter='\t', lineterminator='\n')
    for number in range(1, max(grid, default=0) + 1):
        row = grid.get(number)
        if row is None:
            text.write('\n')
        else:
            writer.writerow([row.get(column, '') for column in columns])
    return text.getvalue()
