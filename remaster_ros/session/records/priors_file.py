# SPDX-License-Identifier: Apache-2.0
"""Files of priors: offsets, markers, registrations and geometry known before a fit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from remaster_ros.bounds import Bounds, Triple
from remaster_ros.errors import InputError
from remaster_ros.session.files import read_limited
from remaster_ros.session.records.session_yaml import PRIORS_HELP, BaseFrame
from remaster_ros.session.yaml_records import YAML_LIMIT, read_yaml
from remaster_ros.types import (
    Priors,
)


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    """Struct that refuses unknown keys: a misspelt prior must not be ignored."""


class _OffsetPrior(_Strict):
    """Prior of a joint's zero-offset in degrees, or in mm for a prismatic joint."""

    mean_deg: Annotated[float | None, Bounds(-180.0, 180.0, 'degrees')] = None
    std_deg: Annotated[float | None, Bounds(0.0, 180.0, 'degrees', above=True)] = None
    mean_mm: Annotated[float | None, Bounds(-1000.0, 1000.0, 'mm')] = None
    std_mm: Annotated[float | None, Bounds(0.0, 1000.0, 'mm', above=True)] = None

    def known(self, where: str) -> tuple[float, float, bool]:
        """Return mean and standard deviation, rad or m, and whether they are in m.

        ``where``: beginning of the message. Raises InputError unless mean and std are given in
        exactly one of degrees and mm.
        """
        degrees, lengths = (self.mean_deg, self.std_deg), (self.mean_mm, self.std_mm)
        in_m = degrees == (None, None)
        mean, std = lengths if in_m else degrees
        if mean is None or std is None or not (in_m or lengths == (None, None)):
            raise InputError(
                f'{where} has not both of mean_deg and std_deg, or of mean_mm and std_mm where '
                'the joint slides, and nothing else'
            )
        scale = 1e-3 if in_m else float(np.radians(1.0))
        return scale * mean, scale * std, in_m


class _MarkerPrior(_Strict):
    """Prior of a marker's position in the tool frame, m, with its standard deviation per axis."""

    position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1.0, 'm', above=True)]


class _StrictBase(BaseFrame, forbid_unknown_fields=True):
    """Prior of a sensor's registration, with bounds of its numbers; unknown keys are refused."""

    translation_m: Annotated[Triple, Bounds(-1000.0, 1000.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1000.0, 'm', above=True)]
    std_rad: Annotated[float, Bounds(0.0, np.pi, 'rad', above=True)]


class _Priors(_Strict):
    """Content of a file of priors; all keys are optional.

    ::

        joint_offsets: {joint_2: {mean_deg: 0.1, std_deg: 0.05}, rail: {mean_mm: 1, std_mm: 0.5}}
        markers: {sir: {position_m: [0.1, 0.0, 0.02], std_m: 1.0e-4}}
        base: {mocap: {translation_m: [2.0, 0.0, 1.0], rotation_xyzw: [0, 0, 0, 1],
                       std_m: 1.0e-3, std_rad: 1.0e-3}}
        geometry_tolerance_mm: 0.1
    """

    joint_offsets: dict[str, _OffsetPrior] = {}
    markers: dict[str, _MarkerPrior] = {}
    base: dict[str, _StrictBase] = {}
    geometry_tolerance_mm: Annotated[float, Bounds(0.0, 100.0, 'mm', above=True)] = 0.1


def read_priors(path: str | os.PathLike[str]) -> Priors:
    """Read and validate a file of priors; the fit checks that the session has these names.

    Raises InputError: one line naming file, key and remedy.
    """
    path = Path(path)
    data = read_limited(path, YAML_LIMIT, 'give a YAML file of priors')
    content = read_yaml(data, path, _Priors, PRIORS_HELP)
    for sensor, base in content.base.items():
        if problem := base.problem(f'base.{sensor}'):
            raise InputError(f'{path}: {problem}')
    known = {
        joint: prior.known(f'{path}: joint_offsets.{joint}')
        for joint, prior in content.joint_offsets.items()
    }
    return Priors(
        joint_offsets={joint: (mean, std) for joint, (mean, std, _) in known.items()},
        in_m=frozenset(joint for joint, (_, _, in_m) in known.items() if in_m),
        markers={
            marker: (np.array(prior.position_m), prior.std_m)
            for marker, prior in content.markers.items()
        },
        base={sensor: base.prior() for sensor, base in content.base.items()},
        geometry_tolerance_m=1e-3 * content.geometry_tolerance_mm,
    )
