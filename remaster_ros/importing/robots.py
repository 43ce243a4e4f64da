"""The robot of a table: its description, and the links between which its joints are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.kinematics.arm_ends import likely_base, likely_tip
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.session.robot_description import read_description

# Headers of hundreds of columns are shorter, bytes.
_HEAD = 16_384


def read_robot(
    path: Path,
    base_link: str | None = None,
    tip_link: str | None = None,
    arguments: Mapping[str, str] | None = None,
    package_path: Sequence[Path] = (),
    *,
    trusted: bool = False,
    tables: Sequence[Path] = (),
) -> tuple[str, SerialChain]:
    """Read a URDF, or expand a xacro, and find the arm in it.

    Parameters
    ----------
    base_link, tip_link
        As told; None for the likely ones.
    arguments, package_path, trusted
        As of `read_description`.

    tables
        Whose joints are the arm's: of several arms it is the one that they name.

    Raises
    ------
    InputError
        Naming the file and the remedy.
    """
    urdf = read_description(path, arguments, package_path, trusted=trusted)
    try:
        model = parse_urdf(urdf)
        names = _words(tables)
        base = likely_base(model, names, sliding=True) if base_link is None else base_link
        tip = likely_tip(model, base, names, sliding=True) if tip_link is None else tip_link
        return urdf, SerialChain.from_urdf(urdf, base, tip, sliding=True)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None


def _words(tables: Sequence[Path]) -> set[str]:
    """Return the words at the beginning of text files, where their columns are named."""
    words: set[str] = set()
    for path in tables:
        if path.is_file():
            with path.open('rb') as file:
                head = file.read(_HEAD)
            words.update(re.findall(r'\w[\w-]*', head.decode('utf-8', 'replace')))
    return words
