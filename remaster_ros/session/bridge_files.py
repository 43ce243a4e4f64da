# SPDX-License-Identifier: Apache-2.0
"""State of a robot bridge that outlives its process: a halt, the last command."""

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
    """Reason and time (UTC) of a halt."""

    halted: str
    since: str


def bridge_file(kind: str, node: str, environment: Mapping[str, str]) -> Path:
    """Return the path of a bridge's state file: ROS_HOME/remaster_ros/KIND_DOMAIN_NODE.json.

    ``kind``: 'halt' or 'command'; ``node``: fully qualified name; ``environment``: has ROS_HOME
    (by default ~/.ros) and ROS_DOMAIN_ID (by default 0).
    """
    home = Path(environment.get('ROS_HOME') or Path.home() / '.ros')
    # Names of nodes have no dot, so that /a/b and /a_b get different files.
    name = node.strip('/').replace('/', '.')
    domain = environment.get('ROS_DOMAIN_ID') or '0'
    return home / 'remaster_ros' / f'{kind}_{domain}_{name}.json'


class HaltFile:
    """File with the reason of a halt, which exists until a person clears the halt.

    ``node``: the bridge's fully qualified name; ``environment``: has ROS_HOME (by default ~/.ros)
    and ROS_DOMAIN_ID.
    """

    def __init__(self, node: str, environment: Mapping[str, str] = os.environ) -> None:
        self.path = bridge_file('halt', node, environment)

    def read(self) -> str:
        """Return the reason and time of the halt as text, '' if there is none.

        A file that is damaged or cannot be read counts as a halt.
        """
        try:
            if not self.path.exists():
                return ''
            data = read_limited(self.path, LIMIT, 'it holds a halt')
            halt = msgspec.json.decode(data, type=_Halt)
        except (OSError, InputError, msgspec.DecodeError, RecursionError) as error:
            # An unreadable file may be a halt.
            return f'{self.path}: a halt that cannot be read ({error})'
        return f'{halt.halted} (halted {halt.since}, before this bridge was started)'

    def write(self, reason: str) -> None:
        """Store a halt and the present time, durably; raise DiskError if that is impossible."""
        make_folder(self.path.parent)
        since = datetime.now(UTC).strftime('%Y-%m-%d %H:%M:%S UTC')
        write_atomically(self.path, msgspec.json.encode(_Halt(reason, since)))

    def clear(self) -> None:
        """Remove the halt durably, if there is one; raise OSError if that is impossible."""
        self.path.unlink(missing_ok=True)
        if self.path.parent.is_dir():
            sync_folder(self.path.parent)


class _Kept(msgspec.Struct):
    """Content of the file of the last command: joints, end, next end, and time of sending."""

    joints: list[str]
    end: list[float]
    sent_ns: int
    next: list[float] | None = None  # Where the piece of the move behind it would end


@dataclass(frozen=True)
class LastCommand:
    """The last command of a bridge, as far as it is known."""

    # End of the command, rad, (k,); None if the file is damaged, or of other joints.
    end: FloatArray | None
    # Time since it was sent, s; infinite if unknown.
    age_s: float
    # End of the next piece of its move, rad, (k,): that may have been sent, too.
    next_end: FloatArray | None = None

    @property
    def places(self) -> FloatArray | None:
        """End of the command and, if known, of the next piece of its move, rad or m, (1 or 2, k).

        The arm may be anywhere between them. None if the end of the command is unknown.
        """
        ends = [end for end in (self.end, self.next_end) if end is not None]
        return None if self.end is None else np.array(ends)


class LastCommandFile:
    """File with the joint positions at the end of the last command.

    A restarted bridge compares the reported joint positions with it before it moves the arm.
    ``joints``: names, in the order of all positions; other arguments as of `HaltFile`.
    """

    def __init__(
        self, node: str, joints: Sequence[str], environment: Mapping[str, str] = os.environ
    ) -> None:
        self.path = bridge_file('command', node, environment)
        self._joints = list(joints)

    def read(self, now_ns: int) -> LastCommand | None:
        """Return the last command, with its age at ``now_ns`` (ns since 1970); None if none.

        The end is None if the file is damaged or of other joints. The age is infinite if the
        file is damaged, or the command was sent later than ``now_ns``.
        """
        try:
            if not self.path.exists():
                return None
            data = read_limited(self.path, LIMIT, 'it holds the last command')
            kept = msgspec.json.decode(data, type=_Kept)
        except (OSError, InputError, msgspec.DecodeError, RecursionError):
            return LastCommand(None, np.inf)
        # If the clock was set back, the age is unknown.
        age_s = (now_ns - kept.sent_ns) / 1e9 if now_ns >= kept.sent_ns else np.inf
        names = kept.joints == self._joints
        end, following = (
            np.array(place) if names and place and _is_place(place, len(self._joints)) else None
            for place in (kept.end, kept.next)
        )
        return LastCommand(end, age_s, following)

    def write(self, end: FloatArray, sent_ns: int, next_end: FloatArray | None = None) -> None:
        """Store the joint positions at the end of a command, rad or m, (k,), durably.

        ``sent_ns``: time it was sent, ns since 1970; ``next_end``: end of the next piece of
        the move, None if there is none. Raises DiskError if that fails.
        """
        make_folder(self.path.parent)
        write_atomically(
            self.path,
            msgspec.json.encode(
                _Kept(
                    self._joints,
                    end.tolist(),
                    sent_ns,
                    None if next_end is None else next_end.tolist(),
                )
            ),
        )


def _is_place(values: Sequence[float], joints: int) -> bool:
    """Whether values can be joint positions: finite numbers, as many as there are ``joints``."""
    return len(values) == joints and bool(np.isfinite(values).all())
