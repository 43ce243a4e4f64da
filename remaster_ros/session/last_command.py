"""Where an arm was led last and when: one small file for each robot bridge.

A bridge that is started again compares with it where the arm is reported, before it moves it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import make_folder, read_limited, write_atomically
from remaster_ros.session.halt_file import LIMIT, bridge_file
from remaster_ros.types import FloatArray


class _Kept(msgspec.Struct):
    """The joints, where the command leads (rad), and when it was sent (ns since 1970, UTC)."""

    joints: list[str]
    end: list[float]
    sent_ns: int


@dataclass(frozen=True)
class LastCommand:
    """What is known of the last command of a bridge.

    Attributes
    ----------
    end
        Where it led, rad, (k,); None where the file cannot be read, or is of other joints.
    age_s
        How long ago it was sent, s; infinite where that is not known.
    """

    end: FloatArray | None
    age_s: float


class LastCommandFile:
    """Keep where the last command leads.

    Parameters
    ----------
    node
        Fully qualified name of the bridge; with the ROS domain it names the file.
    joints
        Names of the arm's joints, in the order of all positions.
    environment
        Where ROS_HOME (by default ~/.ros) and ROS_DOMAIN_ID are.

    Attributes
    ----------
    path
        The file.
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
        except (OSError, InputError, msgspec.DecodeError):
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
