"""The same nodes in front of the three fakes; the fake robot draws the hidden World.

``ros2 service call /remaster/collect std_srvs/srv/Trigger`` begins, ``…/fit`` fits. `remaster
demo` starts and conducts the same nodes by itself.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
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
    fake_nodes,
)


def node_action(node, namespace):
    """Return the launch action of a node: started again where it was killed, a few times."""
    return Node(
        package='remaster_ros',
        executable=node.executable,
        name=node.name,
        namespace=namespace,
        parameters=list(node.parameters),
        remappings=list(node.remappings),
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
    params = LaunchConfiguration('params').perform(context)
    namespace = LaunchConfiguration('namespace').perform(context)
    return [node_action(node, namespace) for node in fake_nodes(params)]


def generate_launch_description():
    share = Path(get_package_share_directory('remaster_ros'))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params',
                default_value=str(share / 'config' / 'fake.yaml'),
                description='parameter file of nodes and fakes',
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='of every node and name'
            ),
            RegisterEventHandler(OnProcessExit(on_exit=on_exit)),
            OpaqueFunction(function=start),
        ]
    )
