"""The six nodes on real hardware: an arm behind ros2_control, a camera bar and a laser tracker.

``ros2 launch remaster_ros real.launch.py params:=my.yaml controller:=/arm_controller``; then
``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins.
"""

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
    # More than one node listens to what the arm is told, so all of them are remapped.
    remappings = [
        (
            '/joint_trajectory_controller/joint_trajectory',
            [LaunchConfiguration('controller'), '/joint_trajectory'],
        ),
        ('/joint_states', LaunchConfiguration('joint_states')),
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params',
                default_value=str(share / 'config' / 'real.yaml'),
                description='parameter file; copy config/real.yaml and put in your addresses',
            ),
            DeclareLaunchArgument(
                'controller',
                default_value='/joint_trajectory_controller',
                description="name of the arm's joint_trajectory_controller",
            ),
            DeclareLaunchArgument(
                'joint_states',
                default_value='/joint_states',
                description='topic of its joint_state_broadcaster',
            ),
            *(
                Node(
                    package='remaster_ros',
                    executable=name,
                    name=name,
                    parameters=[params],
                    remappings=remappings,
                    # Of config/sros2/policy.xml; without ROS_SECURITY_ENABLE it has no effect.
                    ros_arguments=['--enclave', f'/remaster/{name}'],
                    output='screen',
                    respawn=True,
                    respawn_delay=1.0,
                )
                for name in NODES
            ),
        ]
    )
