# SPDX-License-Identifier: Apache-2.0
"""ROS packages as folders: where `package://NAME` and `$(find NAME)` are, also without ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

# A package's name in its package.xml; attributes and comments there are rare.
_NAME = re.compile(r'<name>\s*([^<\s]+)\s*</name>')
# What a package may be called; a path is no name.
_PACKAGE = re.compile(r'[A-Za-z][\w-]*')


def find_package(name: str, beside: Path, package_path: Sequence[Path] = ()) -> Path | None:
    """Return the folder of a ROS package that the file `beside` names; None where it is not found.

    It is looked for in the given folders (which may be the package itself), in the share folders
    of AMENT_PREFIX_PATH, and above and beside the file that names it: by the name of the folder,
    then by the name in its package.xml, which a clone's folder need not have.
    """
    if not _PACKAGE.fullmatch(name):
        return None
    for folder in _candidates(beside, package_path):
        if (folder / name).is_dir():
            return folder / name
        if folder.name == name:
            return folder
    for folder in _candidates(beside, package_path):
        for path in (folder, *_inside(folder)):
            if _declared_name(path / 'package.xml') == name:
                return path
    return None


def sourced() -> list[Path]:
    """Return the share folders of the workspaces that are sourced."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return [Path(prefix) / 'share' for prefix in prefixes if prefix]


def package_of(path: Path) -> Path | None:
    """Return the folder of the ROS package that a file is in; None where it is in none."""
    return next((folder for folder in path.parents if (folder / 'package.xml').is_file()), None)


class Confinement:
    """Which files a robot description may name.

    Those below its own folder, below the package that it is in, below the packages that it names,
    below the folders that the user gives, and the files that the user has named. Links are
    followed before that is judged, but for what a sourced workspace has: who builds a workspace
    runs its code, and links of its files lead to their sources.
    """

    def __init__(
        self, path: Path, package_path: Sequence[Path] = (), named: Sequence[Path] = ()
    ) -> None:
        self._named = [file.resolve() for file in named]
        self._sourced = [Path(os.path.abspath(folder)) for folder in sourced()]
        self._folders: list[Path] = []
        for folder in package_path:
            self.add(folder)
        for one in (path.absolute(), path.resolve()):
            self.add(one.parent)
            if (package := package_of(one)) is not None:
                self.add(package)

    def add(self, folder: Path) -> None:
        """Take the files below a folder as well."""
        self._folders.append(folder.resolve())

    def holds(self, path: Path) -> bool:
        """Return whether a file may be read."""
        real, written = path.resolve(), Path(os.path.abspath(path))
        return (
            real in self._named
            or any(map(real.is_relative_to, self._folders))
            or any(map(written.is_relative_to, self._sourced))
        )


def _candidates(beside: Path, package_path: Sequence[Path]) -> Iterator[Path]:
    yield from package_path
    yield from sourced()
    for folder in beside.resolve().parents:
        # Above a package lies its workspace; further up there are none.
        yield folder
        if folder.name in ('src', 'share') or folder.parent == folder.parent.parent:
            return


def _inside(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if (path / 'package.xml').is_file())
    except OSError:
        return []


def _declared_name(path: Path) -> str:
    try:
        if not path.is_file():
            return ''
        with path.open('rb') as file:
            found = _NAME.search(file.read(10_000).decode(errors='replace'))
    except OSError:
        return ''
    return found[1] if found else ''
