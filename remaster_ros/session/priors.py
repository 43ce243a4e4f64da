"""What is known before a fit, from a YAML file: offsets, markers, base frames.

All keys are optional::

    joint_offsets: {joint_2: {mean_deg: 0.1, std_deg: 0.05}}
    markers: {sir: {position_m: [0.1, 0.0, 0.02], std_m: 1.0e-4}}
    base: {mocap: {translation_m: [2.0, 0.0, 1.0], rotation_xyzw: [0, 0, 0, 1],
                   std_m: 1.0e-3, std_rad: 1.0e-3}}
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.safe_yaml import YamlError, load_yaml
from remaster_ros.types import BasePrior, Priors

PRIORS_LIMIT = 256 * 1024
HELP = 'see "Priors" in docs/statistics.md'

Triple = tuple[float, float, float]


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A key that is misspelt must not be a prior that is silently missing."""


class _Offset(_Strict):
    mean_deg: float
    std_deg: float


class _Marker(_Strict):
    position_m: Triple
    std_m: float


class _Base(_Strict):
    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: float
    std_rad: float


class _File(_Strict):
    joint_offsets: dict[str, _Offset] = {}
    markers: dict[str, _Marker] = {}
    base: dict[str, _Base] = {}


def read_priors(path: str | os.PathLike[str]) -> Priors:
    """Read and check a file of priors; whether the session has these names is the fit's to say.

    Raises
    ------
    InputError
        One line naming file, key and remedy.
    """
    path = Path(path)
    data = read_limited(path, PRIORS_LIMIT, 'give a YAML file of priors')
    try:
        content = msgspec.convert(load_yaml(decode_text(data, path)), _File)
    except (YamlError, msgspec.ValidationError) as error:
        raise InputError(f'{path}: {error}; {HELP}') from None
    problem = _problem(content)
    if problem:
        raise InputError(f'{path}: {problem}')
    return Priors(
        joint_offsets={
            joint: (np.radians(prior.mean_deg), np.radians(prior.std_deg))
            for joint, prior in content.joint_offsets.items()
        },
        markers={
            marker: (np.array(prior.position_m), prior.std_m)
            for marker, prior in content.markers.items()
        },
        base={
            sensor: BasePrior(
                np.array(prior.translation_m),
                np.array(prior.rotation_xyzw) / np.linalg.norm(prior.rotation_xyzw),
                prior.std_m,
                prior.std_rad,
            )
            for sensor, prior in content.base.items()
        },
    )


def _problem(content: _File) -> str:
    """Return what is wrong with the numbers, or ''."""
    for joint, offset in content.joint_offsets.items():
        key = f'joint_offsets.{joint}'
        if not abs(offset.mean_deg) <= 180.0:
            return f'{key}.mean_deg is {offset.mean_deg:g}; give degrees from -180 to 180'
        if not 0.0 < offset.std_deg <= 180.0:
            return f'{key}.std_deg is {offset.std_deg:g}; give degrees above 0, at most 180'
    for marker, place in content.markers.items():
        key = f'markers.{marker}'
        if not np.all(np.abs(place.position_m) <= 10.0):
            return f'{key}.position_m is {list(place.position_m)}; give metres in the tool frame'
        if not 0.0 < place.std_m <= 1.0:
            return f'{key}.std_m is {place.std_m:g}; give metres above 0, at most 1'
    for sensor, base in content.base.items():
        key = f'base.{sensor}'
        if not np.all(np.abs(base.translation_m) <= 1000.0):
            return f'{key}.translation_m is {list(base.translation_m)}; give metres'
        if not np.isclose(np.linalg.norm(base.rotation_xyzw), 1.0, atol=1e-3):
            return f'{key}.rotation_xyzw is no unit quaternion; give x, y, z, w of length 1'
        if not 0.0 < base.std_m <= 1000.0:
            return f'{key}.std_m is {base.std_m:g}; give metres above 0'
        if not 0.0 < base.std_rad <= np.pi:
            return f'{key}.std_rad is {base.std_rad:g}; give radians above 0, at most pi'
    return ''
