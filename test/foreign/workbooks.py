# SPDX-License-Identifier: Apache-2.0
"""Workbooks as spreadsheets write them, by hand: shared strings, dates, several sheets."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from xml.sax.saxutils import escape

_MAIN = 'http://schemas.openxmlformats.org/spreadsheetml/2006/main'
_OFFICE = 'http://schemas.openxmlformats.org/officeDocument/2006/relationships'

# Style of a date in `workbook`.
DATE = 1


class Day(float):
    """A serial day, which a sheet shows as a date."""


def workbook(
    sheets: dict[str, Sequence[Sequence[object]]], hidden: Sequence[str] = (), first: str = 'A1'
) -> bytes:
    """Return a workbook whose sheets have these rows; None for an empty cell.

    The tables begin at the cell `first`, such as B3.
    """
    strings: list[str] = []
    parts = {}
    column, row_at = ord(first[0]) - ord('A'), int(first[1:])
    for number, rows in enumerate(sheets.values(), 1):
        lines = []
        for i, row in enumerate(rows):
            cells = []
            for j, value in enumerate(row):
                at = f'{chr(ord("A") + column + j)}{row_at + i}'
                if value is None:
                    continue
                if isinstance(value, str):
                    if value not in strings:
                        strings.append(value)
                    cells.append(f'<c r="{at}" t="s"><v>{strings.index(value)}</v></c>')
                else:
                    style = f' s="{DATE}"' if isinstance(value, Day) else ''
                    cells.append(f'<c r="{at}"{style}><v>{float(value):.17g}</v></c>')
            lines.append(f'<row r="{row_at + i}">{"".join(cells)}</row>')
        parts[f'xl/worksheets/sheet{number}.xml'] = (
            f'<worksheet xmlns="{_MAIN}"><sheetData>{"".join(lines)}</sheetData></worksheet>'
        )
    listed = ''.join(
        f'<sheet name="{escape(name)}" sheetId="{i}" r:id="rId{i}"'
        f'{" state=" + chr(34) + "hidden" + chr(34) if name in hidden else ""}/>'
        for i, name in enumerate(sheets, 1)
    )
    parts['xl/workbook.xml'] = (
        f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>{listed}</sheets></workbook>'
    )
    parts['xl/_rels/workbook.xml.rels'] = '<Relationships>{}</Relationships>'.format(
        ''.join(
            f'<Relationship Id="rId{i}" Target="worksheets/sheet{i}.xml"/>'
            for i in range(1, len(sheets) + 1)
        )
    )
    parts['xl/sharedStrings.xml'] = '<sst xmlns="{}">{}</sst>'.format(
        _MAIN, ''.join(f'<si><t>{escape(text)}</t></si>' for text in strings)
    )
    parts['xl/styles.xml'] = (
        f'<styleSheet xmlns="{_MAIN}"><cellXfs><xf numFmtId="0"/><xf numFmtId="22"/></cellXfs>'
        '</styleSheet>'
    )
    written = io.BytesIO()
    with zipfile.ZipFile(written, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return written.getvalue()
