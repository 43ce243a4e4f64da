# SPDX-License-Identifier: Apache-2.0
"""The same nodes in front of the three fakes; the fake robot draws the hidden World.

``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins, ``…/fit`` fits. `remaster
demo` starts and conducts the same nodes by itself.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from remaster_ros.nodes.launch_actions import describe_launch
from remaster_ros.nodes.launching import fake_nodes


def generate_launch_description():
    share = Path(get_package_share_directory('remaster_ros'))
    return describe_launch(
        fake_nodes,
        {
            'params': {
                'default_value': str(share / 'config' / 'fake.yaml'),
                'description': 'parameter file of nodes and fakes',
            },
            'namespace': {'default_value': '', 'description': 'of every node and name'},
            'dashboard': {'default_value': 'false', 'description': 'serve the live page too'},
        },
    )
