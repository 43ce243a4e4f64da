# SPDX-License-Identifier: Apache-2.0
"""Records of JSON files: what is written of arrays, and what is refused of a file, and how."""

import tracemalloc
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from msgspec import Struct

from remaster_ros.errors import InputError
from remaster_ros.session.json_records import checked, decoded, encoded, format_of

PATH = Path('some.json')


class Row(Struct, frozen=True):
    """A record as of a result."""

    name: str
    place_m: tuple[float, float, float]
    std_m: float | None = None


class Content(Struct):
    """A file of such records."""

    format: str
    rows: dict[str, Row]


def test_arrays_and_what_is_not_known_are_written_and_read_back():
    row = {'name': 'a', 'place_m': np.arange(3.0), 'std_m': np.float64('nan'), 'more': 1}
    content = checked({'format': 'x/1', 'rows': MappingProxyType({'a': row})}, Content)
    assert content.rows == {'a': Row('a', (0.0, 1.0, 2.0))}
    assert decoded(encoded(content), PATH, Content, 'x/1', '') == content
    with pytest.raises(TypeError, match='no JSON for'):
        checked({'format': object()}, Content)


@pytest.mark.parametrize(
    ('data', 'words'),
    [
        (b'{"format": "y/1"}', "format is 'y/1', not 'x/1'"),
        (b'{"format": ""}', "format is '', not 'x/1'"),
        (b'{"format": 1}', r'Expected `str`, got `int` - at `\$.format`'),
        (b'{"rows": {}}', 'missing required field `format`'),
        (
            b'{"format": "x/1", "rows": {"a": {"name": "a", "place_m": [1, 2]}}}',
            'of length 3 - at ',
        ),
        (
            b'{"format": "x/1", "rows": {"a": {"name": "a", "place_m": [1, 2, null]}}}',
            'got `null`',
        ),
        (b'[]', 'Expected `object`'),
        (b'\xff\xfe', ''),
        (b'[' * 200_000, ''),
    ],
)
def test_another_file_is_refused_in_one_line_with_the_remedy(data, words):
    with pytest.raises(InputError, match=rf'^some\.json: .*{words}.*; give one$'):
        decoded(data, PATH, Content, 'x/1', 'give one')


def test_what_nobody_asks_for_is_not_built():
    """A million lists under a key that no record has."""
    data = b'{"format": "x/1", "rows": {}, "more": [' + b'[],' * 1_000_000 + b'0]}'
    tracemalloc.start()
    try:
        assert format_of(data) == 'x/1'
        assert decoded(data, PATH, Content, 'x/1', '').rows == {}
        assert tracemalloc.get_traced_memory()[1] < len(data)
    finally:
        tracemalloc.stop()
