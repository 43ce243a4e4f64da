# SPDX-License-Identifier: Apache-2.0
"""Write docs/parameters.md from the nodes' parameter dataclasses: ``make docs``."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

from remaster_ros.parameters import parameter_fields

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs' / 'parameters.md'
# The order of a run, not of the alphabet; the rest follows.
FIRST = (
    'pose_planner',
    'robot_bridge',
    'optitrack_markers',
    'laser_tracker_markers',
    'sensor_markers',
    'recorder',
    'optimizer',
    'replay',
    'watch',
    'compensator',
)
HEAD = """\
# Parameters of the nodes

This page lists the parameters of the nodes, for parameter files. Written by `make docs` from the
dataclass `Parameters` of each node; a test keeps it equal. Set them in a parameter file
(`--ros-args --params-file my.yaml`; config/real.yaml is one to copy)
or one by one (`--ros-args -p settle_s:=5.0`). ROS applies sections and `-p` in the order in which
their names appear, `-p` under the name `/**`: behind a parameter file `-p` takes precedence,
unless the file has a section `/**`; the shipped ones have none. A name that a node does not know,
a wrong type or a value out of range ends it at start with one line. `ros2 param describe NODE
NAME` shows the same.
Times are in the node's time, simulated where `use_sim_time` is set, unless it says wall time.
"""


def page() -> str:
    """Return the page."""
    # The script of the demo runs a verb, which takes options and no parameter file.
    names = {path.name for path in (ROOT / 'scripts').iterdir() if path.is_file()} - {'demo'}
    order = [*FIRST, *sorted(names - set(FIRST))]
    return '\n'.join([HEAD, *(section(name) for name in order)])


def section(node: str) -> str:
    """Return the heading and the table of one node."""
    kind = importlib.import_module(f'remaster_ros.nodes.{node}').Parameters
    rows = [row(field) for field in parameter_fields(kind).values()]
    return '\n'.join(
        [
            f'## {node}',
            '',
            '| parameter | what it is (default; range) |',
            '|---|---|',
            *rows,
            '',
        ]
    )


def row(field: dataclasses.Field[Any]) -> str:
    """Return the table row of one parameter."""
    meta = field.metadata
    default = ' '.join(filter(None, (f'`{json.dumps(field.default)}`', meta['unit'])))
    allowed = ', or '.join(
        filter(
            None,
            (
                limits(meta['low'], meta['high'], meta['choices']),
                '' if meta['off'] is None else f'{meta["off"]:g}',
            ),
        )
    )
    facts = '; '.join(filter(None, (default, allowed)))
    return f'| `{field.name}` | {meta["description"]} ({facts}) |'


def limits(low: float | None, high: float | None, choices: tuple[str, ...]) -> str:
    """Return what a parameter may be, in words; '' for anything of its type."""
    if choices:
        return ', '.join(f'`{choice}`' for choice in choices)
    if low is not None and high is not None:
        return f'{low:g} to {high:g}'
    if low is not None:
        return f'at least {low:g}'
    return '' if high is None else f'at most {high:g}'


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
