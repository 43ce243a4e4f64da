# SPDX-License-Identifier: Apache-2.0
"""The configurations of RViz and Foxglove name only what these programs have.

That each topic in them has the type that is expected there is tested with running nodes, in
test/system/test_network_policy.py.
"""

import yaml
from judges.viewer_configs import (
    DISPLAYS,
    PANELS,
    POLICIES,
    TOOLS,
    TOPIC,
    VIEWS,
    foxglove,
    rviz,
    topics,
)
from rigs.command_line import refusal, remaster

from remaster_ros.session.cells.workcell import config_path, read_cell


def assert_displays(manager):
    """Every display has a class, properties and a topic that RViz knows."""
    for display in manager['Displays']:
        package, _, kind = display['Class'].partition('/')
        assert package == 'rviz_default_plugins'
        assert display.keys() <= {'Class', 'Name', 'Enabled', 'Value'} | DISPLAYS[kind][1], kind
        topic = display.get('Topic', {})
        assert topic.keys() <= TOPIC
        assert all(topic[name] in known for name, known in POLICIES.items() if topic)


def test_rviz_has_every_display_and_property():
    manager = rviz()['Visualization Manager']
    assert_displays(manager)
    assert {tool['Class'] for tool in manager['Tools']} <= {
        f'rviz_default_plugins/{name}' for name in TOOLS
    }
    view = manager['Views']['Current']
    assert view.keys() - {'Class'} <= VIEWS[view['Class'].partition('/')[2]]
    assert manager['Global Options']['Fixed Frame'] == read_cell('demo').robot.base_link
    assert {panel['Class'] for panel in rviz()['Panels']} <= {
        'rviz_common/Displays',
        'rviz_common/Time',
    }


CAMERA = """
  camera: {marker: sir, topic: /detector/board, message_type: geometry_msgs/msg/PoseStamped,
           mounted_on: tool, rough_position_m: [0.6, 0.0, 0.05]}
"""


def test_rviz_of_a_cell_shows_its_own_sensors(tmp_path):
    shipped = config_path('cells/demo.yaml')
    text = shipped.read_text(encoding='utf-8').replace('../robots', str(config_path('robots')))
    # One sensor of another name, a camera on the tool, and no tracker.
    head, remainder = text.split('  mocap:', 1)
    _, tail = remainder.split('# The tool', 1)
    tail = tail.replace('aim_at: tracker', 'aim_at: bar')
    bar = '  bar: {marker: smr, topic: hall/bar, rough_position_m: [1.9, 0.0, 1.3]}'
    cell = tmp_path / 'cell.yaml'
    cell.write_text(head + bar + CAMERA + '\n# The tool' + tail, encoding='utf-8')
    out = tmp_path / 'cell.rviz'
    remaster('watch', cell, '--rviz', out)
    content = yaml.safe_load(out.read_text(encoding='utf-8'))
    manager = content['Visualization Manager']
    assert_displays(manager)
    shown = {
        display['Topic']['Value']: display['Class'].partition('/')[2]
        for display in manager['Displays']
        if 'Topic' in display
    }
    assert shown == {
        '/remaster/markers': 'MarkerArray',
        '/remaster/target_pose': 'Pose',
        '/hall/bar': 'PointStamped',
        '/camera/marker': 'PointStamped',
        '/camera/marker/pose': 'Pose',
    }
    assert manager['Global Options']['Fixed Frame'] == read_cell(cell).robot.base_link
    assert 'already there' in refusal('watch', cell, '--rviz', out)


def leaves(layout):
    """Return the panels of a layout, which is a tree of two halves each."""
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column')
    assert 0 < layout['splitPercentage'] < 100
    return leaves(layout['first']) + leaves(layout['second'])


def test_foxglove_has_every_panel_and_setting():
    content = foxglove()
    panels = content['configById']
    assert sorted(leaves(content['layout'])) == sorted(panels), 'each panel once'
    for name, settings in panels.items():
        kind, _, number = name.partition('!')
        assert number
        assert settings.keys() <= PANELS[kind], name
    assert panels['3D!arm']['followTf'] == read_cell('demo').robot.base_link
    joints = len(read_cell('demo').chain())
    values = [path['value'] for path in panels['Plot!joints']['paths']]
    assert values == [f'/joint_states.position[{i}]' for i in range(joints)]


def test_both_show_the_arm_and_what_is_measured():
    sensors = {topic for s in read_cell('demo').sensors.values() for topic in s.topics.values()}
    shown = topics().keys()
    assert {'/remaster/markers', '/remaster/target_pose', '/joint_states'} <= shown
    assert {f'/{topic}' for topic in sensors} <= shown
