# SPDX-License-Identifier: Apache-2.0
"""The nodes on real hardware: an arm behind ros2_control and the sensors of the cell file.

``ros2 launch remaster_ros real.launch.py cell:=/abs/cell.yaml params:=/abs/my.yaml``; then
``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins. Which nodes these are is
worked out in `remaster_ros.nodes.launching`.
"""

from remaster_ros.nodes.launch_actions import describe_launch
from remaster_ros.nodes.launching import real_nodes


def generate_launch_description():
    return describe_launch(
        real_nodes,
        {
            'cell': {'description': 'your cell file (mandatory)'},
            'params': {
                'description': 'your parameter file (mandatory): a copy of config/real.yaml'
            },
            'sensors': {
                'default_value': 'all',
                'description': "which of the cell file's sensors, with commas",
            },
            'namespace': {'default_value': '', 'description': 'of every node and name'},
            'controller': {
                'default_value': '',
                'description': "the arm's controller, such as /arm_controller; empty: "
                'joint_trajectory_controller in the namespace',
            },
            'joint_states': {
                'default_value': '',
                'description': 'topic of its joint states; empty: joint_states in the namespace',
            },
            'dashboard': {'default_value': 'false', 'description': 'serve the live page too'},
        },
    )
