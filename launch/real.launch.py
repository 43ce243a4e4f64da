"""The six nodes on real hardware: one robot behind ros2_control, a bar and a tracker."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

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
                default_value=str(share / 'config' / 'real.yaml'),
                description='parameter file; copy config/real.yaml and put in your addresses',
            ),
            *(
                Node(package='remaster_ros', executable=name, name=name, parameters=[params])
                for name in NODES
            ),
        ]
    )
