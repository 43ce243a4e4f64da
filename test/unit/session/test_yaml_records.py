# SPDX-License-Identifier: Apache-2.0
"""Numbers of YAML files are held to the bounds that their records declare."""

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest

from remaster_ros.bounds import Bounds, Triple
from remaster_ros.errors import InputError
from remaster_ros.session.records.session_yaml import BaseFrame
from remaster_ros.session.yaml_records import read_yaml


class Part(msgspec.Struct, forbid_unknown_fields=True):
    places_m: Annotated[dict[str, Triple], Bounds(-3.0, 3.0, 'm')] = {}
    view_deg: Annotated[float, Bounds(3.5, 180.0, 'degrees')] = 60.0
    size_m: Annotated[float | list[float], Bounds(0.0, unit='m', above=True)] = 1.0
    std_m: Annotated[float, Bounds(0.0, 0.4, 'm', remedy='; 0.3 where unknown')] = 0.1
    free: float | None = None


class File(msgspec.Struct):
    parts: dict[str, Part] = {}


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('places_m: {a: [0, 0, 250]}', 'parts.x.places_m.a is 250; it must be from -3 to 3 m; '
         'if millimetres were meant, write 0.25'),
        ('places_m: {a: [0, .inf, 0]}', 'parts.x.places_m.a: inf is not a finite number'),
        ('view_deg: 1.05', 'parts.x.view_deg is 1.05; it must be from 3.5 to 180 degrees; if '
         'radians were meant, write 60.16'),
        ('view_deg: 181', 'parts.x.view_deg is 181; it must be from 3.5 to 180 degrees'),
        ('view_deg: -1', 'parts.x.view_deg is -1; it must be from 3.5 to 180 degrees'),
        ('size_m: 0', 'parts.x.size_m is 0; it must be above 0 m'),
        ('size_m: [1, -1]', 'parts.x.size_m is -1; it must be above 0 m'),
        ('std_m: 0.5', 'write 0.0005; 0.3 where unknown'),
        ('free: .nan', 'parts.x.free: nan is not a finite number'),
        ('viewdeg: 1', 'viewdeg'),
        ('view_deg: wide', 'float'),
    ],
)  # fmt: skip
def test_a_number_outside_its_bounds_is_named(text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_yaml(f'parts: {{x: {{{text}}}}}'.encode(), Path('cell.yaml'), File)
    assert str(caught.value).startswith('cell.yaml: ')
    assert message in str(caught.value)


@pytest.mark.parametrize(
    'text',
    ['', 'places_m: {a: [3, -3, 0]}', 'view_deg: 3.5', 'size_m: [1, 2]', 'std_m: 0', 'free:'],
)
def test_numbers_at_their_bounds_are_taken(text: str) -> None:
    read = read_yaml(f'parts: {{x: {{{text}}}}}'.encode(), Path('cell.yaml'), File)
    assert isinstance(read.parts['x'], Part)


def test_a_quaternion_is_normalised_or_refused() -> None:
    nearly = BaseFrame((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8004), 1e-3, 1e-3)
    assert nearly.problem('base.bar') == ''
    assert np.linalg.norm(nearly.prior().rotation_xyzw) == pytest.approx(1.0, abs=1e-15)
    assert nearly.prior().translation_m.tolist() == [1.0, 2.0, 3.0]
    for wrong in ((0.0, 0.0, 0.6, 0.9), (0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)):
        problem = BaseFrame((1.0, 2.0, 3.0), wrong, 1e-3, 1e-3).problem('base.bar')
        assert problem.startswith('base.bar.rotation_xyzw has norm')
