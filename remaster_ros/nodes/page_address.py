"""The token of the live page, and the file that opens it: for this user alone."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import stat
from pathlib import Path

from remaster_ros.nodes.locking import runtime_folder


def page_name(domain: int, node: str) -> str:
    """Return what the files of the page are called that a node serves.

    Parameters
    ----------
    domain
        ROS_DOMAIN_ID.
    node
        The node's fully qualified name, such as ``/left/watch``.
    """
    return f'domain_{domain}{node.replace("/", "%")}'


def opening_path(name: str) -> Path:
    """Return the file that leads to the page of this name."""
    return runtime_folder() / f'{name}.html'


def kept_token(name: str) -> str:
    """Return the token of the page of this name, a new one where none is kept.

    It is kept until the computer is started again, so that a page that is open goes on when its
    node is started again. A file that others can read, or have put there, is not used.

    Parameters
    ----------
    name
        See `page_name`.
    """
    path = runtime_folder() / f'{name}.token'
    with contextlib.suppress(OSError):
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            about, kept = os.fstat(file), os.read(file, 100).decode(errors='replace')
        finally:
            os.close(file)
        private = stat.S_ISREG(about.st_mode) and not about.st_mode & 0o077
        if private and about.st_uid == os.getuid() and re.fullmatch(r'[\w-]{43}', kept):
            return kept
    token = secrets.token_urlsafe(32)
    _write(path, token)
    return token


def opening_file(name: str, url: str) -> Path:
    """Write a page that leads to the address with the token, which only this user can read.

    Output of a launch is kept in log files, where others may find it; a path is no secret.
    """
    path = opening_path(name)
    _write(path, f'<!doctype html><meta http-equiv="refresh" content="0; url={url}">\n')
    return path


def _write(path: Path, text: str) -> None:
    path.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
    with open(os.open(path, flags, 0o600), 'w', encoding='utf-8') as file:
        file.write(text)
