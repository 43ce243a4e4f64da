# SPDX-License-Identifier: Apache-2.0
"""compensation.json of somebody who means harm: refused in one line, naming the place in it."""

import json
import os

import numpy as np
import pytest
from worlds.calibration_scenes import URDF
from worlds.compensation_files import arm, save

from remaster_ros.compensation.file import COMPENSATION_FILE, read_compensation
from remaster_ros.errors import InputError

DEEP = 200_000


@pytest.fixture(scope='module')
def text(tmp_path_factory):
    return save(tmp_path_factory.mktemp('file'), arm(URDF), URDF).read_text()


def numbers(value, where=()):
    """Yield the place of each number of a file."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from numbers(item, (*where, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield where


def test_no_number_that_no_arm_has_is_computed_with(text, tmp_path):
    content = json.loads(text)
    # Of lists the first: their other elements are of the same kind.
    places = [at for at in numbers(content) if not any(isinstance(key, int) and key for key in at)]
    assert len(places) > 10
    for at in places:
        for number in (1e308, -1e308, 1e30):
            changed = json.loads(text)
            part = changed
            for key in at[:-1]:
                part = part[key]
            part[at[-1]] = number
            path = tmp_path / COMPENSATION_FILE
            path.write_text(json.dumps(changed))
            with np.errstate(all='raise'), pytest.raises(InputError) as refused:
                read_compensation(path)
            assert str(path) in str(refused.value), at
            assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize('part', ['[', '{"a":'])
@pytest.mark.parametrize('key', ['', 'state', 'joints'])
def test_what_is_nested_too_deep_is_no_fault_of_the_program(text, key, part, tmp_path):
    nested = DEEP * part + '1' + DEEP * {'[': ']'}.get(part, '}')
    if key:
        content = json.loads(text)
        content[key] = 'HERE'
        nested = json.dumps(content).replace('"HERE"', nested)
    path = tmp_path / COMPENSATION_FILE
    path.write_text(nested)
    with pytest.raises(InputError, match='this is no compensation') as refused:
        read_compensation(path)
    assert len(str(refused.value)) < 500 + len(os.fspath(path))
