# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions as makers publish them: URDF text, or xacro that is expanded to it.

A xacro file is expanded in a separate process with little time and memory, without this process's
environment, and, unless it is trusted, with only the functions that descriptions need
(`xacro_expansion`). A file with another extension is never expanded.
"""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.kinematics.arm_ends import likely_base, likely_tip
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.session.files import URDF_LIMIT, decode_text, read_limited

CPU_S = 30
"""Processor time for an expansion, s: the largest descriptions take 2."""
WALL_S = 30.0
"""Wall time for an expansion, s, also where a busy computer gives it little processor time."""
_KEPT = ('AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH')
"""Of the environment: where packages are, and what Python itself may need to start."""
_NAMED = ('.yaml', '.yml', '.xacro', '.urdf', '.xml')
# Headers of hundreds of columns are shorter, bytes.
_HEAD = 16_384
_COLOURS = re.compile(r'\x1b\[[0-9;]*m')
# Not -m: that would put the working folder, which may be the description's, before the modules.
_SERVE = (
    'import json, sys; request = json.load(sys.stdin); sys.path[:] = request["modules"]; '
    'from remaster_ros.session.cells.xacro_expansion import serve; serve(request)'
)

log = logging.getLogger('remaster_ros')


def is_xacro(path: Path) -> bool:
    """Return whether a description is xacro: by the extension .xacro, never by its content."""
    return path.suffix == '.xacro'


def read_description(
    path: Path,
    arguments: Mapping[str, str] | None = None,
    package_path: Sequence[Path] = (),
    *,
    trusted: bool = False,
) -> str:
    """Return the URDF text of a file, or of an expanded .xacro file.

    Parameters
    ----------
    arguments
        Arguments of ``xacro``, NAME:=VALUE. A file that one of them names, relative to the
        working folder, may be read anywhere, since the user has named it, not the description.
    package_path
        Folders to search for ROS packages, besides those around the file.
    trusted
        Whether a xacro file may do what a program may: any Python expression, any file, the
        environment.

    Raises
    ------
    InputError
        Naming the file and the remedy.
    """
    text = decode_text(read_limited(path, URDF_LIMIT, 'name a URDF or xacro file'), path)
    if not is_xacro(path):
        if arguments:
            raise InputError(
                f'{path}: is no .xacro file, which alone takes arguments; leave out '
                f'{" ".join(f"{name}:={value}" for name, value in arguments.items())}'
            )
        return text
    values = {name: _from_here(value) for name, value in (arguments or {}).items()}
    request = {
        'file': str(path.absolute()),
        'arguments': values,
        'named': [value for value in values.values() if _names_a_file(value)],
        'package_path': [str(folder.absolute()) for folder in package_path],
        'trusted': trusted,
        'cpu_s': CPU_S,
        'modules': sys.path,
    }
    kept = {name: value for name, value in os.environ.items() if trusted or name in _KEPT}
    try:
        done = subprocess.run(
            [sys.executable, '-I', '-c', _SERVE],
            input=json.dumps(request).encode(),
            capture_output=True,
            env=kept,
            check=False,
            timeout=WALL_S,
        )
    except subprocess.TimeoutExpired:
        raise _too_slow(path, f'{WALL_S:g} s; if this computer is busy, try again') from None
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise _too_slow(path, f'{CPU_S} s of processor time')
    printed = _COLOURS.sub('', done.stderr.decode(errors='replace')).splitlines()
    try:
        answer = json.loads(done.stdout)
    except ValueError:
        raise InputError(
            f'{path}: xacro ended with status {done.returncode}; correct the file '
            f'({" ".join(printed)[-200:]})'
        ) from None
    if 'error' in answer:
        raise InputError(answer['error'])
    for line in printed:
        if line.strip():
            log.warning('%s: %s', path, line.strip())
    return f'<?xml version="1.0"?>\n<!-- expanded from {path.name} by xacro -->\n{answer["text"]}'


def _names_a_file(value: str) -> bool:
    """Return whether an argument's value is an existing file with an extension of `_NAMED`."""
    path = Path(value)
    try:
        return path.suffix in _NAMED and path.is_file()
    except (OSError, ValueError):
        return False


def _from_here(value: str) -> str:
    """Return an argument's value: an absolute path if it names a file, else unchanged.

    xacro would search a relative path from the description, not from the working folder.
    """
    return str(Path(value).absolute()) if _names_a_file(value) else value


def _too_slow(path: Path, after: str) -> InputError:
    """Return the InputError for a xacro file whose expansion takes too long.

    ``after``: time after which it was ended, as text.
    """
    return InputError(
        f'{path}: xacro: it is not expanded after {after}; does a macro call itself, or double '
        'what it is given?'
    )


def read_arm(
    path: Path,
    base_link: str | None = None,
    tip_link: str | None = None,
    arguments: Mapping[str, str] | None = None,
    package_path: Sequence[Path] = (),
    *,
    trusted: bool = False,
    tables: Sequence[Path] = (),
) -> tuple[str, SerialChain]:
    """Read a URDF, or expand a xacro, and find the arm in it; return URDF text and arm.

    ``base_link``, ``tip_link``: ends of the arm, None to guess them; ``arguments,
    package_path, trusted``: as of `read_description`; ``tables``: files whose column names
    decide which of several arms it is. Raises InputError, naming the file and the remedy.
    """
    urdf = read_description(path, arguments, package_path, trusted=trusted)
    try:
        model = parse_urdf(urdf)
        names = _words(tables)
        base = likely_base(model, names) if base_link is None else base_link
        tip = likely_tip(model, base, names) if tip_link is None else tip_link
        return urdf, SerialChain.from_urdf(urdf, base, tip)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None


def _words(tables: Sequence[Path]) -> set[str]:
    """Return the words in the first 16 KiB of text files, where columns are named.

    Paths that are no files are skipped.
    """
    words: set[str] = set()
    for path in tables:
        if path.is_file():
            with path.open('rb') as file:
                head = file.read(_HEAD)
            words.update(re.findall(r'\w[\w-]*', head.decode('utf-8', 'replace')))
    return words
