"""The fixed part of the live page's 3-D view: the arm, its tool, the obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np

from remaster_ros.reports.robot_scene import RobotScene

COLORS = {'link': '#9aa7b5', 'tool': '#5b6b7b', 'marker': '#2f9e78', 'obstacle': '#b08a5a'}


def live_scene(scene: RobotScene) -> dict[str, Any]:
    """Return what `scene.js` draws: corners in the frame of their link, m, and triangles."""
    return {
        'surfaces': [
            {
                'name': surface.name,
                'link': surface.link,
                'role': surface.role,
                'color': _color(surface.color) or COLORS[surface.role],
                'vertices': np.round(surface.vertices, 4).tolist(),
                'faces': surface.faces.tolist(),
            }
            for surface in scene.surfaces
        ],
        'notes': list(scene.notes),
    }


def _color(rgb: tuple[float, float, float] | None) -> str:
    return '' if rgb is None else '#' + ''.join(f'{round(255 * part):02x}' for part in rgb)
