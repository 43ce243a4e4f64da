"""A halt that survives the process that was halted: one small file for each robot bridge."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from remaster_ros.errors import InputError
from remaster_ros.session.files import make_folder, read_limited, sync_folder, write_atomically

LIMIT = 64 * 1024


class _Halt(msgspec.Struct):
    """Why and since when (UTC) an arm is halted."""

    halted: str
    since: str


def bridge_file(kind: str, node: str, environment: Mapping[str, str]) -> Path:
    """Return where a bridge keeps something, by its fully qualified name and the ROS domain."""
    home = Path(environment.get('ROS_HOME') or Path.home() / '.ros')
    # No name of a node has a point: /a/b and /a_b have a file each.
    name = node.strip('/').replace('/', '.')
    domain = environment.get('ROS_DOMAIN_ID') or '0'
    return home / 'remaster_ros' / f'{kind}_{domain}_{name}.json'


class HaltFile:
    """Keep why an arm is halted until a person clears it.

    Parameters
    ----------
    node
        Fully qualified name of the bridge; with the ROS domain it names the file.
    environment
        Where ROS_HOME (by default ~/.ros) and ROS_DOMAIN_ID are.

    Attributes
    ----------
    path
        The file; it is there while the arm is halted.
    """

    def __init__(self, node: str, environment: Mapping[str, str] = os.environ) -> None:
        self.path = bridge_file('halt', node, environment)

    def read(self) -> str:
        """Return why the arm is halted, '' if it is not; a damaged file is a halt, too."""
        try:
            if not self.path.exists():
                return ''
            data = read_limited(self.path, LIMIT, 'it holds a halt')
            halt = msgspec.json.decode(data, type=_Halt)
        except (OSError, InputError, msgspec.DecodeError) as error:
            # What the disk does not answer may be a halt.
            return f'{self.path}: a halt that cannot be read ({error})'
        return f'{halt.halted} (halted {halt.since}, before this bridge was started)'

    def write(self, reason: str) -> None:
        """Keep a halt.

        Raises
        ------
        RemasterError
            The folder cannot be made or written.
        """
        make_folder(self.path.parent)
        since = datetime.now(UTC).strftime('%Y-%m-%d %H:%M:%S UTC')
        write_atomically(self.path, msgspec.json.encode(_Halt(reason, since)))

    def clear(self) -> None:
        """Remove the halt; an `OSError` where that is not possible."""
        self.path.unlink(missing_ok=True)
        if self.path.parent.is_dir():
            sync_folder(self.path.parent)
