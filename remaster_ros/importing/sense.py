"""Whether a table makes sense for the robot, and if not, which change makes it: one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.arrangement import (
    FEWEST_ROWS,
    GROSS_OFFSET_RAD,
    Arrangement,
    Fitted,
    fit_arrangement,
)
from remaster_ros.calibration.mistakes import (
    MARKER_SHIFT_M,
    MARKER_STDS,
    TRIED,
    UNKNOWN_MARKER_STD_M,
    Columns,
    find_mistakes,
    in_a_sentence,
    shown_mm,
)
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.importing.rows import RawRows
from remaster_ros.importing.units import split_unit
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import Session


@dataclass(frozen=True)
class Sense:
    """What trying the table against the robot has shown.

    Attributes
    ----------
    fits
        Whether it fits as it is.
    sentence
        What was found.
    options
        What to add to the command so that it fits; '' where nothing helps.
    error_m
        Median distance from the fit, m; None where there are too few rows to tell.
    """

    fits: bool
    sentence: str
    options: str = ''
    error_m: float | None = None


def check_sense(session: Session, rows: RawRows, progress: Callable[[str, float], None]) -> Sense:
    """Fit the table as it is and, where that is gross, as it might be meant.

    Parameters
    ----------
    session
        As it would be written.
    rows
        For the names of the columns.
    """
    # The marker is left free: one that is firm at a wrong place would bend the fit.
    part = replace(session, marker_std_m=UNKNOWN_MARKER_STD_M)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    progress('trying', 0.1)
    try:
        as_given = fit_arrangement(part, Arrangement.given(len(chain)))
    except (InputError, InsufficientDataError) as error:
        return Sense(True, f'too little to try it against the robot: {error}')
    without = shown_mm(as_given.error_m)
    allowed = max(MARKER_STDS * session.marker_std_m, MARKER_SHIFT_M)
    if not as_given.gross and as_given.marker_shift_m < allowed:
        return Sense(
            True,
            f'the robot fits to {without} (median), with zero-offsets of up to '
            f'{np.degrees(np.abs(as_given.joint_offsets).max()):.2f} degrees',
            error_m=as_given.error_m,
        )
    if len(part.measurements) < FEWEST_ROWS:
        return Sense(
            False,
            f'the data fit to {without} only, and {len(part.measurements)} rows are too few to '
            f'look for the reason (from {FEWEST_ROWS} on); check units, signs and order of the '
            'joints, and the URDF',
            error_m=as_given.error_m,
        )
    progress('trying', 0.3)
    mistakes = find_mistakes(session)
    if mistakes.fitting:
        sentence, options = in_a_sentence(mistakes, session, columns_of(rows, chain))
        return Sense(False, sentence, options, as_given.error_m)
    if not as_given.gross:
        return Sense(
            False,
            f'the marker is {1e3 * as_given.marker_shift_m:.1f} mm from where it was said to be '
            f'behind {session.tip_link}; measure its place (--marker-mm), or say how well it is '
            'known (--marker-std-mm)',
            error_m=as_given.error_m,
        )
    return _nothing_found(as_given, without)


def _nothing_found(given: Fitted, without: str) -> Sense:
    worst = int(np.argmax(np.abs(given.joint_offsets)))
    angle = given.joint_offsets[worst]
    if given.error_m < 5e-3 and abs(angle) > GROSS_OFFSET_RAD:
        return Sense(
            False,
            f'the data fit to {without} with the zero of joint {worst + 1} off by '
            f'{np.degrees(angle):.1f} degrees, more than a mastered robot has; is the URDF that '
            'of this arm?',
            error_m=given.error_m,
        )
    return Sense(
        False,
        f'the data fit to {without} only, and it is none of these, which were tried: {TRIED}; '
        'check that the URDF is that of this arm, that each point stands beside its own joints, '
        'and that one marker was measured throughout',
        error_m=given.error_m,
    )


def columns_of(rows: RawRows, chain: SerialChain) -> Columns:
    """Return how the table names what it holds, and in which units that was taken to be."""
    joints = tuple(split_unit(column)[0] for column in rows.joint_columns)
    points: dict[str, str] = {}
    lengths = ['m']
    for name, meaning in rows.columns.items():
        for axis in 'xyz':
            if meaning.startswith(f'{axis} of the marker'):
                points.setdefault(axis, name)
                if ', ' in meaning:
                    lengths.append(meaning.split(', ')[1].split()[0])
    return Columns(
        joints=joints,
        # A column without a name is called as the robot's joint.
        shown=tuple(
            own if name.isdigit() else name for name, own in zip(joints, chain.joint_names)
        ),
        points=tuple(points.get(axis, axis.upper()) for axis in 'xyz'),
        length_unit=lengths[-1],
        angle_unit=rows.angle_unit or 'rad',
    )
