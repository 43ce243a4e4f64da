"""Bring a session folder that a crash has left to rest, and say what was lost."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.bag_writer import recover_bag
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.journal import Journal
from remaster_ros.session.manifest import check_file, read_manifest
from remaster_ros.session.reader import HEADER, ROWS, URDF_LIMIT, read_chain
from remaster_ros.session.session_writer import JOURNAL, PLAN, SessionWriter
from remaster_ros.session.session_yaml import YAML_LIMIT, parse_header
from remaster_ros.types import Measurements, Session


@dataclass
class Recovery:
    """What a recovery found, in words, a line each.

    Attributes
    ----------
    finished
        Whether anything was to be finished; False where the folder was at rest.
    lost
        What could not be kept: what was being written, and never acknowledged.
    """

    finished: bool = False
    lost: list[str] = field(default_factory=list)


def recover_session(folder: str | os.PathLike[str]) -> Recovery:
    """Finish the files of a session whose recorder was killed or lost its power.

    Lines cut off while they were written are dropped, observations.csv is brought up to the
    journal, the bag is finished, and SHA256SUMS is written. Nothing that was acknowledged is
    ever dropped; a second recovery changes nothing. The exit status stays what it is.

    Raises
    ------
    InputError
        No session of a recorder, one that is being written, or a damaged one; names the file.
    """
    folder = Path(folder)
    path = folder / HEADER
    parse_header(read_limited(path, YAML_LIMIT, 'give the folder of a session'), path)
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
        _finish_session(folder, recovery)
    if (folder / PLAN).exists():
        plan = Journal(folder / PLAN)
        plan.close()
        _note(recovery, plan.lost)
    if (folder / 'bag').is_dir():
        before = read_manifest(folder / 'bag')
        _note(recovery, recover_bag(folder / 'bag'))
        recovery.finished |= read_manifest(folder / 'bag') != before
    return recovery


def _finish_session(folder: Path, recovery: Recovery) -> None:
    path = folder / HEADER
    header = parse_header(read_limited(path, YAML_LIMIT, f'{ROWS} alone is no session'), path)
    urdf_path = folder / header.robot.urdf
    urdf = decode_text(read_limited(urdf_path, URDF_LIMIT, 'it is part of a session'), urdf_path)
    chain = read_chain(urdf, urdf_path, header.robot.base_link, header.robot.tip_link)
    session = Session(
        urdf=urdf,
        base_link=header.robot.base_link,
        tip_link=header.robot.tip_link,
        markers={name: np.array(position) for name, position in header.markers.items()},
        sensors={name: sensor.marker for name, sensor in header.sensors.items()},
        measurements=Measurements.empty(len(chain)),
        marker_std_m=header.marker_std_m,
        settle_s=header.settle_s,
        base_prior=header.priors(),
    )
    writer = SessionWriter(folder, session, resume=True, even_complete=True)
    _note(recovery, writer.lost)
    for restored in writer.restored:
        _note(recovery, restored)
    try:
        writer.close(header.exit_status or 'aborted')
    finally:
        writer.release()


def _note(recovery: Recovery, lost: str) -> None:
    if lost:
        recovery.finished = True
        recovery.lost.append(lost)
