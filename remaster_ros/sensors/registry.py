# SPDX-License-Identifier: Apache-2.0
"""Registered sensors: one line per device."""

from __future__ import annotations

import importlib

from remaster_ros.errors import InputError
from remaster_ros.sensors.driver import Driver

DRIVERS = {
    'optitrack_markers': 'optitrack.driver:OptiTrackDriver',
    'laser_tracker_markers': 'laser_tracker.driver:LaserTrackerDriver',
    'topic_markers': 'topic.driver:TopicDriver',
}
"""First part of the names of a device's nodes -> path of its driver in this folder."""

TOPIC = 'topic_markers'
"""Sensor that reads a topic of another package's node."""
GENERIC = 'sensor_markers'
"""Executable that runs any sensor, by the name of its node."""


def kind_of(node_name: str) -> str:
    """Longest key of `DRIVERS` with which a node's name begins; '' if it begins with none."""
    return max((kind for kind in DRIVERS if node_name.startswith(kind)), key=len, default='')


def load_driver(node_name: str) -> type[Driver]:
    """Driver class of a sensor's node, by the beginning of the node's name (`DRIVERS`).

    Raises InputError if the name begins with none of the keys.
    """
    kind = kind_of(node_name)
    if not kind:
        raise InputError(
            f'{node_name}: the name of the node chooses its driver; begin it with '
            f'{" or ".join(DRIVERS)} (--ros-args -r __node:=…)'
        )
    module, _, name = DRIVERS[kind].partition(':')
    return getattr(importlib.import_module(f'remaster_ros.sensors.{module}'), name)
