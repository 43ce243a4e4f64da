"""Numbers of YAML files are held to the bounds that their records declare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.session_yaml import BaseFrame
from remaster_ros.session.workcell import config_path, read_cell
from remaster_ros.session.yaml_records import Bounds, Triple, read_yaml


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


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('markers:', 'markerz:', "line {line}: unknown key 'markerz'; did you mean 'markers'?"),
        (
            '    topic: opt',
            '    topc: opt',
            "line {line}: unknown key 'topc'; did you mean 'topic'?",
        ),
        ('floor_z_m:', 'q:', "line {line}: unknown key 'q'; the keys here are robot, mar"),
        (
            'single_shot: false',
            'single_shot: 3',
            'line {line}: sensors.mocap.single_shot: Expected',
        ),
        (
            'smr: [-0.1, 0.0, 0.0]',
            'smr: [-0.1]',
            'line {line}: markers.smr: Expected `array` of len',
        ),
        ('marker_std_m: 0.5e-3', 'marker_std_m: 5', 'line {line}: marker_std_m is 5; it must be'),
        (
            'max_angle_deg: 25.0',
            'max_angle_deg: 1',
            'line {line}: sensors.tracker.max_angle_deg is',
        ),
        (
            'aim_at: tracker',
            'aim_at: traker',
            "line {line}: aim_at 'traker' is none of the sensors ",
        ),
        ('marker: smr', 'marker: smrr', "sensors.tracker.marker is 'smrr'; markers has sir, smr"),
        (
            'held_joint: joint_3',
            'held_joint: joint3',
            "line {line}: held_joint 'joint3' is none of ",
        ),
        ('tip_link: tool', 'tip_link: Tol', "there is no link 'Tol'; it has base_link"),
    ],
)
def test_a_wrong_cell_names_line_key_and_what_was_meant(old, new, words, tmp_path):
    demo = config_path('cells/demo.yaml')
    text = demo.read_text().replace('../robots', str(demo.parents[1] / 'robots'))
    assert old in text
    line = 1 + text[: text.index(old)].count('\n') + new.count('\n')
    words = words.format(line=line)
    path = tmp_path / 'cell.yaml'
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_cell(path)
    line = text[: text.index(old)].count('\n') + 1
    assert words.format(line=line) in str(error.value)
    named = ('markerz', 'topc', 'traker', 'smrr', 'joint3', 'Tol')
    assert ('did you mean' in str(error.value)) == any(name in new for name in named)
