# SPDX-License-Identifier: Apache-2.0
"""Recovery of a session folder that a crash has left incomplete, with a report of losses."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.session.bags.bag_writer import recover_bag
from remaster_ros.session.manifest import check_file, read_manifest
from remaster_ros.session.records.journal import Journal
from remaster_ros.session.records.reader import JOURNAL, PLAN, read_header, read_robot
from remaster_ros.session.records.session_writer import SessionWriter
from remaster_ros.session.records.session_yaml import SessionHeader
from remaster_ros.types import Measurements


@dataclass
class Recovery:
    """Findings of a recovery: whether anything had to be finished, and what was lost."""

    # Whether anything was to be finished; False where the folder was complete.
    finished: bool = False
    # What could not be kept, a line each: what was being written, and never acknowledged.
    lost: list[str] = field(default_factory=list)


def recover_session(folder: str | os.PathLike[str]) -> Recovery:
    """Finish the files of a session whose recorder was killed or lost its power.

    Incomplete lines are dropped, observations.csv is completed from the journal, the bag is
    finished, and SHA256SUMS is written. Nothing acknowledged is ever dropped; a second recovery
    changes nothing. The exit status is unchanged.
    Raises InputError, which names the file, if there is no session of a recorder, another process
    writes it, or it is damaged.
    """
    folder = Path(folder)
    header = read_header(folder)
    if not (folder / JOURNAL).exists():
        raise InputError(
            f'{folder}: holds no {JOURNAL}: it was not written by the recorder, and there is '
            'nothing to recover it from'
        )
    recovery = Recovery()
    sums = read_manifest(folder)
    for name in sums:
        check_file(sums, folder / name)
    if not sums or any(folder.glob('.*.tmp')):
        recovery.finished = True
        _finish_session(folder, header, recovery)
    if (folder / PLAN).exists():
        plan = Journal(folder / PLAN)
        plan.close()
        _note(recovery, plan.lost)
    if (folder / 'bag').is_dir():
        before = read_manifest(folder / 'bag')
        _note(recovery, recover_bag(folder / 'bag'))
        recovery.finished |= read_manifest(folder / 'bag') != before
    return recovery


def _finish_session(folder: Path, header: SessionHeader, recovery: Recovery) -> None:
    """Complete the session files from the journal, close the session, and note the repairs.

    Losses and repairs go into ``recovery``. The exit status is kept, 'aborted' if the header
    has none. Raises InputError as `recover_session`.
    """
    urdf, chain = read_robot(folder, header)
    session = header.session(urdf, Measurements.empty(len(chain)))
    writer = SessionWriter(folder, session, resume=True, even_complete=True)
    _note(recovery, writer.lost)
    for restored in writer.restored:
        _note(recovery, restored)
    try:
        writer.close(header.exit_status or 'aborted')
    finally:
        writer.release()


def _note(recovery: Recovery, lost: str) -> None:
    """Add a loss, one line, to `lost` of ``recovery``, and set `finished`; nothing if it is ''."""
    if lost:
        recovery.finished = True
        recovery.lost.append(lost)
