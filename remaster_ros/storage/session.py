"""Session folders: the strict reader, and writers whose folder can be read at any moment."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Literal

import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InputError
from remaster_ros.core.types import Observation, Session
from remaster_ros.storage.files import (
    cannot_write,
    decode_text,
    make_new_folder,
    read_limited,
    sync_folder,
    write_atomically,
)
from remaster_ros.storage.observations import (
    check_row,
    format_header,
    format_measurements,
    format_observation,
    parse_observations,
)
from remaster_ros.storage.sequence_rules import SequenceRules
from remaster_ros.storage.session_yaml import read_header, write_header

URDF_LIMIT = 16 * 1024**2
OBSERVATIONS_LIMIT = 1024**3

ExitStatus = Literal['complete', 'stopped', 'aborted']

_HEADER = 'session.yaml'
_ROWS = 'observations.csv'
_URDF = 'robot.urdf'


def read_session(folder: str | os.PathLike[str]) -> Session:
    """Read a session folder (format ``remaster-session/1``), and refuse what does not fit it.

    Parameters
    ----------
    folder
        Holds session.yaml, observations.csv and the URDF that session.yaml names.

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
    header = read_header(folder / _HEADER)
    urdf_path = folder / header.robot.urdf
    urdf = decode_text(
        read_limited(urdf_path, URDF_LIMIT, 'robot.urdf in session.yaml names the URDF'), urdf_path
    )
    chain = _chain(urdf, urdf_path, header.robot.base_link, header.robot.tip_link)
    rows_path = folder / _ROWS
    measurements = parse_observations(
        read_limited(rows_path, OBSERVATIONS_LIMIT, 'a session folder holds observations.csv'),
        rows_path,
        chain,
        tuple(header.sensors),
        tuple(header.markers),
    )

    return Session(
        urdf=urdf,
        base_link=header.robot.base_link,
        tip_link=header.robot.tip_link,
        markers={name: np.array(position) for name, position in header.markers.items()},
        sensors={name: sensor.marker for name, sensor in header.sensors.items()},
        measurements=measurements,
        marker_std_m=header.marker_std_m,
        settle_s=header.settle_s,
        base_prior=header.priors(),
        exit_status=header.exit_status,
        notes=header.notes,
        created=header.created,
        extra=header.extra,
    )


def write_session(folder: str | os.PathLike[str], session: Session) -> None:
    """Write a whole session into a new or empty folder; numbers survive the round trip exactly.

    Raises
    ------
    InputError
        The folder holds files or cannot be written to, or the session breaks the format.
    """
    folder = Path(folder)
    chain = _chain(session.urdf, folder / _URDF, session.base_link, session.tip_link)
    header = write_header(session, _URDF, session.exit_status)
    rows = format_measurements(
        session.measurements, session.sensor_names, session.marker_names
    ).encode()
    parse_observations(rows, folder / _ROWS, chain, session.sensor_names, session.marker_names)
    make_new_folder(folder)
    write_atomically(folder / _URDF, session.urdf)
    write_atomically(folder / _ROWS, rows)
    write_atomically(folder / _HEADER, header)


class SessionWriter:
    """Write a session observation by observation; what `append` returned from is on the disk.

    The folder can be read at any moment: it says ``exit_status: aborted`` until `close`, and a
    line cut off by a crash is the only thing a reader may find incomplete. A writer is also a
    context manager: it closes as ``complete``, or as ``aborted`` where an exception passes.

    Parameters
    ----------
    folder
        New or empty.
    header
        Everything but the observations; its measurements and exit status are not used.

    Raises
    ------
    InputError
        The folder holds files or cannot be written to, or the header breaks the format.
    """

    def __init__(self, folder: str | os.PathLike[str], header: Session) -> None:
        self.folder = Path(folder)
        self._header = header
        self._chain = _chain(header.urdf, self.folder / _URDF, header.base_link, header.tip_link)
        text = write_header(header, _URDF, 'aborted')
        make_new_folder(self.folder)
        write_atomically(self.folder / _URDF, header.urdf)
        first_line = format_header(len(self._chain)).encode()
        write_atomically(self.folder / _ROWS, first_line)
        write_atomically(self.folder / _HEADER, text)
        self._rows_path = self.folder / _ROWS
        try:
            sync_folder(self.folder.parent)
            self._file: int | None = os.open(self._rows_path, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise cannot_write(self._rows_path, error) from None
        self._size = len(first_line)
        self._line = 2
        self._rules = SequenceRules()

    def append(self, observation: Observation) -> None:
        """Write one observation; durable on return.

        Raises
        ------
        InputError
            The observation breaks the format (and is not written), the writer is closed, or the
            disk does not take it.
        """
        if self._file is None:
            raise InputError(f'{self.folder}: the session is closed; start a new one')
        text = format_observation(observation)
        row = check_row(
            text,
            self._line,
            self._rows_path,
            self._chain,
            self._header.sensor_names,
            self._header.marker_names,
            self._rules,
        )
        data = text.encode()
        try:
            written = 0
            while written < len(data):
                written += os.write(self._file, data[written:])
            os.fsync(self._file)
        except OSError as error:
            # Half a line in the middle of the file would make all of it unreadable.
            os.ftruncate(self._file, self._size)
            raise cannot_write(self._rows_path, error) from None
        self._size += len(data)
        self._line += 1
        self._rules.accept(row)

    def close(self, exit_status: ExitStatus = 'complete') -> None:
        """Say in session.yaml how the session ended; closing again does nothing.

        Raises
        ------
        InputError
            session.yaml cannot be written; the session remains readable, as aborted.
        """
        if self._file is None:
            return
        os.close(self._file)
        self._file = None
        write_atomically(self.folder / _HEADER, write_header(self._header, _URDF, exit_status))

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close('complete' if kind is None else 'aborted')


def _chain(urdf: str, path: Path, base_link: str, tip_link: str) -> SerialChain:
    try:
        return SerialChain.from_urdf(urdf, base_link, tip_link)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
