# SPDX-License-Identifier: Apache-2.0
"""Which nodes the launch files and the demo start, with which parameters and names.

This module does not import launch, so that it is tested where launch is not installed;
`launch_actions` turns the result into the actions of launch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.sensors.registry import DRIVERS, GENERIC, TOPIC, kind_of
from remaster_ros.session.cells.workcell import YAML_LIMIT, read_cell
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.strict_yaml import YamlError, load_yaml

CORE = ('pose_planner', 'robot_bridge', 'recorder', 'optimizer')
SENSORS = ('optitrack_markers', 'laser_tracker_markers')
"""The sensors that have a fake and an executable of their own."""
FAKES = ('fake_robot', 'fake_optitrack', 'fake_laser_tracker')
ALL_NODES = (*FAKES, *CORE, *SENSORS)
PAGE = 'watch'
ALL = 'all'
RESPAWN_DELAY_S = 1.0
MAX_RESPAWNS = 5
"""How often a node that was killed, or crashed, is started again."""
WRONG = 2
"""The exit status of a node that is configured wrongly, or whose device does not answer."""
FOLDERS = {
    'pose_planner': {'session': 'session', 'separate': '', 'discovery': 'discovery'},
    'recorder': {'session': 'session'},
    'optimizer': {'session': 'session', 'out': 'fit', 'discovery': 'discovery', 'prior': ''},
}
"""Parameters that are paths, with their defaults."""
COMMANDS = 'joint_trajectory_controller/joint_trajectory'


@dataclass(frozen=True)
class NodeToStart:
    """A node of a launch file."""

    # What runs, and the node's name
    executable: str
    name: str
    parameters: tuple[str | dict[str, Any], ...]  # A parameter file, then values that override it
    # From and to; relative names, so that they hold in a namespace
    remappings: tuple[tuple[str, str], ...] = ()
    namespace: str = ''  # Of the node and its names
    ros_arguments: tuple[str, ...] = ()  # Further ones


def real_nodes(
    cell: str,
    params: str,
    sensors: str = ALL,
    namespace: str = '',
    controller: str = '',
    joint_states: str = '',
    dashboard: str = 'false',
) -> list[NodeToStart]:
    """Return the nodes of a real cell: those of `CORE`, one for each sensor, the live page.

    ``cell, params``: paths of cell file and parameter file; ``sensors``: ``all``, or names of the
    cell file's sensors with commas; ``controller, joint_states``: the arm's controller and the
    topic of its joint states; empty for ros2_control's usual names in the namespace;
    ``dashboard``: ``true`` to serve the live page too.

    Raises InputError: a file is missing or wrong, a sensor is unknown or has no node in `params`,
    or a node would run on its defaults.
    """
    for name, path in (('cell', cell), ('params', params)):
        if not Path(path).is_file():
            raise InputError(f'{name}:={path}: there is no such file; name your own')
    known = read_cell(cell).sensors
    wanted = list(known) if sensors == ALL else [name.strip() for name in sensors.split(',')]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise InputError(
            f'sensors:={sensors}: {cell} has no sensor {unknown[0]!r}; it has {", ".join(known)}'
        )
    sections = read_sections(params, namespace)
    missing = [name for name in CORE if name not in sections]
    if missing:
        raise InputError(
            f'{params}: no section for {missing[0]}{_where(namespace)}, it would run on its '
            f'defaults; add /**/{missing[0]}'
        )
    by_sensor = {values.get('sensor'): name for name, values in sections.items()}
    cell_values: dict[str, Any] = {'cell': str(Path(cell).resolve())}
    remappings = []
    if controller:
        remappings.append((COMMANDS, f'{controller}/joint_trajectory'))
    if joint_states:
        remappings.append(('joint_states', joint_states))

    def start(executable: str, name: str, **values: Any) -> NodeToStart:
        # Of config/sros2/policy.xml; without ROS_SECURITY_ENABLE it has no effect.
        enclave = ('--enclave', f'/remaster/{executable}')
        parameters = (params, values) if values else (params,)
        return NodeToStart(executable, name, parameters, tuple(remappings), namespace, enclave)

    # The recorder does not wait for a sensor whose node is not started.
    require = {'require': wanted[0]} if len(wanted) == 1 < len(known) else {}
    values = {
        'pose_planner': cell_values,
        'robot_bridge': cell_values,
        'recorder': {**cell_values, **require},
        'optimizer': cell_values,
    }
    for name, folders in FOLDERS.items():
        folder_values = _beside(params, sections[name], folders)
        values[name] = {**values.get(name, {}), **folder_values}
    nodes = [start(name, name, **values.get(name, {})) for name in CORE]
    for sensor in wanted:
        node = by_sensor.get(sensor, '')
        if not node and known[sensor].source:
            # Nothing of its node has to be set.
            nodes.append(start(GENERIC, f'{TOPIC}_{sensor}', **cell_values, sensor=sensor))
            continue
        kind = kind_of(node)
        if not kind:
            raise InputError(
                f'{params}: no node for the sensor {sensor!r}{_where(namespace)}; give it a '
                f'section /**/{" or /**/".join(DRIVERS)} with "sensor: {sensor}", or leave it '
                'out with sensors:='
            )
        nodes.append(start(kind if kind in SENSORS else GENERIC, node, **cell_values))
    if _is_true('dashboard', dashboard):
        nodes.append(start(PAGE, PAGE, **cell_values, fit=values['optimizer']['out']))
    return nodes


def _beside(params: str, section: Mapping[str, Any], folders: Mapping[str, str]) -> dict[str, str]:
    """Return path parameters of a node as absolute paths, by the parameter's name.

    Relative paths count from the folder of the parameter file. ``params``: path of that file;
    ``section``: the node's values there; ``folders``: the path parameters with their defaults;
    one whose path is empty is left out.
    """
    home = Path(params).resolve().parent
    given = {key: str(section.get(key, default)) for key, default in folders.items()}
    return {key: str(home / path) for key, path in given.items() if path}


def fake_nodes(params: str, namespace: str = '', dashboard: str = 'false') -> list[NodeToStart]:
    """Return the nodes of a fake cell and its fakes, whose clock is the namespace's own.

    ``params``: path of the parameter file; ``dashboard``: ``true`` for the live page too. Raises
    InputError if there is no such file, or `dashboard` is neither true nor false.
    """
    if not Path(params).is_file():
        raise InputError(f'params:={params}: there is no such file')
    names = (*ALL_NODES, PAGE) if _is_true('dashboard', dashboard) else ALL_NODES
    return [
        NodeToStart(name, name, (params,), (('/clock', 'clock'),), namespace) for name in names
    ]


def _is_true(name: str, text: str) -> bool:
    """Whether a launch argument is 'true', in any case.

    Raises InputError, with the argument's name, if it is neither 'true' nor 'false'.
    """
    if text.lower() not in ('true', 'false'):
        raise InputError(f'{name}:={text}: true or false is needed')
    return text.lower() == 'true'


def read_sections(params: str, namespace: str = '') -> dict[str, Mapping[str, Any]]:
    """Return the sections of a parameter file that hold in a namespace, by name of the node.

    Sections ``/**/NODE`` hold in every namespace; ``/**`` alone is left out. The values are those
    below ``ros__parameters``. Raises InputError: it is no parameter file, or has a section for one
    of our nodes in another namespace: that node would run on its defaults.
    """
    path = Path(params)
    try:
        data = load_yaml(decode_text(read_limited(path, YAML_LIMIT, 'name a file'), path))
    except YamlError as error:
        raise InputError(f'{path}: {error}') from None
    if not isinstance(data, dict):
        raise InputError(f'{path}: no parameter file; begin with a copy of config/real.yaml')
    space = namespace.strip('/')
    found: dict[str, Mapping[str, Any]] = {}
    for key, section in data.items():
        values = section.get('ros__parameters') if isinstance(section, dict) else None
        if not isinstance(values, dict):
            raise InputError(f'{path}: section {key} has no ros__parameters')
        place, _, name = str(key).rpartition('/')
        if name == '**':
            continue
        if place == '/**' or place.strip('/') == space:
            found[name] = values
        elif name.startswith((*CORE, *DRIVERS, *FAKES)):
            raise InputError(
                f'{path}: section {key} is not for the nodes{_where(namespace)}, which would run '
                f'on their defaults; call it /**/{name}'
            )
    return found


def exit_ends_launch(process: str, returncode: int | None) -> bool:
    """Return whether the exit of a node's process ends the launch: a status of 2 (`WRONG`).

    With that status the node is configured wrongly. ``process``: the executable's name, a
    hyphen and a number; ``returncode``: exit status, None while it runs. The live page
    (`PAGE`) never ends the launch, as no other node needs it.
    """
    return returncode == WRONG and process.rpartition('-')[0] != PAGE


def _where(namespace: str) -> str:
    """Return ' in the namespace /NAME' for messages; '' for the root namespace."""
    return f' in the namespace /{namespace.strip("/")}' if namespace.strip('/') else ''
