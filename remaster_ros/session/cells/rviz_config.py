# SPDX-License-Identifier: Apache-2.0
"""Configuration of RViz for a workcell: the arm, its path, the topics of the sensors."""

from __future__ import annotations

from typing import Any

from remaster_ros.session.cells.workcell import Workcell, config_path
from remaster_ros.session.files import read_limited
from remaster_ros.session.strict_yaml import dump_yaml, load_yaml
from remaster_ros.session.yaml_records import YAML_LIMIT

# Those of the live page, as RViz writes them: red; green; blue.
COLORS = ('59; 130; 196', '224; 123; 57', '168; 107; 192', '138; 143; 60')
HEAD = (
    '# rviz2 -d THIS_FILE, with `remaster watch` (or dashboard:=true at launch) for the markers\n'
    "# and /tf_static, by which the sensors' own points appear in the frame of the base.\n"
)


def rviz_config(cell: Workcell) -> str:
    """Return the text of an RViz configuration that shows what the nodes of a cell publish.

    The shipped ``config/remaster.rviz`` with the base frame and the sensors of this cell.
    """
    shipped = read_limited(config_path('remaster.rviz'), YAML_LIMIT, 'install the package again')
    content: Any = load_yaml(shipped.decode('utf-8'))
    manager = content['Visualization Manager']
    general = [
        display
        for display in manager['Displays']
        if not display['Class'].endswith('/PointStamped')
    ]
    of_sensors: list[dict[str, Any]] = []
    for number, (name, sensor) in enumerate(cell.sensors.items()):
        color = COLORS[number % len(COLORS)]
        for marker, topic in sensor.topics.items():
            of_sensors.append(
                {
                    'Class': 'rviz_default_plugins/PointStamped',
                    'Name': f'{name}: {marker}',
                    'Enabled': True,
                    'Color': color,
                    'History Length': 200,
                    'Radius': 0.01,
                    'Topic': _topic(topic),
                }
            )
        if sensor.pose_topic:
            of_sensors.append(
                {
                    'Class': 'rviz_default_plugins/Pose',
                    'Name': f'{name}: pose of {sensor.marker}',
                    'Enabled': True,
                    'Shape': 'Axes',
                    'Axes Length': 0.1,
                    'Axes Radius': 0.01,
                    'Topic': _topic(sensor.pose_topic),
                }
            )
    manager['Displays'] = general + of_sensors
    manager['Global Options']['Fixed Frame'] = cell.robot.base_link
    return HEAD + dump_yaml(content)


def _topic(name: str) -> dict[str, Any]:
    """Return the subscription to a topic; a relative name is in the root namespace."""
    return {
        'Depth': 50,
        'Durability Policy': 'Volatile',
        'History Policy': 'Keep Last',
        'Reliability Policy': 'Reliable',
        'Value': name if name.startswith('/') else f'/{name}',
    }
