"""Whether a table makes sense for the robot, and if not, which change makes it: one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from shlex import quote

import numpy as np

from remaster_ros.calibration.arrangement import (
    FEWEST_ROWS,
    GROSS_OFFSET_RAD,
    Arrangement,
    Fitted,
    fit_arrangement,
    search,
    some_rows,
)
from remaster_ros.errors import InputError, InsufficientDataError
from remaster_ros.importing.assemble import UNKNOWN_MARKER_STD_M
from remaster_ros.importing.rows import RawRows
from remaster_ros.importing.units import LENGTHS, split_unit
from remaster_ros.kinematics.arm_ends import likely_tips
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.types import Session

# A marker found so far from where it was said to be is on another link, or its place is wrong.
MARKER_STDS = 5.0
MARKER_SHIFT_M = 5e-3


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
    part = replace(some_rows(session), marker_std_m=UNKNOWN_MARKER_STD_M)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    given = Arrangement.given(len(chain))
    progress('trying', 0.1)
    try:
        as_given = fit_arrangement(part, given)
    except (InputError, InsufficientDataError) as error:
        return Sense(True, f'too little to try it against the robot: {error}')
    without = f'{_mm(as_given)}'
    if not as_given.gross:
        tip = _other_tip(part, as_given, session.marker_std_m)
        if tip is not None:
            return tip
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
    lengths = _other_lengths()
    fitting = search(part, as_given, lengths)
    if not fitting:
        return _nothing_found(as_given, without)
    found = fitting[0]
    words, options = _in_words(found.arrangement, rows, chain)
    lead = f'with {words} the data fit to {_mm(found)}; without, to {without}'
    if as_given.error_m < 2.0 * found.error_m:
        largest = np.degrees(np.abs(as_given.joint_offsets).max())
        lead = (
            f'with {words} the zero-offsets are below '
            f'{max(1.0, np.degrees(np.abs(found.joint_offsets).max())):.1f} degrees; without, one '
            f'is {largest:.0f} degrees'
        )
    others = [
        fit for fit in fitting[1:] if fit.arrangement.changes <= found.arrangement.changes + 1
    ]
    if others:
        other, instead = _in_words(others[0].arrangement, rows, chain)
        lead += f'; with {other} ({instead}) they fit as well, and the data cannot tell which'
    return Sense(False, lead, options, as_given.error_m)


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
        f'the data fit to {without} only, and no sign, order, zero position by 90 degrees, unit '
        'or shift of the rows by one mends it; check that the URDF is that of this arm, that '
        'each point stands beside its own joints, and that one marker was measured throughout',
        error_m=given.error_m,
    )


def _in_words(found: Arrangement, rows: RawRows, chain: SerialChain) -> tuple[str, str]:
    """Return what is other than given, and the options that make it so."""
    columns = [
        _short(rows.joint_columns[column], chain, joint)
        for joint, column in enumerate(found.order)
    ]
    words, options = [], []
    given = Arrangement.given(len(columns))
    if found.order != given.order:
        words.append(f'the joints in the order {", ".join(columns)}')
        names = ','.join(split_unit(rows.joint_columns[c])[0] for c in found.order)
        options.append(f'--joints {quote(names)}')
    if found.angle_scale != 1.0:
        unit = 'deg' if found.angle_scale < 1.0 else 'rad'
        words.append(f'the angles in {unit}')
        options.append(f'--angles {unit}')
    if found.length_scale != 1.0:
        unit = _unit_of(found.length_scale, rows)
        words.append(f'the points in {unit}')
        options.append(f'--length {unit}')
    if found.coupled:
        sign = '' if found.coupled > 0 else '-'
        words.append(
            f'{sign or "+"}{columns[1]} added to {columns[2]} (it counts from the horizontal)'
        )
        options.append(f'--couple {quote(f"{columns[2]}={sign}{columns[1]}")}')
    reversed_ = [columns[i] for i, sign in enumerate(found.signs) if sign < 0]
    if reversed_:
        words.append(f'{" and ".join(reversed_)} reversed')
        options.append(f'--reverse {quote(",".join(reversed_))}')
    for i, quarter in enumerate(found.quarters):
        if quarter:
            words.append(f'{90 * quarter:+d} degrees on {columns[i]}')
            options.append(f'--offset {quote(f"{columns[i]}={90 * quarter}")}')
    if found.mirrored:
        words.append('X and Y exchanged (the points are mirrored)')
        options.append('--points Y,X,Z')
    if found.shift:
        where = 'before' if found.shift > 0 else 'behind'
        words.append(f'each point moved to the joints of the row {where} it')
    return ', '.join(words), ' '.join(options)


def _short(column: str, chain: SerialChain, joint: int) -> str:
    """Return how a joint is called in a sentence: as the table has it, else as the robot has."""
    name = split_unit(column)[0]
    return chain.joint_names[joint] if name.isdigit() else name


def _unit_of(scale: float, rows: RawRows) -> str:
    """Return the unit that a length scale stands for beside the one in use."""
    size = scale * LENGTHS[length_in_use(rows)]
    return min(LENGTHS, key=lambda unit: abs(np.log(LENGTHS[unit] / size)))


def length_in_use(rows: RawRows) -> str:
    """Return the unit that the points were taken for."""
    for meaning in rows.columns.values():
        if meaning.startswith('x of the marker, '):
            return meaning.split(', ')[1].split()[0]
    return 'm'


def _other_lengths() -> tuple[float, ...]:
    sizes = LENGTHS.values()
    return tuple(sorted({a / b for a in sizes for b in sizes if a != b}))


def _other_tip(session: Session, given: Fitted, marker_std_m: float) -> Sense | None:
    """Return the link from which the marker is where it was said to be; None where it is so."""
    allowed = max(MARKER_STDS * marker_std_m, MARKER_SHIFT_M)
    if given.marker_shift_m < allowed:
        return None
    tips = likely_tips(parse_urdf(session.urdf), session.base_link)
    shifts = {}
    for tip in tips:
        if tip != session.tip_link:
            try:
                tried = fit_arrangement(replace(session, tip_link=tip), given.arrangement)
            except (InputError, InsufficientDataError):
                continue
            shifts[tip] = tried.marker_shift_m
    best = min(shifts, key=lambda tip: shifts[tip], default=None)
    if best is None or not shifts[best] < allowed:
        return Sense(
            False,
            f'the marker is {1e3 * given.marker_shift_m:.1f} mm from where it was said to be '
            f'behind {session.tip_link}; measure its place (--marker-mm), or say how well it is '
            'known (--marker-std-mm)',
            error_m=given.error_m,
        )
    return Sense(
        False,
        f'with the tip link {best} the marker is {1e3 * shifts[best]:.1f} mm from where it was '
        f'said to be; with {session.tip_link}, {1e3 * given.marker_shift_m:.1f} mm',
        f'--tip-link {best}',
        given.error_m,
    )


def _mm(fitted: Fitted) -> str:
    size = 1e3 * fitted.error_m
    return f'{size:.0f} mm' if size >= 10.0 else f'{size:.2g} mm'
