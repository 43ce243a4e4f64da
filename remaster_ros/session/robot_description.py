"""Robot descriptions as their makers ship them: URDF text, or xacro that is expanded to it."""

from __future__ import annotations

import contextlib
import io
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.packages import find_package
from remaster_ros.session.reader import URDF_LIMIT

_UNDEFINED = re.compile(r'[Uu]ndefined substitution argument (\w+)')
_COLOURS = re.compile(r'\x1b\[[0-9;]*m')

log = logging.getLogger('remaster_ros')


def read_description(
    path: Path, arguments: Mapping[str, str] | None = None, package_path: Sequence[Path] = ()
) -> str:
    """Return the URDF text of a .urdf file, or of a .xacro file with these arguments.

    Parameters
    ----------
    arguments
        What ``xacro`` takes as NAME:=VALUE.
    package_path
        Folders to look for ROS packages in, beside those around the file.

    Raises
    ------
    InputError
        Naming the file and the remedy.
    """
    text = decode_text(read_limited(path, URDF_LIMIT, 'name a URDF or xacro file'), path)
    if path.suffix != '.xacro' and '<xacro:' not in text:
        return text
    return _expanded(path, dict(arguments or {}), package_path)


def _expanded(path: Path, arguments: dict[str, str], package_path: Sequence[Path]) -> str:
    # Imported here: few commands need it.
    import xacro
    from xacro import substitution_args

    def find(name: str) -> str:
        folder = find_package(name, path, package_path)
        if folder is None:
            raise InputError(
                f'{path}: it needs the ROS package {name}, which is not around it; give the '
                'folder that holds the package with --package-path, or source its workspace'
            )
        # xacro takes a relative one from the file that it stands in.
        return str(folder.absolute())

    # Outside of ROS there is no ament_index_python, by which xacro finds packages.
    before: Any = substitution_args._eval_find
    substitution_args._eval_find = find
    substitution_args._eval_dict['find'] = find
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            document = xacro.process_file(str(path), mappings=arguments)
            text = document.documentElement.toprettyxml(indent='  ')
    # A xacro file is a program: it raises whatever it leads to.
    except Exception as error:
        raise _failure(path, error) from None
    finally:
        substitution_args._eval_find = before
        substitution_args._eval_dict['find'] = before
    for line in _COLOURS.sub('', said.getvalue()).splitlines():
        if line.strip():
            log.warning('%s: %s', path, line.strip())
    return f'<?xml version="1.0"?>\n<!-- expanded from {path.name} by xacro -->\n{text}'


def _failure(path: Path, error: BaseException) -> InputError:
    """Return what went wrong in a xacro file, with the file that it is in and the remedy."""
    import xacro

    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, InputError):
            return inner
        inner = getattr(inner, 'exc', None) or inner.__cause__ or inner.__context__
    files = xacro.filestack or [str(path)]
    what = ' '.join(str(error).split()) or type(error).__name__
    missing = _UNDEFINED.search(what)
    remedy = f'; give it behind the file: {missing[1]}:=VALUE' if missing else '; correct the file'
    return InputError(f'{files[-1]}: xacro: {what[:300]}{remedy}')
