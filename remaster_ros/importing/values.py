# SPDX-License-Identifier: Apache-2.0
"""The numbers, names and times of a table's columns, in SI."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import Columns
from remaster_ros.importing.text_table import TextTable, parse_number
from remaster_ros.importing.units import ANGLES, LENGTHS, TIMES, unit_of
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FARTHEST_M, FloatArray

_UNIT_LINE = re.compile(
    r'(?:units?|einheit(?:en)?|unidad(?:es)?|unités?|unità)\s*(?:are|is)?\s*[:=]?\s*([A-Za-zµ"°]+)',
    re.IGNORECASE,
)
# Times since 1970 above these values are in ns, us or ms.
_EPOCHS = ((1e17, 'ns'), (1e14, 'us'), (1e11, 'ms'))
# Days since 1900, as spreadsheets count: of 1995 to 2119. As seconds of some clock they would be a
# session of less than half a minute.
_SERIAL, _SERIAL_DAYS = (34_700.0, 80_000.0), 30.0
_SERIAL_OF_1970, DAY_S = 25_569.0, 86_400.0
# Times of day without a date are those of 1 January 2000.
WITHOUT_DATE_S = 946_684_800.0
# A date and a time without signs between them.
_COMPACT = re.compile(r'(?:19|20)\d\d[01]\d[0-3]\d[0-2]\d[0-5]\d[0-5]\d')
_CLOCK = re.compile(r'(\d\d?)\.(\d\d)\.\d\d')
# Numbers that `dateutil` would take for a date.
_SHORT = re.compile(r'[^:]?\d*(?:[.,\s-]+\d*)?')
# Two numbers of a date and the sign between them; dates that begin with the year are not meant.
_DATE = re.compile(r'\D*(\d\d?)([./-])(\d\d?)\2\d\d(?:\d\d)?(?!\d)')
_MOST_MONTHS = 12
# Characters of a time: a day of the week, a date with the month as a word, a time and a zone.
_LONGEST_TIME = 100
_WORD = re.compile(r'([^\W\d_]+)\b\.?')
# Hours, minutes and seconds between points or strokes: before AM and PM, or behind a date.
_POINTS = re.compile(
    r'(?<![\d.-])(\d\d?)[.-](\d\d)[.-](\d\d)(?=[.,\d]*\s*[AaPp]\.?[Mm]\b)'
    r'|(?<=\d )(\d\d?)[.-](\d\d)[.-](\d\d)(?![\d.-]*\d{3})'
)
# Thousandths behind a fourth colon.
_FOURTH = re.compile(r'(\d:\d\d:\d\d):(\d{1,6})$')
_ZONES = {
    name: 3600 * hours
    for hours, names in ((0, 'WET'), (1, 'CET MEZ BST WEST'), (2, 'CEST MESZ EET'))
    for name in names.split()
}
# Names of months of other languages, and words that are left out.
_MONTHS = {
    word: f' {month} '
    for month, words in {
        'Jan': 'januar jänner janvier janv enero ene gennaio gen',
        'Feb': 'februar février févr fevrier febrero febbraio',
        'Mar': 'märz maerz mrz mär mars marzo',
        'Apr': 'april avril avr abril abr aprile',
        'May': 'mai mayo maggio mag',
        'Jun': 'juni juin junio giugno giu',
        'Jul': 'juli juillet juil julio luglio lug',
        'Aug': 'august août aout agosto ago',
        'Sep': 'september sept septembre septiembre settembre set',
        'Oct': 'oktober okt octobre octubre ottobre ott',
        'Nov': 'november novembre noviembre',
        'Dec': 'dezember dez décembre déc decembre diciembre dic dicembre',
        '': 'um uhr at à le de montag dienstag mittwoch donnerstag freitag samstag sonntag mo di '
        'mi do fr sa so lundi mardi mercredi jeudi vendredi samedi dimanche',
    }.items()
    for word in words.split()
}
# Largest angle, rad, that an arm reports: a little more than one turn each way.
_LARGEST_RAD = 2.1 * np.pi


def numbers(table: TextTable, columns: tuple[int, ...], optional: bool = False) -> FloatArray:
    """Columns of numbers, (n, len(columns)); NaN if `optional` and empty.

    Raises InputError for an empty cell if not `optional`, and for text that is no number.
    """
    values = np.full((len(table.rows), len(columns)), np.nan)
    for row in range(len(table.rows)):
        for i, column in enumerate(columns):
            value = table.number(row, column)
            if value is not None:
                values[row, i] = value
            elif not optional:
                no = 'no value' if table.rows[row][column] else 'empty'
                raise table.fault(row, column, f'is {no}; complete it or remove the row')
    return values


def angle_unit(table: TextTable, columns: Columns, stated_unit: str) -> tuple[str, str]:
    """Unit of the joint angles, and how it is known: 'told', 'header' or 'guessed'.

    `stated_unit`: by the user, '' if none. Guessed is rad if all angles are below 2.1 π, else
    deg. Raises InputError if the headers have several units.
    """
    units = {columns.units.get(i, '') for i in columns.joints} - {''}
    if stated_unit:
        return stated_unit, 'told'
    if len(units) > 1:
        raise InputError(
            f'{table.path}: the joints have several units in the header '
            f'({", ".join(sorted(units))}); say which with --angles'
        )
    if units:
        return units.pop(), 'header'
    largest = np.nanmax(np.abs(numbers(table, columns.joints, optional=True)), initial=0.0)
    return ('rad', 'guessed') if largest < _LARGEST_RAD else ('deg', 'guessed')


def joint_values(
    table: TextTable, columns: Columns, chain: SerialChain, stated_unit: str
) -> tuple[FloatArray, tuple[tuple[str, str], ...], FloatArray]:
    """Joint positions, (n, k), rad or m; unit and source of each joint, k; and scale to SI, (k,).

    The unit of the angles is `stated_unit` (by the user, '' if none), else that of the header,
    else guessed. The unit of a prismatic joint is in its header; else m if all values in m are
    within the joint's limits, else mm if they are within the limits in mm. Raises InputError
    if neither fits, or for a unit or number that cannot be used.
    """
    values = numbers(table, columns.joints)
    turning = tuple(i for i, slides in zip(columns.joints, chain.slides) if not slides)
    angle = angle_unit(table, replace(columns, joints=turning), stated_unit)
    units = []
    for joint, column in enumerate(columns.joints):
        if not chain.slides[joint]:
            units.append(angle)
            continue
        if unit := columns.units.get(column, ''):
            if unit not in LENGTHS:
                raise InputError(
                    f"{table.path}, column {table.names[column]}: joint '"
                    f"{chain.joint_names[joint]}' slides, and the header has {unit}; write its "
                    'unit of length, such as [mm]'
                )
            units.append((unit, 'header'))
            continue
        low, high = chain.lower[joint], chain.upper[joint]
        allowed = chain.limit_tolerance[joint]
        fitting = [
            unit
            for unit in ('m', 'mm')
            if np.all(LENGTHS[unit] * values[:, joint] >= low - allowed)
            and np.all(LENGTHS[unit] * values[:, joint] <= high + allowed)
        ]
        # What is within the limits in metres is so in mm as well, if the limits hold 0: all of it
        # within a thousandth of them.
        if not fitting:
            raise InputError(
                f"{table.path}, column {table.names[column]}: joint '{chain.joint_names[joint]}' "
                f'slides from {low:g} to {high:g} m, and neither as m nor as mm are all values '
                'there; write the unit into the header, such as [mm], or correct the limits'
            )
        units.append((fitting[0], 'by its limits'))
    scale = np.array([{**ANGLES, **LENGTHS}[unit] for unit, _ in units])
    return values * scale, tuple(units), scale


def length_unit(
    table: TextTable, columns: Columns, stated_unit: str, points: FloatArray, modelled: FloatArray
) -> tuple[str, str]:
    """Unit of the points, and how it is known: 'told', 'header' or 'guessed'.

    `stated_unit`: by the user, '' if none; `points`: as written, (n, 3). If neither user nor
    table states it, it is the one of m, mm and in with which their spread is nearest to that
    of `modelled`, the positions of the nominal tool, m, (n, 3). Raises InputError if the
    headers have several units.
    """
    units = {columns.units.get(i, '') for i in columns.point} - {''}
    if stated_unit:
        return stated_unit, 'told'
    if len(units) > 1:
        raise InputError(
            f'{table.path}: X, Y and Z have several units in the header '
            f'({", ".join(sorted(units))}); say which with --length'
        )
    if units:
        return units.pop(), 'header'
    for found in _UNIT_LINE.findall(table.preamble):
        if unit_of(found) in LENGTHS:
            return unit_of(found), 'header'
    spread, wanted = (np.sqrt(np.mean(np.var(p, axis=0))) for p in (points, modelled))
    ratio = wanted / spread if spread > 0.0 else 1.0
    # Centimetres are rare, and too near to inches.
    likely = ('m', 'mm', 'in')
    return min(likely, key=lambda unit: abs(np.log(LENGTHS[unit] / ratio))), 'guessed'


def refuse_far(table: TextTable, columns: Columns, unit: str) -> None:
    """Raise InputError for the first point with a coordinate beyond 200 m (`FARTHEST_M`)."""
    far = np.abs(numbers(table, columns.point, optional=True)) * LENGTHS[unit] > FARTHEST_M
    for row, i in np.argwhere(far)[:1]:
        raise table.fault(
            int(row),
            columns.point[i],
            f'{unit} is further than {FARTHEST_M:g} m away, beyond any sensor; is the unit right '
            '(--length)?',
        )


def times(table: TextTable, columns: Columns) -> FloatArray | None:
    """Times of the rows, s, (n,); None if the table has none.

    A time is a number, ISO 8601, or a date and a time as programs write them (dates with
    points have the day first), in one column or in two. Dates become seconds since 1970.
    Numbers without a unit are s, or ms, µs or ns if they are as large as times since 1970, or
    days of a spreadsheet, or, if all are below 1, shares of a day. Raises InputError for text
    that is no time.
    """
    column = columns.first_of_kind('time')
    clock, date = columns.first_of_kind('clock'), columns.first_of_kind('date')
    if column is None:
        column = clock if clock is not None else date
    if column is None or not any(row[column] for row in table.rows):
        return None
    day = date if date not in (None, column) else None
    unit = columns.units.get(column, '')
    result = np.empty(len(table.rows))
    texts = [
        cells[column] if day is None else f'{cells[day]} {cells[column]}' for cells in table.rows
    ]
    if _are_clocks(texts):
        texts = [text.replace('.', ':') for text in texts]
    day_first = _is_day_first(texts)
    for row, text in enumerate(texts):
        value = _time(text, table.decimal, day_first)
        if value is None:
            raise table.fault(row, column, 'is no time; correct it, or say --time none')
        result[row] = value
    if unit not in TIMES:
        if np.all((result > _SERIAL[0]) & (result < _SERIAL[1])) and np.ptp(result) < _SERIAL_DAYS:
            return (result - _SERIAL_OF_1970) * DAY_S
        if np.all((result >= 0.0) & (result < 1.0)):
            # A time of day as its share of the day: no session takes less than a second.
            return result * DAY_S
    if unit not in TIMES:
        largest = np.abs(result).max(initial=0.0)
        unit = next((name for size, name in _EPOCHS if largest > size), 's')
    return result * TIMES[unit]


def _time(text: str, decimal: str, day_first: bool) -> float | None:
    """Time of a cell, s; if it is a number, that number; None if the cell is no time.

    Dates count from 1970 in local time, unless a zone is stated; a time of day is on 1 January
    2000.
    """
    if len(text) > _LONGEST_TIME:
        return None
    number = parse_number(text, decimal)
    if number is not None and not _COMPACT.fullmatch(text):
        return number
    try:
        if _COMPACT.fullmatch(text):
            return datetime.strptime(text, '%Y%m%d%H%M%S').timestamp()
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        pass
    if _SHORT.fullmatch(text):
        return None
    # Imported where it is needed: few tables are so.
    from dateutil import parser

    try:
        with warnings.catch_warnings():
            # A letter that is no time zone.
            warnings.simplefilter('error')
            moment = parser.parse(
                _in_english(text),
                dayfirst=day_first,
                default=datetime(2000, 1, 1),
                tzinfos=_ZONES,
            )
        return float(moment.timestamp())
    except (ValueError, OverflowError, RuntimeWarning):
        return None


def _in_english(text: str) -> str:
    """Text of a date and time in a form that `_time` reads.

    Names of months in English, no days of the week, colons between hours, minutes and seconds.
    """
    text = _WORD.sub(lambda word: _MONTHS.get(word[1].casefold(), word[0]), text)
    text = re.sub(r'[年月]', '-', text).replace('日', ' ').replace('_', ' ')
    text = re.sub(r'([AaPp])\. ?([Mm])\.', r'\1\2', text)
    text = _POINTS.sub(lambda time: ':'.join(filter(None, time.groups())), text)
    return _FOURTH.sub(r'\1.\2', text)


def _are_clocks(texts: Sequence[str]) -> bool:
    """Whether all cells are times of day that are written with points, such as 14.30.05.

    They could be dates (day.month.year): False unless in some cell the second number is 0 or
    above 12, and so no month.
    """
    found = [_CLOCK.fullmatch(text) for text in texts]
    return all(found) and any(not 0 < int(match[2]) <= _MOST_MONTHS for match in found if match)


def _is_day_first(texts: Sequence[str]) -> bool:
    """Whether dates such as 3/11/2025 have the day before the month, judged from the whole column.

    True if a date has points (3.11.2025), if a first number is above 12, or if the first
    numbers differ and the second ones do not, as days pass in a session, but no months.
    """
    found = [match for match in map(_DATE.match, texts) if match]
    first, second = [int(match[1]) for match in found], [int(match[3]) for match in found]
    if any(match[2] == '.' for match in found) or max(first, default=0) > _MOST_MONTHS:
        return True
    # Days pass in a session, but no months.
    return len({*first}) > 1 and len({*second}) == 1
