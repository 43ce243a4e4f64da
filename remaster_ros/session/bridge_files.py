# SPDX-License-Identifier: Apache-2.0
"""What a robot bridge keeps on the disk from one process to the next: a halt, the last command."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import make_folder, read_limited, sync_folder, write_atomically
from remaster_ros.types import FloatArray

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

    The file at `path` is there while the arm is halted. ``node`` is the bridge's fully qualified
    name; ``environment`` has ROS_HOME (by default ~/.ros) and ROS_DOMAIN_ID.
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
        except (OSError, InputError, msgspec.DecodeError, RecursionError) as error:
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


class _Kept(msgspec.Struct):
    """The joints, where the command leads (rad), and when it was sent (ns since 1970, UTC)."""

    joints: list[str]
    end: list[float]
    sent_ns: int


@dataclass(frozen=True)
class LastCommand:
    """What is known of the last command of a bridge."""

    # Where it led, rad, (k,); None where the file cannot be read, or is of other joints.
    end: FloatArray | None
    # How long ago it was sent, s; infinite where that is not known.
    age_s: float


class LastCommandFile:
    """Keep where the last command leads.

    A bridge that is started again compares with it where the arm is reported, before it moves it.
    ``joints`` are named in the order of all positions; the rest is as of `HaltFile`.
    """

    def __init__(
        self, node: str, joints: Sequence[str], environment: Mapping[str, str] = os.environ
    ) -> None:
        self.path = bridge_file('command', node, environment)
        self._joints = list(joints)

    def read(self, now_ns: int) -> LastCommand | None:
        """Return what is known at this time (ns since 1970); None where nothing was ever sent."""
        try:
            if not self.path.exists():
                return None
            data = read_limited(self.path, LIMIT, 'it holds the last command')
            kept = msgspec.json.decode(data, type=_Kept)
        except (OSError, InputError, msgspec.DecodeError, RecursionError):
            return LastCommand(None, np.inf)
        # A clock that was set back leaves open how long ago it was.
        age_s = (now_ns - kept.sent_ns) / 1e9 if now_ns >= kept.sent_ns else np.inf
        end = np.array(kept.end)
        known = kept.joints == self._joints and end.shape == (len(self._joints),)
        return LastCommand(end if known and np.isfinite(end).all() else None, age_s)

    def write(self, end: FloatArray, sent_ns: int) -> None:
        """Keep where a command leads.

        Raises
        ------
        RemasterError
            The folder cannot be made or written.
        """
        make_folder(self.path.parent)
        write_atomically(
            self.path, msgspec.json.encode(_Kept(self._joints, end.tolist(), sent_ns))
        )
