"""The nodes on real hardware: an arm behind ros2_control and the sensors of the cell file.

``ros2 launch remaster_ros real.launch.py cell:=/abs/cell.yaml params:=/abs/my.yaml``; then
``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins. Which nodes these are is
worked out in `remaster_ros.nodes.launching`.
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from remaster_ros.nodes.launching import (
    MAX_RESPAWNS,
    RESPAWN_DELAY_S,
    exit_ends_launch,
    real_nodes,
)

ARGUMENTS = ('cell', 'params', 'sensors', 'namespace', 'controller', 'joint_states')


def node_action(node, namespace):
    """Return the launch action of a node: started again where it was killed, a few times."""
    return Node(
        package='remaster_ros',
        executable=node.executable,
        name=node.name,
        namespace=namespace,
        parameters=list(node.parameters),
        remappings=list(node.remappings),
        # Of config/sros2/policy.xml; without ROS_SECURITY_ENABLE it has no effect.
        ros_arguments=['--enclave', f'/remaster/{node.executable}'],
        output='screen',
        respawn=True,
        respawn_delay=RESPAWN_DELAY_S,
        respawn_max_retries=MAX_RESPAWNS,
    )


def on_exit(event, context):
    """End everything where a node says that it is configured wrongly; no respawn helps that."""
    if exit_ends_launch(event.returncode):
        return [EmitEvent(event=Shutdown(reason=f'{event.process_name} ended with status 2'))]
    return []


def start(context):
    """Return the actions for the arguments as given; `InputError` ends the launch."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    return [node_action(node, given['namespace']) for node in real_nodes(**given)]


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument('cell', description='your cell file (mandatory)'),
            DeclareLaunchArgument(
                'params',
                description='your parameter file (mandatory): a copy of config/real.yaml',
            ),
            DeclareLaunchArgument(
                'sensors',
                default_value='all',
                description="which of the cell file's sensors, with commas",
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='of every node and name'
            ),
            DeclareLaunchArgument(
                'controller',
                default_value='',
                description="the arm's controller, such as /arm_controller; empty: "
                'joint_trajectory_controller in the namespace',
            ),
            DeclareLaunchArgument(
                'joint_states',
                default_value='',
                description='topic of its joint states; empty: joint_states in the namespace',
            ),
            RegisterEventHandler(OnProcessExit(on_exit=on_exit)),
            OpaqueFunction(function=start),
        ]
    )
