# SPDX-License-Identifier: Apache-2.0
"""Cell files for tests: the shipped demo cell with changes."""

from pathlib import Path

import yaml

from remaster_ros.session.cells.workcell import config_path

DEMO = config_path('cells/demo.yaml').read_text(encoding='utf-8')


def edited_cell(path: Path, *changes: tuple[str, str]) -> Path:
    """Write the demo cell with these texts (old, new) in place of others."""
    text = DEMO.replace('../robots', str(config_path('robots')))
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding='utf-8')
    return path


def write_cell(path: Path, **changes) -> Path:
    """Write the demo cell with these keys changed; its URDF by an absolute path."""
    demo = config_path('cells/demo.yaml')
    cell = yaml.safe_load(demo.read_text())
    cell['robot']['urdf'] = str((demo.parent / cell['robot']['urdf']).resolve())
    path.write_text(yaml.safe_dump({**cell, **changes}))
    return path


def four_markers(path: Path, count: int = 4, **changes) -> Path:
    """Write the demo cell with a camera alone, which sees so many markers on the tool."""
    places = {
        'sir': [0.1, 0.0, 0.0],
        'sir_2': [0.02, 0.09, 0.0],
        'sir_3': [0.04, -0.06, 0.05],
        'sir_4': [-0.1, 0.0, 0.02],
    }
    markers = dict(list(places.items())[:count])
    camera = {
        'marker': 'sir',
        'further_markers': {name: number for number, name in enumerate(markers, 1) if number > 1},
        'topic': 'optitrack/marker',
        'rough_position_m': [1.9, 0.0, 1.3],
    }
    given = {'markers': markers, 'sensors': {'mocap': camera}, 'aim_at': 'mocap'}
    return write_cell(path, **{**given, **changes})
