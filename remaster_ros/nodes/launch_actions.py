# SPDX-License-Identifier: Apache-2.0
"""The description that both launch files return, of the nodes that `launching` lists."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription  # type: ignore[attr-defined]
from remaster_ros.nodes.launching import (
    MAX_RESPAWNS,
    RESPAWN_DELAY_S,
    NodeToStart,
    exit_ends_launch,
)


def describe_launch(
    nodes: Callable[..., list[NodeToStart]], arguments: dict[str, dict[str, str]]
) -> LaunchDescription:
    """Return the description of a launch file.

    ``nodes``: returns what to start from the arguments, all of them text; `InputError` ends the
    launch; ``arguments``: name -> description, and default value unless the argument is mandatory.
    """

    def start(context: Any) -> list[Node]:
        given = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        return [_action(node) for node in nodes(**given)]

    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, **options) for name, options in arguments.items()),
            RegisterEventHandler(OnProcessExit(on_exit=_on_exit)),
            OpaqueFunction(function=start),
        ]
    )


def _action(node: NodeToStart) -> Node:
    """Return the launch action of a node, which is started again if it ends.

    At most `MAX_RESPAWNS` times, each `RESPAWN_DELAY_S` after its end.
    """
    return Node(
        package='remaster_ros',
        executable=node.executable,
        name=node.name,
        namespace=node.namespace,
        parameters=list(node.parameters),
        remappings=list(node.remappings),
        ros_arguments=list(node.ros_arguments) or None,
        output='screen',
        respawn=True,
        respawn_delay=RESPAWN_DELAY_S,
        respawn_max_retries=MAX_RESPAWNS,
    )


def _on_exit(event: Any, context: Any) -> list[EmitEvent]:
    """Shut down the launch if a node is configured wrongly (`exit_ends_launch`).

    Else [], and launch starts the node again.
    """
    if exit_ends_launch(event.process_name, event.returncode):
        return [EmitEvent(event=Shutdown(reason=f'{event.process_name} ended with status 2'))]
    return []
