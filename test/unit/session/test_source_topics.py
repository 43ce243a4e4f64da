"""Sensors of a cell that are read by nodes of other packages."""

import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.workcell import config_path, read_cell


def cell_file(folder, keys):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    text = text.replace('../robots', str(config_path('robots')))
    text = text.replace('    topic: optitrack/marker', keys, 1)
    path = folder / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def test_its_readings_are_published_beside_those_of_other_sensors(tmp_path):
    keys = '    topic: /vrpn/tool\n    message_type: geometry_msgs/msg/PoseStamped'
    cell = read_cell(cell_file(tmp_path, keys))
    bar, tracker = cell.sensors['mocap'], cell.sensors['tracker']
    assert (bar.source, bar.topic) == ('/vrpn/tool', 'mocap/marker')
    assert (tracker.source, tracker.topic) == ('', 'laser_tracker/marker')
    assert cell.fingerprint() != read_cell('demo').fingerprint()


@pytest.mark.parametrize(
    ('keys', 'message'),
    [
        (
            '    topic: /t\n    message_type: geometry_msgs/msg/Pose',
            "message_type is 'geometry_msgs/msg/Pose'; it can be geometry_msgs/msg/PointStamped",
        ),
        (
            '    topic: /t\n    source: /s',
            'sensors.mocap.source is no key; write it as topic, and give its message_type',
        ),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, keys, message):
    with pytest.raises(InputError) as caught:
        read_cell(cell_file(tmp_path, keys))
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_stream_does_not_measure_on_request(tmp_path):
    path = cell_file(tmp_path, '    topic: optitrack/marker')
    text = path.read_text(encoding='utf-8').replace(
        'topic: laser_tracker/marker',
        'topic: /t\n    message_type: geometry_msgs/msg/PointStamped',
    )
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=r'sensors\.tracker\.single_shot is for instruments'):
        read_cell(path)
