# SPDX-License-Identifier: Apache-2.0
"""Packages that pip alone installs, and the line for a program that misses some of them.

rosdep has no key for most of them, and its two keys of rosbags and trimesh call pip, which a
Debian or Ubuntu without ``PIP_BREAK_SYSTEM_PACKAGES=1`` refuses.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.util import find_spec

# Distribution -> module. Keys of rosdep: rosdistro, rosdep/python.yaml, 2026-08-22.
FROM_PIP: Mapping[str, str] = {
    'EAIK': 'eaik',
    'mcap': 'mcap',
    'msgspec': 'msgspec',
    'plotly': 'plotly',
    'rosbags': 'rosbags',
    'threadpoolctl': 'threadpoolctl',
    'trimesh': 'trimesh',
}
WRONG_ENVIRONMENT = 2


def missing_packages() -> str:
    """Error line on the packages of `FROM_PIP` that are not installed; '' if none is missing."""
    missing = [name for name, module in FROM_PIP.items() if find_spec(module) is None]
    if not missing:
        return ''
    return (
        f'error: remaster_ros needs {", ".join(missing)}, not installed for {sys.executable}: '
        f'{sys.executable} -m pip install {" ".join(missing)}'
    )


def end_without_packages() -> None:
    """End the program, with one line on stderr, if a package of `FROM_PIP` is not installed.

    Raises SystemExit with the status `WRONG_ENVIRONMENT`, 2; nothing happens if none is
    missing.
    """
    if message := missing_packages():
        print(message, file=sys.stderr)
        raise SystemExit(WRONG_ENVIRONMENT)
