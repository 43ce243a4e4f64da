"""Begin a session folder, or take up one that its writer left unfinished, whatever stopped it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.session.files import (
    URDF_LIMIT,
    make_new_folder,
    read_limited,
    remove_leftovers,
    sync_folder,
    write_atomically,
    writing,
)
from remaster_ros.session.manifest import check_file, read_manifest, remove_manifest
from remaster_ros.session.reader import (
    HEADER,
    OBSERVATIONS_LIMIT,
    ROWS,
    URDF,
    read_header,
)
from remaster_ros.session.session_yaml import parse_header, with_exit_status

JOURNAL = 'journal.jsonl'
PLAN = 'plan.jsonl'

_COMPARED = ('robot', 'markers', 'sensors', 'settle_s', 'marker_std_m', 'base_prior')


class ChangedError(InputError):
    """observations.csv is not what the journal has, and no crash made it so."""


def begin(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of a session without rows into a new folder, or one with only a plan."""
    # The planner may have been there first.
    if not (folder.is_dir() and os.listdir(folder) == [PLAN]):
        make_new_folder(folder)
    with writing(folder):
        sync_folder(folder.parent)
    # session.yaml last: with it the folder is a session.
    for name in (URDF, ROWS, HEADER):
        write_atomically(folder / name, files[name])


def remove_beginnings(folder: Path, empty_rows: bytes) -> None:
    """Remove what a writer has left that was killed before the folder was a session.

    Parameters
    ----------
    folder
        The session's; left as it is where it holds a session, or anything else.
    empty_rows
        observations.csv without rows.
    """
    names = {path.name for path in folder.iterdir() if path.suffix != '.tmp'} - {PLAN}
    if HEADER in names or names - {URDF, ROWS}:
        return
    if ROWS in names and _read_rows(folder) != empty_rows:
        return
    remove_leftovers(folder)
    for name in names:
        with writing(folder / name):
            os.unlink(folder / name)


def refuse_another(folder: Path, files: Mapping[str, bytes], even_complete: bool) -> None:
    """Refuse to go on with a session that is not the one to be recorded.

    Parameters
    ----------
    folder
        Holds a session.
    files
        Name -> content of the files of the session to be recorded, without rows.
    even_complete
        Take a complete session too.

    Raises
    ------
    InputError
        Another robot, markers or sensors, a complete session, one without a journal, or files
        that changed since the session was closed.
    """
    old, new = read_header(folder), parse_header(files[HEADER], folder / HEADER)
    if old.exit_status == 'complete' and not even_complete:
        raise InputError(f'{folder}: this session is complete; name a new folder')
    urdf = read_limited(folder / old.robot.urdf, URDF_LIMIT, 'it is part of a session')
    differing = [name for name in _COMPARED if getattr(old, name) != getattr(new, name)]
    differing += ['URDF'] * (urdf != files[URDF])
    if differing:
        raise InputError(
            f'{folder}: holds an unfinished session with another {" and ".join(differing)}; '
            'to go on, start with what it was begun with; else name a new folder'
        )
    if not (folder / JOURNAL).exists() and _read_rows(folder) != files[ROWS]:
        raise InputError(
            f'{folder}: holds a session without {JOURNAL}, from which alone it could be resumed; '
            'name a new folder'
        )
    sums = read_manifest(folder)
    for name in sums:
        check_file(sums, folder / name)


def reopen(folder: Path, *, keep_status: bool) -> str:
    """Take back that a session was closed; return the text of its session.yaml.

    Parameters
    ----------
    folder
        The session's.
    keep_status
        Leave its exit status as it is; else it becomes ``aborted``.
    """
    path = folder / HEADER
    remove_leftovers(folder)
    remove_manifest(folder)
    old = path.read_text(encoding='utf-8-sig')
    text = old if keep_status else with_exit_status(old, 'aborted')
    if text != old:
        write_atomically(path, text)
    return text


def intact_size(path: Path, data: bytes, wanted: bytes, last_rows: Sequence[str]) -> int:
    """Return how many bytes of observations.csv are whole lines as the journal has them.

    Parameters
    ----------
    path
        The file, for messages.
    data
        What it holds.
    wanted
        What it must hold by the journal.
    last_rows
        The rows of the journal's last record that has any: only these can be torn.

    Raises
    ------
    ChangedError
        It differs from the journal further up than a crash can have torn it.
    """
    if wanted.startswith(data):
        return len(data)
    differing = (i for i, (a, b) in enumerate(zip(data, wanted)) if a != b)
    good = next(differing, len(wanted))
    start = wanted.rfind(b'\n', 0, good) + 1
    torn_from = len(wanted) - sum(len(row.encode()) + 1 for row in last_rows)
    # What a crash tore never reaches beyond what was being written.
    if start < torn_from or len(data) > len(wanted):
        line = data.count(b'\n', 0, start) + 1
        raise ChangedError(
            f'{path}, line {line}: not as {JOURNAL} has it; the session cannot be resumed from a '
            'file that was changed: undo that, let `remaster recover` restore it, or name a new '
            'folder'
        )
    return start


def _read_rows(folder: Path) -> bytes:
    return read_limited(folder / ROWS, OBSERVATIONS_LIMIT, f'a session folder holds {ROWS}')
