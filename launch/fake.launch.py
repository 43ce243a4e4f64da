"""The same six nodes in front of the three fakes; the fake robot draws the hidden World.

``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins, ``…/fit`` fits. `remaster
demo` starts and conducts the same nodes by itself.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

FAKES = ('fake_robot', 'fake_optitrack', 'fake_laser_tracker')
NODES = (
    'pose_planner',
    'robot_bridge',
    'optitrack_markers',
    'laser_tracker_markers',
    'recorder',
    'optimizer',
)


def generate_launch_description():
    share = Path(get_package_share_directory('remaster_ros'))
    params = LaunchConfiguration('params')
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params',
                default_value=str(share / 'config' / 'fake.yaml'),
                description='parameter file of nodes and fakes',
            ),
            *(
                Node(
                    package='remaster_ros',
                    executable=name,
                    name=name,
                    parameters=[params],
                    output='screen',
                    respawn=True,
                    respawn_delay=1.0,
                )
                for name in (*FAKES, *NODES)
            ),
        ]
    )
