# SPDX-License-Identifier: Apache-2.0
"""Units as tables write them, and their values in SI."""

from __future__ import annotations

import re

from remaster_ros.calibration.mistakes import ANGLES, LENGTHS

__all__ = ['ANGLES', 'LENGTHS', 'PULSES', 'SI', 'TEMPERATURES', 'TIMES', 'split_unit']

TIMES = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9, 'min': 60.0, 'h': 3600.0}
TEMPERATURES = {'degc': 1.0, 'k': 1.0}
SI = {**ANGLES, **LENGTHS, **TIMES, **TEMPERATURES}

# German "grad" are degrees; hundredths of a right angle are written "gon".
_WORDS = {
    word: unit
    for unit, words in {
        'deg': '° º degs degree degrees grad',
        'rad': 'radian radians rads',
        'gon': 'gons',
        'm': 'meter meters metre metres',
        'mm': 'millimeter millimeters millimetre millimetres',
        'cm': 'centimeters centimetres',
        'um': 'µm μm micron microns',
        'in': 'inch inches "',
        's': 'sec secs seconds',
        'degc': 'c °c celsius',
        'k': 'kelvin',
    }.items()
    for word in words.split()
}
_IN_BRACKETS = re.compile(r'\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$')
_AFTER_SLASH = re.compile(r'\s*(?:/|,| in )\s*([^\s/,]+)\s*$')
_AT_END = re.compile(r'[ _.-]([^ _.-]+)$')
# Units that mean something else at the end of a name: `A1_min`.
_ONLY_IN_BRACKETS = ('min', 'h', 'k')
# One letter at the end of a name is no unit: `point_s`, `J_m`; but x_m is one.
_COORDINATE_IN_M = re.compile(r'(?:^|.*[ _.-])[xyz]_m$', re.IGNORECASE)
_MM_AT_ONCE = re.compile(r'[xyz]mm', re.IGNORECASE)


# Units of motor pulses, which the module `pulses` converts to angles.
PULSES = ('pulses', 'pulse', 'puls', 'counts', 'count', 'ticks', 'inc')
# Units that tables have and nothing here converts.
_OTHERS = {
    *('mrad', 'arcmin', 'arcsec', 'rev', 'turns', *PULSES),
    *('ft', 'feet', 'foot', 'yd', 'mil', 'mils', 'thou', 'dm', 'km', 'nm', 'px', 'pixel'),
}


def other_unit(header: str) -> str:
    """Unit at the end of a header that is known but not converted (such as ``ft``), as written.

    '' if there is none, or it can be converted.
    """
    found = _IN_BRACKETS.search(header) or _AT_END.search(header)
    return found[1] if found and found[1].lower() in _OTHERS else ''


def unit_of(text: str) -> str:
    """Unit in a text, as a key of `SI`; '' if the text is no known unit. Case is ignored."""
    word = bare(text).lower()
    word = _WORDS.get(word, word)
    return word if word in SI else ''


def is_unit(text: str) -> bool:
    """Whether a cell below a header can be a unit, or a mark for no unit."""
    return bool(unit_of(text)) or bare(text).strip('-–—') in ('', '1')


def bare(text: str) -> str:
    """A unit without blanks and brackets around it."""
    return text.strip().strip('[]()').strip()


def split_unit(header: str) -> tuple[str, str]:
    """Name of a column without its unit, and the unit ('' if it has none), a key of `SI`.

    ``X [mm]``, ``x/mm``, ``x in mm``, ``x_mm`` and ``xmm`` are X in mm; single letters at the end
    are no units, except in ``x_m``.
    """
    found = _IN_BRACKETS.search(header) or _AFTER_SLASH.search(header)
    if found and unit_of(found[1]):
        return header[: found.start()].strip(), unit_of(found[1])
    found = _AT_END.search(header)
    long = found and (len(found[1]) > 1 or found[1] in '°"' or _COORDINATE_IN_M.match(header))
    if found and long and unit_of(found[1]) not in ('', *_ONLY_IN_BRACKETS):
        return header[: found.start()].strip(), unit_of(found[1])
    if _MM_AT_ONCE.fullmatch(header):
        return header[0], 'mm'
    if header.endswith('°'):
        return header[:-1].strip(), 'deg'
    return header.strip(), ''
