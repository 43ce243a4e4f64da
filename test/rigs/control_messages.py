# SPDX-License-Identifier: Apache-2.0
"""`control_msgs` for the tests, where the distribution's own is not installed.

The wheels of ROS 2 bring the generators of messages and rclpy's actions, but not control_msgs. The
parts of it that a FollowJointTrajectory goes through are generated here from their definitions and
compiled, so that the tests run rclpy's own action server and client on the real DDS, with the same
fields in the same order as the distribution's.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np

TOLERANCE = 'float64 position\nfloat64 velocity\nfloat64 acceleration\n'
DEFINITIONS = {
    'msg/JointTolerance.msg': f'string name\n{TOLERANCE}',
    'msg/JointComponentTolerance.msg': f'string joint_name\nuint16 component\n{TOLERANCE}',
    'action/FollowJointTrajectory.action': """
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 error_code
int32 SUCCESSFUL = 0
int32 INVALID_GOAL = -1
int32 INVALID_JOINTS = -2
int32 OLD_HEADER_TIMESTAMP = -3
int32 PATH_TOLERANCE_VIOLATED = -4
int32 GOAL_TOLERANCE_VIOLATED = -5
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
}
PACKAGE = 'control_msgs'
KINDS = (
    'rosidl_generator_c',
    'rosidl_typesupport_fastrtps_c',
    'rosidl_typesupport_introspection_c',
    'rosidl_typesupport_c',
)
"""Each becomes a library, which is linked to those before it."""


def control_messages() -> Path | None:
    """Return a folder for PYTHONPATH that has control_msgs; None where it is installed.

    Raises
    ------
    LookupError
        There is no compiler, or no generators.
    """
    name = hashlib.sha256((Path(__file__).read_text() + sys.prefix).encode()).hexdigest()[:16]
    made = Path(tempfile.gettempdir()) / f'remaster_control_msgs_{os.getuid()}_{name}'
    found = importlib.util.find_spec(PACKAGE)
    # A test before may have put the one made here among this process's own: others lack it.
    if found is not None and made not in Path(found.origin).parents:
        return None
    if shutil.which('gcc') is None or shutil.which('g++') is None:
        raise LookupError('control_msgs is not installed, and no compiler to make it')
    if importlib.util.find_spec('rosidl_generator_py') is None:
        raise LookupError('control_msgs is not installed, and no rosidl generators to make it')
    with open(f'{made}.lock', 'w') as lock:
        # Another test run may be making it.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            with tempfile.TemporaryDirectory(dir=made.parent) as folder:
                _make(Path(folder))
                (Path(folder) / 'made').rename(made)
    return made


def _make(folder: Path) -> None:
    """Generate the package's code and compile it into libraries and one Python extension."""
    from rosidl_adapter import convert_to_idl
    from rosidl_cli.command.helpers import generate_visibility_control_file
    from rosidl_generator_py.generate_py_impl import generate_py
    from rosidl_generator_type_description import generate_type_hash

    share = Path(sys.prefix) / 'share'
    definitions, made = folder / 'definitions', folder / 'made' / PACKAGE
    idl = [Path(name).with_suffix('.idl') for name in DEFINITIONS]
    for name, text in DEFINITIONS.items():
        path = definitions / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        convert_to_idl(definitions, PACKAGE, Path(name), definitions)
    arguments = {
        'package_name': PACKAGE,
        'idl_tuples': [f'{definitions}:{path}' for path in idl],
        'include_paths': [f'{path.name}:{path}' for path in share.iterdir()],
        'ros_interface_files': [str(definitions / name) for name in DEFINITIONS],
        'target_dependencies': [],
    }

    def generate(function, out, *further, template=''):
        values = {'output_dir': str(out), 'template_dir': str(share / template / 'resource')}
        file = folder / 'arguments.json'
        file.write_text(json.dumps(arguments | values))
        function(str(file), *further)

    generate(generate_type_hash, definitions)
    arguments['type_description_tuples'] = [
        f'{path}:{definitions / path.with_suffix(".json")}' for path in idl
    ]
    for kind in KINDS:
        out = folder / kind / PACKAGE
        for template in (share / kind / 'resource').glob('*visibility_control.h.in'):
            header = out / 'msg' / template.name.removesuffix('.in')
            generate_visibility_control_file(
                package_name=PACKAGE, template_path=template, output_path=header
            )
        module = importlib.import_module(kind)
        name = 'generate_typesupport_fastrtps_c' if 'fastrtps' in kind else 'generate_c'
        further = [list(KINDS[1:3])] if kind == KINDS[-1] else []
        generate(getattr(module, name), out, *further, template=kind)
    generate(generate_py, made, [KINDS[-1]], template='rosidl_generator_py')
    (made / '__init__.py').touch()
    _compile(folder, made)


def _compile(folder: Path, made: Path) -> None:
    """Compile what was generated; what is loaded by name is found beside the extension."""
    installed = Path(sys.prefix) / 'include'
    includes = [*(folder / kind for kind in KINDS), installed, *installed.iterdir()]
    includes += [Path(sysconfig.get_paths()['include']), Path(np.get_include())]
    flags = ['-O0', '-fPIC', '-w', f'-DROS_PACKAGE_NAME="{PACKAGE}"']
    flags += [f'-I{path}' for path in includes]
    libraries = Path(sys.prefix) / 'lib'
    packages = {
        text.split('/')[0] for text in ' '.join(DEFINITIONS.values()).split() if '/' in text
    }
    packages |= {'action_msgs', 'service_msgs', 'unique_identifier_msgs', 'rosidl'}
    linked = ['-Wl,--no-as-needed', '-Wl,-rpath,$ORIGIN', f'-L{libraries}', '-lfastcdr', '-lrmw']
    linked += [
        f'-l{path.stem[3:]}'
        for path in sorted(libraries.glob('lib*rosidl_*.so'))
        if path.stem[3:].split('_rosidl')[0].strip('_') in packages
        or path.stem.startswith('librosidl_')
    ]
    parts = [(folder / kind, made / f'lib{PACKAGE}__{kind}.so') for kind in KINDS]
    parts.append((made, made / f'{PACKAGE}_s__{KINDS[-1]}.so'))
    for part, library in parts:
        objects = []
        for source in [*part.rglob('*.c'), *part.rglob('*.cpp')]:
            compiler = ['gcc', '-std=c11'] if source.suffix == '.c' else ['g++', '-std=c++17']
            objects.append(f'{folder}/{len(objects)}.o')
            _run([*compiler, *flags, '-c', str(source), '-o', objects[-1]])
        name = f'-Wl,-soname,{library.name}'
        _run(['g++', '-shared', name, '-o', str(library), *objects, *linked])
        linked = [*linked, str(library)]


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f'{" ".join(command[:2])} …: {done.stderr[-2000:]}')


if __name__ == '__main__':
    print(control_messages())
