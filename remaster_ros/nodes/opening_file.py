# SPDX-License-Identifier: Apache-2.0
"""File that leads to the live page, with its token: for this user alone."""

from __future__ import annotations

import os
from pathlib import Path

from remaster_ros.nodes.runtime_files import runtime_folder


def page_name(domain: int, node: str) -> str:
    """Return a name for the files of a live page, one for each node in each ROS domain.

    ``domain``: ROS domain id; ``node``: full name of the node that serves the page, such as
    ``/left/watch``.
    """
    return f'domain_{domain}{node.replace("/", ".")}'


def opening_path(name: str) -> Path:
    """Return the path of the HTML file that leads to the live page `name` (of `page_name`).

    Raises as `runtime_folder`.
    """
    return runtime_folder() / f'{name}.html'


def opening_file(name: str, url: str) -> Path:
    """Write a page that leads to the address with the token; return its path.

    ``name``: of `page_name`. Only this user can read it, and an earlier one is replaced. Output of
    a launch is kept in log files, where others may find it; a path is no secret.
    """
    path = opening_path(name)
    path.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    with open(os.open(path, flags, 0o600), 'w', encoding='utf-8') as file:
        file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={url}">\n')
    return path
