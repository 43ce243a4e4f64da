"""What is known before a fit, from a YAML file: offsets, markers, base frames, the drawing.

All keys are optional::

    joint_offsets: {joint_2: {mean_deg: 0.1, std_deg: 0.05}}
    markers: {sir: {position_m: [0.1, 0.0, 0.02], std_m: 1.0e-4}}
    base: {mocap: {translation_m: [2.0, 0.0, 1.0], rotation_xyzw: [0, 0, 0, 1],
                   std_m: 1.0e-3, std_rad: 1.0e-3}}
    geometry_tolerance_mm: 0.1
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import read_limited
from remaster_ros.session.yaml_records import (
    YAML_LIMIT,
    BaseFrame,
    Bounds,
    Triple,
    read_yaml,
)
from remaster_ros.types import Priors

HELP = '; see "Priors" in docs/statistics.md'


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A key that is misspelt must not be a prior that is silently missing."""


class _Offset(_Strict):
    mean_deg: Annotated[float, Bounds(-180.0, 180.0, 'degrees')]
    std_deg: Annotated[float, Bounds(0.0, 180.0, 'degrees', above=True)]


class _Marker(_Strict):
    position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1.0, 'm', above=True)]


class _Base(BaseFrame, forbid_unknown_fields=True):
    translation_m: Annotated[Triple, Bounds(-1000.0, 1000.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1000.0, 'm', above=True)]
    std_rad: Annotated[float, Bounds(0.0, np.pi, 'rad', above=True)]


class _File(_Strict):
    joint_offsets: dict[str, _Offset] = {}
    markers: dict[str, _Marker] = {}
    base: dict[str, _Base] = {}
    geometry_tolerance_mm: Annotated[float, Bounds(0.0, 100.0, 'mm', above=True)] = 0.1


def read_priors(path: str | os.PathLike[str]) -> Priors:
    """Read and check a file of priors; the fit checks that the session has these names.

    Raises
    ------
    InputError
        One line naming file, key and remedy.
    """
    path = Path(path)
    data = read_limited(path, YAML_LIMIT, 'give a YAML file of priors')
    content = read_yaml(data, path, _File, HELP)
    for sensor, base in content.base.items():
        if problem := base.problem(f'base.{sensor}'):
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
        base={sensor: base.prior() for sensor, base in content.base.items()},
        geometry_tolerance_m=1e-3 * content.geometry_tolerance_mm,
    )
