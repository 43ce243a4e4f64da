# SPDX-License-Identifier: Apache-2.0
"""Where the arm of the bridge's tests goes, and what its true arm is where it is corrected."""

import numpy as np
from bridge_rig import CELL, CHAIN, HOME
from worlds.compensation_files import arm, save

from remaster_ros.compensation.compensator import Compensator

TARGET = HOME + np.array([0.1, 0.05, -0.1, 0.02, 0.15, -0.05, 0.3])
AWAY = HOME + np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
LOW = np.array([0.0, 0.9, 0.0, 1.2, 0.0, 0.3, 0.0])
POST = {'center_m': [*CHAIN.forward(LOW)[:2, 3].tolist(), 0.35], 'size_m': [0.06, 0.06, 0.7]}
TOOL = CHAIN.forward(HOME)[:3, 3]


def turned(q1):
    """Return the low place with joint 1 turned."""
    return np.array([q1, *LOW[1:]])


def correction(folder, offsets_deg=(), known=(), **errors):
    """Write the compensation.json of the demo's arm; return it and what it makes of angles.

    ``offsets_deg``: of all joints, or by name; ``errors``: as of `arm`.
    """
    if isinstance(offsets_deg, dict):
        offsets_deg = [offsets_deg.get(name, 0.0) for name in CHAIN.joint_names]
    if len(offsets_deg):
        errors['joint_offsets'] = np.deg2rad(offsets_deg)
    model = arm(CELL.urdf_text, CHAIN.base_link, CHAIN.tip_link, **errors)
    return save(folder, model, CELL.urdf_text, known=known), Compensator(model).command
