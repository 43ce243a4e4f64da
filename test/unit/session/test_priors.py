# SPDX-License-Identifier: Apache-2.0
"""The file of priors: read strictly, refused in one line, and felt by the fit."""

from pathlib import Path

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.records.priors_file import read_priors

GOOD = """
joint_offsets: {joint_2: {mean_deg: 0.1, std_deg: 0.05}, lift: {mean_mm: 2.0, std_mm: 0.5}}
markers: {sir: {position_m: [0.1, 0.0, 0.02], std_m: 1e-4}}
base:
  mocap: {translation_m: [2.0, 0.0, 1.0], rotation_xyzw: [0, 0, 0, 1], std_m: 1e-3, std_rad: 2e-3}
geometry_tolerance_mm: 0.05
"""


def write(folder: Path, text: str) -> Path:
    path = folder / 'priors.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def test_every_key_is_read(tmp_path) -> None:
    priors = read_priors(write(tmp_path, GOOD))
    assert priors.joint_offsets['joint_2'] == pytest.approx(np.radians([0.1, 0.05]))
    assert priors.joint_offsets['lift'] == pytest.approx((2e-3, 5e-4))
    assert priors.in_m == {'lift'}
    position, std = priors.markers['sir']
    assert position.tolist() == [0.1, 0.0, 0.02]
    assert std == 1e-4
    base = priors.base['mocap']
    assert base.translation_m.tolist() == [2.0, 0.0, 1.0]
    assert base.rotation_xyzw.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert (base.std_m, base.std_rad) == (1e-3, 2e-3)
    assert priors.geometry_tolerance_m == pytest.approx(5e-5)


@pytest.mark.parametrize(
    ('before', 'after', 'words'),
    [
        ('joint_offsets:', 'offsets:', 'offsets'),
        ('std_deg: 0.05', 'std_deg: 0.0', r'joint_offsets.joint_2.std_deg is 0'),
        ('std_deg: 0.05', 'std_deg: .nan', r'joint_2.std_deg: nan is not a finite number'),
        ('mean_deg: 0.1', 'mean_deg: 1000', r'joint_2.mean_deg is 1000'),
        ('mean_deg: 0.1', 'mean_deg: much', r'mean_deg'),
        ('mean_mm: 2.0, ', '', r'joint_offsets.lift has not both of mean_deg and std_deg'),
        ('mean_mm: 2.0', 'mean_deg: 2.0', r'joint_offsets.lift has not both of mean_deg'),
        ('std_mm: 0.5', 'std_mm: 0.5, std_deg: 1.0', r'joint_offsets.lift has not both'),
        ('std_m: 1e-4', 'std_m: -1', r'markers.sir.std_m is -1'),
        ('[0.1, 0.0, 0.02]', '[0.1, 0.0]', r'position_m'),
        ('[0.1, 0.0, 0.02]', '[100, 0.0, 20]', r'markers.sir.position_m'),
        (
            '[0, 0, 0, 1]',
            '[0, 0, 0, 2]',
            r'base.mocap.rotation_xyzw has norm 2, not 1; give a unit quaternion',
        ),
        ('std_rad: 2e-3', 'std_rad: 7', r'base.mocap.std_rad is 7'),
        ('[2.0, 0.0, 1.0]', '[.inf, 0.0, 1.0]', r'base.mocap.translation_m'),
        ('markers:', '- markers:', 'line'),
        ('tolerance_mm: 0.05', 'tolerance_mm: 0', r'geometry_tolerance_mm is 0'),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, before: str, after: str, words: str) -> None:
    path = write(tmp_path, GOOD.replace(before, after))
    with pytest.raises(InputError, match=words) as caught:
        read_priors(path)
    assert str(caught.value).startswith(str(path))
    assert '\n' not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path) -> None:
    with pytest.raises(InputError, match=r'none\.yaml'):
        read_priors(tmp_path / 'none.yaml')
