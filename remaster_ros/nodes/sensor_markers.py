"""The node of any registered sensor; its name begins with that of the driver.

``ros2 run remaster_ros sensor_markers --ros-args -r __node:=NAME -p sensor:=…``; which names there
are stands in `remaster_ros.sensors.registry`. Its parameters are those below and the driver's own.
"""

from __future__ import annotations

from remaster_ros.nodes.sensor_node import run_sensor
from remaster_ros.sensors.driver import SensorParameters as Parameters
from remaster_ros.sensors.registry import GENERIC

__all__ = ['Parameters', 'main']


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run_sensor(GENERIC, args)


if __name__ == '__main__':
    raise SystemExit(main())
