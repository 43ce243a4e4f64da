"""ROS packages as folders: where `package://NAME` and `$(find NAME)` are, also without ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

# A package's name in its package.xml; attributes and comments there are rare.
_NAME = re.compile(r'<name>\s*([^<\s]+)\s*</name>')


def find_package(name: str, beside: Path, package_path: Sequence[Path] = ()) -> Path | None:
    """Return the folder of a ROS package; None where it is not found.

    It is looked for in the given folders (which may be the package itself), in the share folders
    of AMENT_PREFIX_PATH, and above and beside the file that names it: by the name of the folder,
    then by the name in its package.xml, which a clone's folder need not have.

    Parameters
    ----------
    beside
        The file that names the package.
    package_path
        Further folders to look in.
    """
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


def _candidates(beside: Path, package_path: Sequence[Path]) -> Iterator[Path]:
    yield from package_path
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            yield Path(prefix) / 'share'
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
        found = _NAME.search(path.read_text(encoding='utf-8', errors='replace')[:10_000])
    except OSError:
        return ''
    return found[1] if found else ''
