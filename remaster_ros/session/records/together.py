# SPDX-License-Identifier: Apache-2.0
"""Several sessions of one arm joined: the arm is common, everything else is each session's.

Sensors and markers of a later session get other names: their positions, errors and noise are those
of that session. So registrations, markers, errors of sensors and noise are fitted for each
session, and the arm once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.calibration.dynamics import estimate_moving
from remaster_ros.calibration.estimate import Estimate, estimate
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.one_arm import OffsetDifferences, offset_differences
from remaster_ros.errors import InputError, InsufficientDataError, MistakeFoundError
from remaster_ros.session.records.observations import stacked
from remaster_ros.types import Measurements, Session


def together(sessions: Sequence[tuple[str, Session]]) -> tuple[Session, list[str]]:
    """Join sessions; return the joint session, and for each later one a line on its new names.

    ``sessions``: name, for messages, and session. Names of sensors and markers of the second one
    end in ``_2``; a power of ten is added to the numbers of its observations.
    Raises InputError if sessions are of different robots, or one is given twice.
    """
    (first_name, first), *later_sessions = sessions
    for index, (name, session) in enumerate(later_sessions):
        _require_same_arm(first_name, first, name, session)
        for earlier_name, earlier in sessions[: index + 1]:
            if session.observations_sha256 and (
                session.observations_sha256 == earlier.observations_sha256
            ):
                raise InputError(
                    f'{name} and {earlier_name} hold the same observations: give each session once'
                )
    timed = all(session.timed for _, session in sessions)
    step = _power_of_ten(max(_largest(session, 'observation') for _, session in sessions))
    poses = 1 + max(_largest(session, 'pose') for _, session in sessions)
    configurations = 1 + max(_largest(session, 'configuration') for _, session in sessions)
    joined, references = first, [first.references]
    rows = [first.measurements]
    frames = _next_frame(first.measurements)
    stamp = _last_stamp(first)
    lines = []
    for number, (name, session) in enumerate(later_sessions, start=2):
        names = _renamed(session, joined, number)
        lines.append(
            f'{name}: its sensors and markers are {", ".join(names.values())}, its observation 1 '
            f'is {step * (number - 1) + 1}'
        )

        added = {
            'observation': step * (number - 1),
            'pose': poses * (number - 1),
            'configuration': configurations * (number - 1),
            'sensor': len(joined.sensors),
            'marker': len(joined.markers),
            # Without times stamps only order the rows.
            'stamp_s': 0.0 if timed else stamp + 1.0 - float(session.measurements.stamp_s.min()),
        }
        rows.append(_counted_on(session.measurements, added, frames))
        if session.references is not None:
            references.append(_counted_on(session.references, added, frames))
        frames += _next_frame(session.measurements)
        stamp += _last_stamp(session) - float(session.measurements.stamp_s.min()) + 1.0
        joined = replace(
            joined,
            sensors={
                **joined.sensors,
                **{names[key]: names[marker] for key, marker in session.sensors.items()},
            },
            markers={**joined.markers, **{names[key]: at for key, at in session.markers.items()}},
            further_markers={
                **joined.further_markers,
                **{
                    names[key]: tuple(names[marker] for marker in further)
                    for key, further in session.further_markers.items()
                },
            },
            base_prior={
                **joined.base_prior,
                **{names[key]: prior for key, prior in session.base_prior.items()},
            },
            sensor_kinds={
                **joined.sensor_kinds,
                **{names[key]: kind for key, kind in session.sensor_kinds.items()},
            },
            on_tool=joined.on_tool | {names[key] for key in session.on_tool},
            clock_offset_s={
                **joined.clock_offset_s,
                **{names[key]: offset for key, offset in session.clock_offset_s.items()},
            },
            oriented=joined.oriented | {names[key] for key in session.oriented},
            # The less is known of any marker, the less is said of each.
            marker_std_m=max(joined.marker_std_m, session.marker_std_m),
            settle_s=joined.settle_s if joined.settle_s == session.settle_s else None,
            notes='; '.join(note for note in (joined.notes, session.notes) if note),
        )
    given = [part for part in references if part is not None]
    joint_session = replace(
        joined,
        timed=timed,
        measurements=stacked(rows),
        references=stacked(given) if given else None,
        observations_sha256='',
    )
    return joint_session, lines


def disagreements(sessions: Sequence[tuple[str, Session]]) -> tuple[list[str], list[str]]:
    """Compare sessions' zero-offsets, each fitted alone, to see whether they are of one arm.

    Parameters
    ----------
    sessions
        Name of each, for messages, and the session; each later one is compared with the first.

    Returns
    -------
    list of str, list of str
        A sentence on each later session of which a few offsets differ, and one on each session
        or pair that cannot be compared.

    Raises
    ------
    InputError
        Most offsets differ: two arms, or one that was mastered anew in between.
    MistakeFoundError
        A mistake in the tables of one session, which explains its misfit.
    """
    found: list[tuple[str, Estimate]] = []
    differing, silent = [], []
    for name, session in sessions:
        try:
            fitted = estimate_moving if session.is_moving else estimate
            found.append((name, sound_estimate(session, fitted=fitted)))
        except MistakeFoundError as error:
            raise MistakeFoundError(f'{name}: {error}', error.options) from None
        except InsufficientDataError as error:
            silent.append(f'{name} alone does not tell whether it is of the same arm: {error}')
    for name, other in found[1:]:
        first_name, first = found[0]
        delta = offset_differences(first, other)
        if delta is None:
            silent.append(
                f'{first_name} and {name} determine no offset in common, which would tell '
                'whether they are of one arm'
            )
        elif delta.mostly:
            raise InputError(
                f'{first_name} and {name} are not of one arm as it was: {_words(delta)}. Fit them '
                'one by one, or together those sessions that were measured with one arm since it '
                'was mastered last'
            )
        elif delta.differ:
            differing.append(
                f'{first_name} and {name} do not have the same zero-offsets: {_words(delta)}. '
                'Together they give neither: fit them one by one, and find out what was changed '
                'between them (a motor, a mastering, another arm).'
            )
    return differing, silent


def _words(differences: OffsetDifferences) -> str:
    """Return a clause on the joints whose zero-offsets differ between two sessions."""
    return f'fitted one by one their zero-offsets differ, {differences.words}'


def _require_same_arm(first_name: str, first: Session, name: str, session: Session) -> None:
    """Raise InputError if two sessions have different robots or controller corrections.

    Different robots: URDF, base or tip link, or serial number, if both sessions have one.
    Corrections: those made inside the controller; a session with one and a session without one
    differ. ``first_name``, ``name``: of the sessions, for the message.
    """
    inside = [
        str(given.correction)
        if given.correction is not None and given.correction.is_inside
        else ''
        for given in (first, session)
    ]
    if inside[0] != inside[1]:
        states = ' and '.join(f'{text!r}' if text else 'none' for text in inside)
        raise InputError(
            f'{first_name} and {name} were measured with different corrections in the controller '
            f'({states}), so that their reported angles mean different things: fit them one by one'
        )
    for what, text, other in (
        ('URDF', first.urdf_sha256[:12], session.urdf_sha256[:12]),
        ('base link', first.base_link, session.base_link),
        ('tip link', first.tip_link, session.tip_link),
        ('serial number', first.serial_number, session.serial_number),
    ):
        if text and other and text != other:
            raise InputError(
                f'{first_name} and {name} are not of one arm: their {what} is {text} and {other}. '
                'Fit them one by one, or import both with the same description'
            )


def _renamed(session: Session, joined: Session, number: int) -> dict[str, str]:
    """Return a new, unused name for each sensor and marker of a session, by the old name.

    ``number``: of the session. NAME_2 for number 2; ``_2`` is added until the name is unused
    in the joined session.
    """
    taken = {*joined.sensors, *joined.markers}
    names = {}
    for name in dict.fromkeys((*session.sensors, *session.markers)):
        new = f'{name}_{number}'
        while new in taken:
            new += f'_{number}'
        names[name] = new
        taken.add(new)
    return names


def _counted_on(part: Measurements, added: Mapping[str, float], frames: int) -> Measurements:
    """Return rows with ``added[name]`` added to each value of the column ``name``.

    ``frames`` is added to the frame numbers; rows without a frame (-1) stay without one.
    """
    columns = {name: getattr(part, name) + more for name, more in added.items()}
    if part.frame is not None:
        columns['frame'] = np.where(part.frame < 0, -1, part.frame + frames)
    return replace(part, **columns)


def _power_of_ten(largest: int) -> int:
    """Return 10 to the number of digits of a whole number >= 0: 9 -> 10, 10 -> 100, 0 -> 10."""
    return int(10 ** len(str(largest)))


def _largest(session: Session, column: str) -> int:
    """Return the largest value of a column of all rows, references included; 0 without rows."""
    parts = [session.measurements, session.references]
    return max(int(getattr(part, column).max(initial=0)) for part in parts if part is not None)


def _next_frame(rows: Measurements) -> int:
    """Return the first unused frame number; 0 without frames."""
    return 0 if rows.frame is None else int(rows.frame.max(initial=-1)) + 1


def _last_stamp(session: Session) -> float:
    """Return the latest stamp of the measurements, s; 0 without rows."""
    return float(session.measurements.stamp_s.max(initial=0.0))
