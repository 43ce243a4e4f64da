"""The fixed part of the live page's 3-D view: the arm, its tool, the obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np

from remaster_ros.reports.robot_scene import RobotScene, Surface

COLORS = {'link': '#9aa7b5', 'tool': '#5b6b7b', 'marker': '#2f9e78', 'obstacle': '#b08a5a'}


def live_scene(scene: RobotScene) -> dict[str, Any]:
    """Return what `scene.js` draws: corners in the frame of their link, m, and triangles."""
    # The space that the arm can be in, for a picture that does not jump as it moves.
    reach = float(np.linalg.norm(scene.chain.T_fixed[:, :3, 3], axis=1).sum())
    return {
        'surfaces': [
            {
                'name': surface.name,
                'link': surface.link,
                'role': surface.role,
                'color': color_of(surface),
                'vertices': np.round(surface.vertices, 4).tolist(),
                'faces': surface.faces.tolist(),
            }
            for surface in scene.surfaces
        ],
        'notes': list(scene.notes),
        'reach_m': round(reach, 2),
        'lowest_m': round(-reach if scene.floor_z is None else scene.floor_z, 2),
    }


def color_of(surface: Surface) -> str:
    """Return the colour of a surface, its own or that of its role, as #rrggbb."""
    if surface.color is None:
        return COLORS[surface.role]
    return '#' + ''.join(f'{round(255 * min(max(part, 0.0), 1.0)):02x}' for part in surface.color)
