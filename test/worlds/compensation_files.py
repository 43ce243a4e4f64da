# SPDX-License-Identifier: Apache-2.0
"""Arms with known errors, and their compensation.json."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.file import written
from remaster_ros.compensation.of_result import CorrectedArm
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import Controller


def arm(urdf: str, base: str = 'base_link', tip: str = 'tool', **more: object) -> ArmModel:
    """Return an arm as drawn, but for what is given, before one sensor with one marker."""
    plain = ArmModel.nominal(SerialChain.from_urdf(urdf, base, tip))
    seen = {'T_R_N': {'mocap': np.eye(4)}, 'markers': {'sir': np.array([0.1, 0.0, 0.02])}}
    return replace(plain, **{**seen, **more})  # type: ignore[arg-type]


def save(
    folder: Path,
    model: ArmModel,
    urdf: str,
    offset_std: float = 1e-5,
    known: Sequence[bool] = (),
    controller: Controller | None = None,
) -> Path:
    """Write the compensation of an arm measured from -2 to 2 rad; return the file."""
    k = model.joints
    root = np.zeros((k, len(model.parameter_names)))
    root[:, :k] = offset_std * np.eye(k)
    identifiable = tuple(known) or (True,) * k
    why = tuple('' if is_known else 'not told' for is_known in identifiable)
    described = CorrectedArm(
        replace(model, root=root), identifiable, why, np.tile([-2.0, 2.0], (k, 1))
    )
    path = folder / 'compensation.json'
    session = SimpleNamespace(
        urdf=urdf,
        urdf_sha256=hashlib.sha256(urdf.encode()).hexdigest(),
        base_link=model.chain.base_link,
        tip_link=model.chain.tip_link,
        observations_sha256='',
        correction=None,
        accuracy_option='',
        controller=controller,
        on_tool=(),
    )
    path.write_text(written(described, session, 'fit', ''), encoding='utf-8')
    return path
