# SPDX-License-Identifier: Apache-2.0
"""A session made from its bag without ROS: the messages, in order, go through the recorder's code.

A recorder writes each message into the bag when it receives it, so the order of messages is known.
Times of wall clocks are in no message; decisions that depended on them are taken from the
recorder's events (`SessionRecorder.take_record`). So the same bag always gives the same rows.
"""

from __future__ import annotations

import csv
import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec

from remaster_ros.collection import events
from remaster_ros.collection.message_fields import temperature_topic
from remaster_ros.errors import InputError
from remaster_ros.parameters import check_all
from remaster_ros.session.bags.bag import BagReader, live_name
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.records.reader import HEADER, OBSERVATIONS_LIMIT, ROWS
from remaster_ros.session.records.session_journal import SessionJournal
from remaster_ros.session.records.session_yaml import ExitStatus
from remaster_ros.session.session_recorder import (
    Outlet,
    Parameters,
    SessionRecorder,
    session_header,
)

log = logging.getLogger('remaster_ros')

EVENTS = '/remaster/events'

_OF = ('pose', 'split', 'sensor', 'marker')
_COUNTED = ('observation', 'configuration', 'frame')
"""Columns that number the rows of their session: a missing row shifts all later ones."""


class _Keeper:
    """Keeper of a replay: writes the session at once, and passes errors on."""

    full = ''

    def __init__(self, journal: SessionJournal) -> None:
        self.journal = journal

    def write(self, write: Callable[[], object]) -> None:
        """Call ``write`` at once; its errors are passed on."""
        write()

    def reopen(self, *, go_further: bool = False) -> None:
        """Continue a stopped session; with ``go_further``, a complete one.

        Raises as `SessionJournal.reopen`.
        """
        self.journal.reopen(go_further=go_further)

    def close(self, exit_status: ExitStatus) -> None:
        """Close the session with an exit status."""
        self.journal.close(exit_status)


class _Log(Outlet):
    """Outlet of a replay: logs warnings and errors of the session recorder, and drops all else."""

    def log(self, level: int, text: str) -> None:
        """Log a line of level warning or above, as in `logging`; others are dropped."""
        if level >= logging.WARNING:
            log.log(level, text)


@dataclass(frozen=True)
class Replayed:
    """Result of the replay of a bag: numbers of rows and of outcomes, bytes cut off at its end."""

    # Number of rows written.
    observations: int
    # Outcomes of readings and configurations.
    counts: dict[str, int]
    # Message on an incomplete message at the end of the bag.
    torn_bytes: int


def bag_folder(path: Path) -> Path:
    """Return the bag at a path: its subfolder ``bag`` if there is one, else the path itself."""
    return path / 'bag' if (path / 'bag').is_dir() else path


def session_beside(bag: Path) -> Path | None:
    """Return the session folder that contains a bag; None if the folder there is no session.

    ``bag``: folder, or file in it. The session is the folder above the bag's folder, if it has
    a session.yaml.
    """
    folder = (bag if bag.is_dir() else bag.parent).absolute().parent
    return folder if (folder / HEADER).exists() else None


def record_from_bag(
    bag: BagReader,
    out: Path,
    cell: Workcell | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Replayed:
    """Write the session of a recorder's bag into a folder, by the messages in order.

    ``out``: the session folder, new or empty; ``cell``: replaces the cell in the bag, None to
    take that; ``progress``: called with the share that is done. A session that the bag does
    not close is closed as stopped. Raises InputError if the bag is not a recorder's, it lacks
    its cell and none is given, a message is damaged, or the folder is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f'{out}: there is something already; name a new folder for the session')
    began, from_bag = _first_start(bag)
    cell = cell or from_bag
    if cell is None:
        raise InputError(
            f'{bag.path}: it does not hold the cell that it was recorded with; name the file with '
            '--cell'
        )
    p = replace(_parameters(bag, began), session=str(out))
    journal = SessionJournal(out, session_header(cell, p.settle_s))
    recorder = SessionRecorder(cell, p, _Keeper(journal), _Log())
    take = _takers(cell, recorder)
    total = sum(bag.counts.values())
    for number, (recorded, kind, data, _) in enumerate(bag):
        topic = live_name(recorded)
        if number % 1000 == 0:
            progress(number / total)
        if topic == EVENTS:
            for record in _records(bag, kind, data):
                recorder.take_record(record)
        elif topic in take:
            take[topic](bag.decoded(kind, data))
        else:
            continue
        recorder.look()
    if not journal.closed:
        recorder.close('stopped')
    return Replayed(journal.observations, dict(sorted(recorder.counts.items())), bag.torn_bytes)


def _takers(cell: Workcell, recorder: SessionRecorder) -> dict[str, Callable[[Any], object]]:
    """Return by topic the method of the recorder that processes a message of this topic.

    Keys: absolute names of the topics of joint states, of a settled arm and of joint
    solutions; and for each sensor those of its temperature and of its markers, or of its poses
    in place of the markers if it has them.
    """
    take: dict[str, Callable[[Any], object]] = {
        '/joint_states': recorder.take_joints,
        '/remaster/settled': recorder.take_settled,
        '/remaster/joint_solutions': recorder.take_solutions,
    }
    for name, sensor in cell.sensors.items():
        take[_absolute(temperature_topic(sensor.topic))] = recorder.take_temperature
        topics = {sensor.marker: sensor.pose_topic} if sensor.pose_topic else sensor.topics
        for marker, topic in topics.items():
            take[_absolute(topic)] = _marker_taker(recorder, name, marker)
    return take


def _marker_taker(recorder: SessionRecorder, sensor: str, marker: str) -> Callable[[Any], object]:
    """Return the function that takes the readings of a marker, PointStamped or PoseStamped."""
    return lambda message: recorder.take_marker(sensor, marker, message)


def _absolute(topic: str) -> str:
    """Return a topic name with one leading slash."""
    return f'/{topic.lstrip("/")}'


def _records(bag: BagReader, kind: str, data: bytes) -> list[events.EventRecord]:
    """Return the event record in a message, in a list; [] with a warning if it is not readable.

    ``kind``: message type; ``data``: serialised message.
    """
    try:
        return [events.decode(bag.decoded(kind, data).data)]
    except InputError as error:
        log.warning('%s: %s', bag.path, error)
        return []


def _first_start(bag: BagReader) -> tuple[events.RecorderBegan, Workcell | None]:
    """Return the record of the first start of a recorder in a bag, and the cell in that record.

    The cell is None if the record has none. Raises InputError if no recorder wrote the bag, or
    the cell is of another version.
    """
    for topic, kind, data, _ in bag:
        if topic != EVENTS:
            continue
        for record in _records(bag, kind, data):
            if isinstance(record.body, events.RecorderBegan):
                return record.body, _cell(bag, record.body.cell)
    raise InputError(
        f'{bag.path}: no recorder of remaster_ros has written it; `remaster import` makes a '
        'session of joint states and points'
    )


def _cell(bag: BagReader, text: str) -> Workcell | None:
    """Return the cell in a bag; None for an empty text.

    ``text``: the cell as JSON. Raises InputError if it is invalid or of another version.
    """
    if not text:
        return None
    try:
        return msgspec.json.decode(text, type=Workcell)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise InputError(
            f'{bag.path}: the cell in it is of another version ({error}); name its file with '
            '--cell'
        ) from None


def _parameters(bag: BagReader, began: events.RecorderBegan) -> Parameters:
    """Return the recorder's parameters in the bag; unknown ones are dropped, missing ones default.

    Raises InputError if one is out of range.
    """
    known = {field.name for field in fields(Parameters)}
    given: dict[str, Any] = {k: v for k, v in began.parameters.items() if k in known}
    p = Parameters(**given)
    check_all(str(bag.path), p)
    return p


def differences(session: Path, other: Path) -> list[str]:
    """Return the differences between a recorded session and the replay of its bag, a line per row.

    ``session``, ``other``: folders of the recorded and of the replayed session. [] if there
    are none. Rows are matched by pose, split, sensor, marker and previous configuration, so
    that a missing row is reported alone; numbers of observation, configuration and frame are
    not compared. Raises InputError if an observations.csv cannot be read.
    """
    ours, theirs = _rows(session), _rows(other)
    found = []
    for key, row in ours.items():
        again = theirs.pop(key, None)
        if again is None:
            found.append(f'{_name(row)} is missing')
            continue
        differs = [
            f'{column} is {again.get(column) or "empty"} instead of {value or "empty"}'
            for column, value in row.items()
            if column not in _COUNTED and again.get(column, '') != value
        ]
        if differs:
            found.append(f'{_name(row)}: {", ".join(differs)}')
    found += [f'{_name(row)} is not in the session recorded' for row in theirs.values()]
    return found


def _rows(session: Path) -> dict[tuple[str, ...], dict[str, str]]:
    """Rows of a session's observations.csv, column -> text, by what identifies a row.

    Key: pose, split, sensor, marker, previous joints and a counter for repeated keys. Raises
    InputError if the file cannot be read.
    """
    path = session / ROWS
    data = read_limited(path, OBSERVATIONS_LIMIT, 'it is part of a session')
    found: dict[tuple[str, ...], dict[str, str]] = {}
    seen: Counter[tuple[str, ...]] = Counter()
    for row in csv.DictReader(decode_text(data, path).splitlines()):
        of = tuple(v for k, v in row.items() if k in _OF or k.startswith('from_q'))
        found[*of, str(seen[of])] = row
        seen[of] += 1
    return found


def _name(row: dict[str, str]) -> str:
    """Row of observations.csv in words: number, pose, sensor, marker and stamp."""
    place = f'pose {row["pose"]}, {row["sensor"]}, {row["marker"]}, {row["stamp_s"]} s'
    return f'observation {row["observation"]} ({place})'
