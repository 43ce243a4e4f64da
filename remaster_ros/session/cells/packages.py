# SPDX-License-Identifier: Apache-2.0
"""Folders of ROS packages: resolves `package://NAME` and `$(find NAME)`, also without ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

# A package's name in its package.xml; attributes and comments there are rare.
_NAME = re.compile(r'<name>\s*([^<\s]+)\s*</name>')
# What a package may be called; a path is no name.
_PACKAGE = re.compile(r'[A-Za-z][\w-]*')


def find_package(name: str, file: Path, package_path: Sequence[Path] = ()) -> Path | None:
    """Return the folder of a ROS package that `file` names; None if not found.

    Searched are the given folders (which may be the package itself), the share folders of
    AMENT_PREFIX_PATH, and the folders above and beside the file: by the folder's name, then by the
    name in its package.xml, from which a clone's folder may differ.
    """
    if not _PACKAGE.fullmatch(name):
        return None
    for folder in _candidates(file, package_path):
        if (folder / name).is_dir():
            return folder / name
        if folder.name == name:
            return folder
    for folder in _candidates(file, package_path):
        for path in (folder, *_inside(folder)):
            if _declared_name(path / 'package.xml') == name:
                return path
    return None


def sourced() -> list[Path]:
    """Return the share folders of the sourced workspaces, by AMENT_PREFIX_PATH; [] without it."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return [Path(prefix) / 'share' for prefix in prefixes if prefix]


def package_of(path: Path) -> Path | None:
    """Return the folder of the ROS package that contains a file; None if there is none.

    The nearest folder above it that has a package.xml.
    """
    return next((folder for folder in path.parents if (folder / 'package.xml').is_file()), None)


class Confinement:
    """The files that a robot description may name.

    Files below its folder, below its package, below the packages that it names, below the folders
    that the user gives, and files that the user has named. Symbolic links are resolved first,
    except in a sourced workspace, whose links lead to its sources: its owner's code runs anyway.
    """

    def __init__(
        self, path: Path, package_path: Sequence[Path] = (), named: Sequence[Path] = ()
    ) -> None:
        self._named = [file.resolve() for file in named]
        self._sourced = [Path(os.path.abspath(folder)) for folder in sourced()]
        self._folders: list[Path] = []
        for folder in package_path:
            self.add(folder)
        for file in (path.absolute(), path.resolve()):
            self.add(file.parent)
            if (package := package_of(file)) is not None:
                self.add(package)

    def add(self, folder: Path) -> None:
        """Allow reading of the files below a folder."""
        self._folders.append(folder.resolve())

    def holds(self, path: Path) -> bool:
        """Return whether a file may be read: below one of the folders, or named by the user.

        Links are resolved, except below the folders of sourced workspaces, which may link
        elsewhere.
        """
        real, written = path.resolve(), Path(os.path.abspath(path))
        return (
            real in self._named
            or any(map(real.is_relative_to, self._folders))
            or any(map(written.is_relative_to, self._sourced))
        )


def _candidates(file: Path, package_path: Sequence[Path]) -> Iterator[Path]:
    """Yield folders that may be, or contain, a package that `file` names.

    First those of `package_path`, then the sourced share folders, then those above the file up
    to one named src or share, or to the one below the root.
    """
    yield from package_path
    yield from sourced()
    for folder in file.resolve().parents:
        # Above a package lies its workspace; further up there are none.
        yield folder
        if folder.name in ('src', 'share') or folder.parent == folder.parent.parent:
            return


def _inside(folder: Path) -> list[Path]:
    """Return the ROS packages (with a package.xml) among the subfolders of a folder, sorted.

    [] if it cannot be read.
    """
    try:
        return sorted(path for path in folder.iterdir() if (path / 'package.xml').is_file())
    except OSError:
        return []


def _declared_name(path: Path) -> str:
    """Return the package name in a package.xml; '' if there is none or it is unreadable."""
    try:
        if not path.is_file():
            return ''
        with path.open('rb') as file:
            found = _NAME.search(file.read(10_000).decode(errors='replace'))
    except OSError:
        return ''
    return found[1] if found else ''
