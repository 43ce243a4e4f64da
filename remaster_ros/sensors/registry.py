# SPDX-License-Identifier: Apache-2.0
"""The registered sensors: one line a device."""

from __future__ import annotations

import importlib

from remaster_ros.errors import InputError
from remaster_ros.sensors.driver import Driver

DRIVERS = {
    'optitrack_markers': 'optitrack.driver:OptiTrackDriver',
    'laser_tracker_markers': 'laser_tracker.driver:LaserTrackerDriver',
    'topic_markers': 'topic.driver:TopicDriver',
}
"""What the names of a device's nodes begin with, and where its driver is in this folder."""

TOPIC = 'topic_markers'
"""Reads a topic of a node that is not of this package."""
GENERIC = 'sensor_markers'
"""The executable that runs any of them, by the name given to its node."""


def kind_of(node_name: str) -> str:
    """Return the longest key of `DRIVERS` with which a node's name begins; '' for none."""
    return max((kind for kind in DRIVERS if node_name.startswith(kind)), key=len, default='')


def load_driver(node_name: str) -> type[Driver]:
    """Return the driver for the node of this name.

    Raises
    ------
    InputError
        The name begins with that of no registered sensor.
    """
    kind = kind_of(node_name)
    if not kind:
        raise InputError(
            f'{node_name}: the name of the node chooses its driver; begin it with '
            f'{" or ".join(DRIVERS)} (--ros-args -r __node:=…)'
        )
    module, _, name = DRIVERS[kind].partition(':')
    return getattr(importlib.import_module(f'remaster_ros.sensors.{module}'), name)
