# SPDX-License-Identifier: Apache-2.0
"""What config/remaster.rviz and config/foxglove.json may hold, by the viewers' published formats.

Neither viewer is needed to run these tests. The names are those of rviz_default_plugins'
plugins_description.xml and the displays' sources (ros2/rviz, jazzy), and of the panels of
Lichtblick, the open continuation of Foxglove Studio, which reads the same layouts.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import yaml

CONFIG = Path(__file__).parents[2] / 'config'
TOPIC = {'Depth', 'Durability Policy', 'History Policy', 'Reliability Policy', 'Value'}
POLICIES = {
    'Durability Policy': {'System Default', 'Volatile', 'Transient Local'},
    'History Policy': {'System Default', 'Keep Last', 'Keep All'},
    'Reliability Policy': {'System Default', 'Reliable', 'Best Effort'},
}
# Display -> the message that it shows, and properties of its own.
DISPLAYS = {
    'Grid': (
        '',
        {'Alpha', 'Cell Size', 'Color', 'Line Style', 'Normal Cell Count', 'Offset'}
        | {'Plane', 'Plane Cell Count', 'Reference Frame'},
    ),
    'MarkerArray': ('visualization_msgs/msg/MarkerArray', {'Namespaces', 'Topic'}),
    'Pose': (
        'geometry_msgs/msg/PoseStamped',
        {'Alpha', 'Axes Length', 'Axes Radius', 'Color', 'Head Length', 'Head Radius'}
        | {'Shaft Length', 'Shaft Radius', 'Shape', 'Topic'},
    ),
    'PointStamped': (
        'geometry_msgs/msg/PointStamped',
        {'Alpha', 'Color', 'History Length', 'Radius', 'Topic'},
    ),
}
TOOLS = {'Interact', 'MoveCamera', 'Select', 'FocusCamera', 'Measure', 'PublishPoint'}
VIEWS = {'Orbit': {'Distance', 'Focal Point', 'Pitch', 'Yaw', 'Target Frame', 'Name'}}
# Panel -> keys of its settings.
PANELS = {
    '3D': {'cameraState', 'followMode', 'followTf', 'layers', 'publish', 'scene', 'topics'}
    | {'transforms'},
    'DiagnosticSummary': {'minLevel', 'pinnedIds', 'hardwareIdFilter', 'topicToRender'}
    | {'sortByLevel'},
    'Plot': {'title', 'paths', 'showXAxisLabels', 'showYAxisLabels', 'showLegend'}
    | {'legendDisplay', 'showPlotValuesInLegend', 'isSynced', 'xAxisVal', 'sidebarDimension'}
    | {'followingViewWidth', 'minYValue', 'maxYValue'},
    'RawMessages': {'topicPath', 'diffEnabled', 'diffMethod', 'diffTopicPath'}
    | {'showFullMessageForDiff'},
    'RosOut': {'searchTerms', 'minLogLevel', 'topicToRender', 'nameFilter'},
}
# What the panel Plot and others show at these topics.
SHOWN_BY_PATH = {
    '/joint_states': 'sensor_msgs/msg/JointState',
    '/remaster/joint_offsets': 'sensor_msgs/msg/JointState',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}


def rviz():
    """Return config/remaster.rviz."""
    return yaml.safe_load((CONFIG / 'remaster.rviz').read_text(encoding='utf-8'))


def foxglove():
    """Return config/foxglove.json."""
    return json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))


def topics():
    """Return topic -> message type that the viewers expect there, of both files."""
    found = {}
    for display in rviz()['Visualization Manager']['Displays']:
        kind, _ = DISPLAYS[display['Class'].partition('/')[2]]
        if kind:
            found[display['Topic']['Value']] = kind
    layout = foxglove()['configById']
    paths = [path['value'] for path in layout['Plot!joints']['paths']]
    paths += [layout['RawMessages!offsets']['topicPath']]
    paths += [layout['DiagnosticSummary!nodes']['topicToRender']]
    shown = {re.match('[/a-z0-9_]+', path)[0] for path in paths}
    found |= {topic: SHOWN_BY_PATH[topic] for topic in shown}
    # The 3-D panel takes any message that has something to draw.
    assert layout['3D!arm']['topics'].keys() <= found.keys()
    return found
