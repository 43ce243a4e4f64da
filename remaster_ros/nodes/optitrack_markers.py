# SPDX-License-Identifier: Apache-2.0
"""The node of `remaster_ros.sensors.optitrack.driver`."""

from __future__ import annotations

from remaster_ros.nodes.sensor_markers import run_sensor
from remaster_ros.sensors.optitrack.driver import Parameters

__all__ = ['Parameters', 'main']


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run_sensor('optitrack_markers', args, threads=1)


if __name__ == '__main__':
    raise SystemExit(main())
