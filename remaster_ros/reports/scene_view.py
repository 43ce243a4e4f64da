# SPDX-License-Identifier: Apache-2.0
"""3-D view of a robot scene in a page: the scene as JSON, and the scripts that draw it.

three.js, compressed, comes with trimesh, and robot_view.js with this package: a page that holds
them and the scene fetches nothing.
"""

from __future__ import annotations

import base64
import importlib.resources
import importlib.util
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.reports.robot_scene import RobotScene, Surface

VIEWER = 'resources/templates/viewer.zip'
_REMEDY = 'install trimesh as constraints.txt has it'


def scene_to_dict(scene: RobotScene) -> dict[str, Any]:
    """Return a scene in the form that robot_view.js takes; lengths in m, matrices row by row.

    Vertices are 16-bit numbers between the lowest and the highest of their surface (0.02 mm
    for a link of a metre), these and the triangles in base64.
    """
    chain = scene.chain
    reach = np.linalg.norm(chain.T_fixed[:, :3, 3], axis=1).sum()
    return {
        'joints': list(chain.joint_names),
        'lower': [_limit(angle) for angle in chain.lower],
        'upper': [_limit(angle) for angle in chain.upper],
        'T_fixed': np.round(chain.T_fixed.reshape(-1, 16), 7).tolist(),
        'axes': chain.axes.tolist(),
        'slides': chain.slides.tolist(),
        'reach': float(reach),
        'floor_z': scene.floor_z,
        'sights': [
            {
                'sensor': sight.sensor,
                'place': np.asarray(sight.sensor_R, dtype=float).tolist(),
                'marker': np.asarray(sight.marker_T, dtype=float).tolist(),
            }
            for sight in scene.sights
        ],
        'surfaces': [_surface(surface) for surface in scene.surfaces],
        'notes': list(scene.notes),
    }


def _limit(angle: float) -> float | None:
    """Return the limit of a joint, rad or m; None if infinite."""
    return float(angle) if np.isfinite(angle) else None


def _surface(surface: Surface) -> dict[str, Any]:
    """Surface in the form that robot_view.js takes; see `scene_to_dict`."""
    low = surface.vertices.min(axis=0)
    step = np.maximum(np.ptp(surface.vertices, axis=0) / 65535.0, 1e-12)
    large = len(surface.vertices) > 65535
    return {
        'name': surface.name,
        'link': surface.link,
        'role': surface.role,
        'color': surface.color,
        'low': low.tolist(),
        'step': step.tolist(),
        'vertices': _base64(np.round((surface.vertices - low) / step), '<u2'),
        'faces': _base64(surface.faces, '<u4' if large else '<u2'),
        'wide': large,
    }


def _base64(values: Any, kind: str) -> str:
    """Return values as binary numbers in base64; ``kind``: NumPy type, '<u2': 16 bits unsigned."""
    return base64.b64encode(np.asarray(values).astype(kind).tobytes()).decode()


def three_js() -> str:
    """Return the source of three.js, taken from trimesh's viewer.

    Raises InputError if it is not there.
    """
    # Found without importing trimesh, which takes a second.
    spec = importlib.util.find_spec('trimesh')
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
    try:
        with zipfile.ZipFile(folder / VIEWER) as packed:
            page = packed.read(packed.namelist()[0]).decode('utf-8')
    except (OSError, zipfile.BadZipFile, IndexError, UnicodeDecodeError) as error:
        raise InputError(f'no three.js in {folder / VIEWER} ({error}); {_REMEDY}') from None
    # The script begins with three.js; behind it are the viewer's own parts, a function each.
    script = page.partition('<script>')[2].partition('\n(function(){')[0]
    if 'Three.js Authors' not in script or 'WebGLRenderer' not in script:
        raise InputError(f'no three.js in {folder / VIEWER}; {_REMEDY}')
    return script


def view_script(*names: str) -> str:
    """Return three.js, robot_view.js and the named scripts of this package as one script.

    Raises InputError if three.js is not there.
    """
    ours = importlib.resources.files(__package__)
    texts = [ours.joinpath(name).read_text(encoding='utf-8') for name in ('robot_view.js', *names)]
    return '\n'.join([three_js(), *texts])
