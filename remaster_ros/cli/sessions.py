# SPDX-License-Identifier: Apache-2.0
"""Reading of sessions to fit."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.errors import InputError, InsufficientDataError, MistakeFoundError
from remaster_ros.session.records.plan_journal import refuse_unimported
from remaster_ros.session.records.reader import ROWS, read_session
from remaster_ros.session.records.together import disagreements, together
from remaster_ros.types import Session

log = logging.getLogger('remaster_ros')


def read_together(folders: Sequence[Path]) -> tuple[Session, list[str]]:
    """Read one session, or several of one arm as one; return it, and lines to print.

    The lines say what is renamed, and which sessions cannot be compared; [] for one session.
    Disagreements between sessions are logged as warnings, and kept in the session. Raises
    InputError if a session cannot be read, or zero-offsets show that arms differ;
    InsufficientDataError if the rows to fit are still in the recording of a motion;
    MistakeFoundError as `read_to_fit`.
    """
    sessions = [(str(folder), read_to_fit(folder)) for folder in folders]
    for name, session in sessions:
        refuse_unimported(session, name)
    if len(sessions) == 1:
        return sessions[0][1], []
    session, lines = together(sessions)
    differing, silent = disagreements(sessions)
    for line in differing:
        log.warning('%s', line)
    return replace(session, disagreements=tuple(differing)), [*lines, *silent]


def _one_arm(session: Session, folder: Path) -> Session:
    """Return the session unchanged, if its reported joint angles mean the same in all rows.

    They do not if a correction inside the controller was on for some rows and off for others:
    then InputError is raised. Corrections made outside of the controller pass. ``folder``: for
    the error.
    """
    on = session.is_corrected
    correction = session.correction
    if correction is not None and correction.is_inside and on.any() and not on.all():
        raise InputError(
            f'{folder / ROWS}: {int(on.sum())} rows have the correction on and {int((~on).sum())} '
            f'off, and it is in the controller ({correction}), so that reported angles mean two '
            'things: fit a session of one of them; remaster verify takes both'
        )
    return session


def refuse_moving(session: Session, folder: Path, verb: str) -> None:
    """Raise InputError if the arm moved while a session was measured.

    ``folder``: of the session, ``verb``: that does not take it, both for the message.
    """
    if session.is_moving:
        raise InputError(
            f'{folder}: was measured while the arm moved, which "remaster {verb}" does not take; '
            'measure the same at standstills, or use "remaster fit" or "remaster discover"'
        )


def read_to_fit(folder: Path) -> Session:
    """Read a session to fit.

    If joints are outside their limits, MistakeFoundError names the mistake in the data that
    explains it; InputError if none does.
    """
    try:
        return _one_arm(read_session(folder), folder)
    except InputError as refused:
        try:
            session = read_session(folder, within_limits=False)
        except InputError:
            raise refused from None
        try:
            sound_estimate(session)
        except MistakeFoundError as error:
            raise MistakeFoundError(f'{refused} {error}', error.options) from None
        except (InputError, InsufficientDataError):
            pass
        raise
