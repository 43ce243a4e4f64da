# SPDX-License-Identifier: Apache-2.0
"""Strict reader of session folders, and writer of whole sessions."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.files import (
    URDF_LIMIT,
    decode_text,
    make_new_folder,
    read_limited,
    undone_on_failure,
    write_atomically,
)
from remaster_ros.session.manifest import check_data, read_manifest
from remaster_ros.session.records.observations import (
    RowFormat,
    inverted_readings,
    optional_of,
    stacked,
)
from remaster_ros.session.records.session_yaml import (
    SessionHeader,
    parse_header,
    require_known_joints,
    write_header,
)
from remaster_ros.session.yaml_records import YAML_LIMIT
from remaster_ros.types import Measurements, Session

OBSERVATIONS_LIMIT = 1024**3

HEADER = 'session.yaml'
ROWS = 'observations.csv'
URDF = 'robot.urdf'
JOURNAL = 'journal.jsonl'
PLAN = 'plan.jsonl'

_ATTEMPTS = 10


def read_session(folder: str | os.PathLike[str], *, within_limits: bool = True) -> Session:
    """Read a session folder (format ``remaster-session/1``); refuse one that does not conform.

    The folder may be read at any moment, also while it is being written and after a power cut.

    Parameters
    ----------
    folder
        Has session.yaml, observations.csv and the URDF that session.yaml names.
    within_limits
        Refuse joint angles outside the robot's limits.

    Returns
    -------
    Session
        Every number finite, every name known, joints checked against the URDF's chain.

    Raises
    ------
    InputError
        One line naming file, line, column or key, and the remedy.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f'{folder}: no such session folder; give the folder of session.yaml')
    for _ in range(_ATTEMPTS):
        sums = read_manifest(folder)
        try:
            return _read(folder, sums, within_limits)
        except InputError:
            # A recorder may have closed the session, or gone on with it, while it was read.
            if read_manifest(folder) == sums:
                raise
    raise InputError(f'{folder}: changes faster than it can be read; try again')


def _read(folder: Path, sums: dict[str, str], within_limits: bool) -> Session:
    """Read a session with these checksums (by file name); raises InputError as `read_session`."""
    header_path = folder / HEADER
    data = read_limited(header_path, YAML_LIMIT, 'a session folder holds session.yaml')
    check_data(sums, header_path, data)
    header = parse_header(data, header_path)
    urdf, chain = read_robot(folder, header, sums)
    require_known_joints(header, chain.joint_names, header_path)
    rows_path = folder / ROWS
    data = read_limited(rows_path, OBSERVATIONS_LIMIT, 'a session folder holds observations.csv')
    check_data(sums, rows_path, data)
    names = tuple(header.sensors), tuple(header.markers)
    row_format = RowFormat(
        rows_path, chain, *names, within_limits=within_limits, moving=header.is_moving
    )
    measurements = row_format.parse(data)
    on_tool = [i for i, name in enumerate(header.sensors) if name in header.on_tool]
    measurements = inverted_readings(measurements, on_tool, str(rows_path))
    references = None
    if measurements.is_reference is not None:
        of_references = measurements.is_reference
        measurements = replace(measurements, is_reference=None)
        references = measurements.select(of_references)
        measurements = measurements.select(~of_references)
        if not len(measurements):
            raise InputError(
                f'{rows_path}: holds rows of split reference alone; measure before fitting'
            )
    session = header.session(urdf, measurements, references)
    return replace(session, observations_sha256=hashlib.sha256(data).hexdigest())


def read_header(folder: Path) -> SessionHeader:
    """Read session.yaml of a folder; raise InputError if it is missing or invalid."""
    path = folder / HEADER
    return parse_header(read_limited(path, YAML_LIMIT, f'a session folder holds {HEADER}'), path)


def read_robot(
    folder: Path, header: SessionHeader, sums: Mapping[str, str] = MappingProxyType({})
) -> tuple[str, SerialChain]:
    """Return the URDF text of a session and its arm.

    ``sums``: checksums by file name; the URDF's is compared if it is listed. Raises InputError
    if the file is missing, changed, or has no such arm.
    """
    path = folder / header.robot.urdf
    data = read_limited(path, URDF_LIMIT, 'robot.urdf in session.yaml names the URDF')
    check_data(sums, path, data)
    urdf = decode_text(data, path)
    robot = header.robot
    return urdf, read_chain(urdf, path, robot.base_link, robot.tip_link)


def write_session(folder: str | os.PathLike[str], session: Session) -> None:
    """Write a whole session into a new or empty folder; numbers are exact.

    Raises InputError if the folder has files, cannot be written to, or the session breaks the
    format.
    """
    folder = Path(folder)
    chain = read_chain(session.urdf, folder / URDF, session.base_link, session.tip_link)
    header = write_header(session, URDF, session.exit_status)
    parsed = parse_header(header.encode(), folder / HEADER)
    require_known_joints(parsed, chain.joint_names, folder / HEADER)
    names = session.sensor_names, session.marker_names
    on_tool = [i for i, name in enumerate(session.sensors) if name in session.on_tool]
    measured = inverted_readings(all_rows(session), on_tool, 'session to be written')
    row_format = RowFormat(
        folder / ROWS, chain, *names, optional_of(measured), moving=session.is_moving
    )
    rows = row_format.text(measured).encode()
    row_format.parse(rows)
    with undone_on_failure():
        make_new_folder(folder)
        write_atomically(folder / URDF, session.urdf)
        write_atomically(folder / ROWS, rows)
        write_atomically(folder / HEADER, header)


def all_rows(session: Session) -> Measurements:
    """Return all rows of a session, references included, sorted by observation number.

    References have ``is_reference``; without any the session's measurements as they are.
    """
    m, references = session.measurements, session.references
    if references is None:
        return m
    merged = stacked([m, replace(references, is_reference=np.ones(len(references), bool))])
    return merged.select(np.argsort(merged.observation, kind='stable'))


def read_chain(urdf: str, path: Path, base_link: str, tip_link: str) -> SerialChain:
    """Return the arm of a session; an InputError names the URDF file at `path`."""
    try:
        return SerialChain.from_urdf(urdf, base_link, tip_link)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
