# SPDX-License-Identifier: Apache-2.0
"""Whether a table is consistent with the robot and, if not, which change makes it so."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration import estimate
from remaster_ros.calibration.arrangement import (
    FEWEST_ROWS,
    MOST_ROWS,
    Arrangement,
    Fitted,
    fit_arrangement,
)
from remaster_ros.calibration.gauge_words import counted
from remaster_ros.calibration.mistakes import (
    MARKER_SHIFT_M,
    TRIED,
    UNKNOWN_MARKER_STD_M,
    Columns,
    find_mistakes,
    sentence_of_mistakes,
    shown_mm,
)
from remaster_ros.calibration.priors import DISPLACED, LARGEST_OFFSET, UNCALIBRATED_ERROR_M
from remaster_ros.calibration.rows_off import RowsOff, find_rows_off
from remaster_ros.errors import InsufficientDataError
from remaster_ros.importing.raw_rows import RawRows
from remaster_ros.importing.units import split_unit
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, Session

# Joint angles closer than this, rad, are one configuration: the last digits of a pendant.
SAME_JOINTS_RAD = 1e-3
# Points closer than this to the nominal arm, m, are computed from its joints, not measured.
COMPUTED_M = 2e-5
# Rows below this distance from the fit, m, are not reported as outliers. Good rows of an LBR
# iiwa, which bends under its weight, were up to 3 mm off; three times that is a choice.
BENT_M = 0.01
# Zero-offsets above this, rad, are not errors of mastering but another zero position.
_LARGEST_UNMASTERED = np.pi / 4.0
# Option that accepts offsets below that limit, with all other checks.
NEVER_MASTERED = '--never-mastered'
# Number of rows that a sentence names.
SHOWN_ROWS = 5
# End of the finding on measured orientations that fit nothing.
ON_TOOL = '; poses that a camera on the tool has of a board that stands need --on-tool'


@dataclass(frozen=True)
class Sense:
    """Result of fitting a table to the robot: whether it fits, the finding, and the remedy."""

    fits: bool  # Whether the table fits the robot without a change
    sentence: str  # The finding, for people
    options: str = ''  # Options of the command with which the table fits; '' if none helps
    error_m: float | None = None  # Median distance from the fit, m; None if there are too few rows
    # Rows of the table that do not fit, with their distances, m, the farthest first
    rows_off: tuple[tuple[str, float], ...] = ()
    warning: str = ''  # Sentence on these rows with the remedy; '' if the table does not fit


def check_sense(
    session: Session,
    rows: RawRows,
    progress: Callable[[str, float], None],
    never_mastered: bool = False,
) -> Sense:
    """Fit the table to the robot and, if the error is gross, look for the mistake in it.

    A table fits if its errors are within 5 mm and zero-offsets within 5 degrees, not over a
    tenth of a sensor's rows are outliers, and markers are within 5 mm or 5.5 of their stated
    standard deviations. Points that are computed from the joints do not fit. Nothing is raised
    for too few data: such a table does not fit.

    Parameters
    ----------
    session
        Session of the table as it stands.
    rows
        Rows of the table, for the names of the columns.
    progress
        Called with the step and the fraction done.
    never_mastered
        Whether zero-offsets up to 45 degrees are accepted, too.
    """
    # The marker is left free: one that is firm at a wrong place would bend the fit.
    part = replace(session, marker_std_m=UNKNOWN_MARKER_STD_M)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    if too_few := _too_few(session, len(chain)):
        return Sense(False, too_few)
    progress('trying', 0.1)
    try:
        as_given = fit_arrangement(part, Arrangement.given(len(chain)))
        off = find_rows_off(part, MOST_ROWS)
    except InsufficientDataError as error:
        return Sense(False, f'too little to try it against the robot: {error}')
    error_text = shown_mm(as_given.error_m)
    if not session.on_tool and _is_computed_from_joints(part, chain):
        return Sense(
            False,
            'the points are where the robot itself believes its tool to be, none that was '
            'measured; name the columns of the measured point with --points',
            error_m=as_given.error_m,
        )
    outlying = _outlying_rows(session, off, rows)
    too_many = off.too_many and bool(outlying)
    allowed = max(DISPLACED * session.marker_std_m, MARKER_SHIFT_M)
    if not as_given.gross and not too_many and as_given.marker_shift_m < allowed:
        return Sense(
            True,
            f'the robot fits to {error_text} (median), with zero-offsets of up to '
            f'{_largest_offsets_text(as_given.joint_offsets, chain)}',
            error_m=as_given.error_m,
            rows_off=outlying,
            warning=_outlier_warning(outlying, rows),
        )
    if as_given.gross and len(part.measurements) < FEWEST_ROWS:
        return Sense(
            False,
            f'the data fit to {error_text} only, and {len(part.measurements)} rows are too few to '
            f'look for the reason (from {FEWEST_ROWS} on); check units, signs and order of the '
            'joints, and the URDF',
            error_m=as_given.error_m,
        )
    progress('trying', 0.3)
    if (
        as_given.gross
        and len(part.markers) > 1
        and (by_marker := _single_markers_fit(part, rows, error_text))
    ):
        return replace(by_marker, error_m=as_given.error_m)
    mistakes = find_mistakes(session)
    if mistakes.fitting:
        sentence, options = sentence_of_mistakes(mistakes, session, columns_of(rows, chain))
        return Sense(False, sentence, options, as_given.error_m)
    # Of an arm that fits, its zeros apart.
    largest = np.abs(as_given.joint_offsets / as_given.per_radian).max()
    unmastered = as_given.worst_error_m <= UNCALIBRATED_ERROR_M and largest < _LARGEST_UNMASTERED
    if as_given.gross and unmastered and not too_many and as_given.marker_shift_m < allowed:
        found = _unmastered(as_given, error_text, chain, never_mastered)
        return replace(found, rows_off=outlying, warning=_outlier_warning(outlying, rows))
    if too_many and as_given.error_m <= UNCALIBRATED_ERROR_M:
        return _too_many_outliers(as_given, outlying, rows)
    if not as_given.gross:
        return Sense(
            False,
            f'the marker is {1e3 * as_given.marker_shift_m:.1f} mm from where it was said to be '
            f'behind {session.tip_link}; measure its place (--marker-mm), or say how well it is '
            'known (--marker-std-mm)',
            error_m=as_given.error_m,
        )
    measured = session.measurements.orientation is not None and not session.on_tool
    return _nothing_found(as_given, error_text, chain, measured)


def _is_computed_from_joints(session: Session, chain: SerialChain) -> bool:
    """Whether the points of all markers are computed from the joints by the nominal arm.

    So if the median distance of each marker's points from a fixed point of the nominal tool,
    in the base frame, is up to 20 µm (`COMPUTED_M`): no sensor is so exact, or knows the base
    frame so well.
    """
    m = session.measurements
    for marker in range(len(session.markers)):
        rows = m.marker == marker
        T = chain.forward(m.q[rows])
        # The place in the tool that explains the points best, with the base as their frame.
        local = np.einsum('nji,nj->ni', T[:, :3, :3], m.position[rows] - T[:, :3, 3])
        if np.median(np.linalg.norm(local - np.median(local, axis=0), axis=1)) > COMPUTED_M:
            return False
    return True


def _largest_offsets_text(offsets: FloatArray, chain: SerialChain) -> str:
    """Largest angle and, for prismatic joints, largest length of offsets (k,), as text."""
    sizes, slides = np.abs(offsets), chain.slides
    parts = []
    if not slides.all():
        parts.append(f'{np.degrees(sizes[~slides].max()):.2f} degrees')
    if slides.any():
        parts.append(f'{1e3 * sizes[slides].max():.1f} mm')
    return ' and '.join(parts)


def _too_few(session: Session, joints: int) -> str:
    """Sentence that the configurations are fewer than the unknowns need; '' if they are enough.

    Unknowns: zero-offsets of all but the outer two of the `joints`, 6 of each sensor, 3 of each
    marker. Held-out rows do not count, nor do configurations within 1 mrad of another.
    """
    m = session.measurements.select(~session.measurements.is_validation)
    sensors, markers = len(np.unique(m.sensor)), len(np.unique(m.marker))
    # A configuration that is measured again tells of the noise alone.
    seen = np.column_stack((np.round(m.q / SAME_JOINTS_RAD), m.sensor, m.marker))
    count = len(np.unique(seen[:, :joints], axis=0))
    numbers = 3 * len(np.unique(seen, axis=0))
    # The outer joints' offsets are those of registration and marker. One number has to be left
    # over, or any data would fit.
    unknowns = max(joints - 2, 0) + 6 * sensors + 3 * markers
    if numbers > unknowns and count >= estimate.FEWEST_ROWS:
        return ''
    each = 3 * len(np.unique(seen[:, joints:], axis=0))
    needed = max(unknowns // each + 1, estimate.FEWEST_ROWS)
    return (
        f'{counted(count, "different configuration")} to fit {"is" if count == 1 else "are"} too '
        f'few: a fit of this arm has {unknowns} '
        f'unknowns ({max(joints - 2, 0)} zero-offsets, 6 of each sensor, 3 of each marker), and '
        f'each configuration gives {each} numbers, so it takes at least {needed}, and some forty '
        'for a good result; measure more (of a stream only standstills of half a second and '
        'more count)'
    )


def _single_markers_fit(session: Session, rows: RawRows, error_text: str) -> Sense | None:
    """Finding that some markers fit when each is fitted alone, though not all together.

    None if no marker fits alone. In the result `fits` is False, and `options` is the --points
    with the columns of the first marker that fits ('' if unknown). `error_text`: error of the
    fit of all markers, for the sentence.
    """
    m = session.measurements
    fitting: dict[str, float] = {}
    for i, name in enumerate(session.markers):
        with contextlib.suppress(InsufficientDataError):
            fitted = fit_arrangement(
                session.select(m.marker == i), Arrangement.given(m.q.shape[1])
            )
            if not fitted.gross:
                fitting[name] = fitted.error_m
    if not fitting:
        return None
    other_markers = [name for name in session.markers if name not in fitting]
    fitting_names = ', '.join(fitting)
    if other_markers:
        why = f'without {", ".join(other_markers)}; is that on the tool?'
    else:
        why = 'each alone; were they computed from one another? Points of one body turn with it'
    name = next(iter(fitting))
    points = rows.points.get(name, ())
    return Sense(
        False,
        f'all markers together fit to {error_text} only, {fitting_names} to '
        f'{shown_mm(max(fitting.values()))} {why}',
        f'--points {",".join(points)}' if points else '',
    )


def _outlying_rows(session: Session, off: RowsOff, rows: RawRows) -> tuple[tuple[str, float], ...]:
    """Rows of the table that do not fit: file and line, and distance, m, the farthest first.

    Those that `off` marks as gross errors of the fit (`off.off`) and that are over 10 mm
    (`BENT_M`) from it. `rows`: all rows of the table, for file and line.
    """
    found = np.flatnonzero(off.off & (off.error_m > BENT_M))
    order = found[np.argsort(-off.error_m[found], kind='stable')]
    # Rows were left out where points were moved to other joints.
    line = session.measurements.observation
    return tuple((rows.source[line[row]], float(off.error_m[row])) for row in order)


def _outlier_warning(outlying: Sequence[tuple[str, float]], rows: RawRows) -> str:
    """Warning about rows that do not fit, with the remedy; '' if `outlying` is empty.

    `outlying`: file and line, and distance, m, of each; `rows`: all rows, for their number.
    """
    return (
        f'{_outliers_text(outlying, rows)}; correct these rows or remove them' if outlying else ''
    )


def _outliers_text(outlying: Sequence[tuple[str, float]], rows: RawRows) -> str:
    """Number of rows that do not fit, their distances, and the first five of them, as text.

    `outlying`: file and line, and distance, m, of each, at least one.
    """
    shown = [
        f'{where.rpartition("/")[2]} ({shown_mm(error)})' for where, error in outlying[:SHOWN_ROWS]
    ]
    more = f' and {len(outlying) - SHOWN_ROWS} more' if len(outlying) > SHOWN_ROWS else ''
    errors = [error for _, error in outlying]
    least, far = shown_mm(min(errors)), shown_mm(max(errors))
    far = far if least == far else f'{least} to {far}'
    verb = 'does' if len(outlying) == 1 else 'do'
    return (
        f'{len(outlying)} of {len(rows.source)} rows {verb} not fit, {far} off: '
        f'{", ".join(shown)}{more}'
    )


def _too_many_outliers(
    given: Fitted, outlying: tuple[tuple[str, float], ...], rows: RawRows
) -> Sense:
    """Finding, for a table that does not fit, that more rows are off than a fit leaves out.

    `given`: fit of the table as it is; `outlying`: rows that are off, with distances, m.
    """
    return Sense(
        False,
        f'half of the rows fit to {shown_mm(given.error_m)}, but '
        f'{_outliers_text(outlying, rows)}; that '
        'is more than a fit leaves out: check whether each point stands beside its own joints, '
        'whether one marker was measured throughout and stayed in its place, and correct these '
        'rows or remove them',
        error_m=given.error_m,
        rows_off=outlying,
    )


def _unmastered(given: Fitted, error_text: str, chain: SerialChain, never_mastered: bool) -> Sense:
    """Finding that zero-offsets are larger than those of a mastered robot, with the remedy.

    Joints off by over 5 degrees (`LARGEST_OFFSET`) are named. The table counts as fitting only
    if `never_mastered`. `given`: fit of the table as it is; `error_text`: its error, for the
    sentence.
    """
    far = np.flatnonzero(np.abs(given.joint_offsets) > LARGEST_OFFSET * given.per_radian)
    listed = ' and '.join(
        f'{chain.joint_names[i]} off by {chain.shown_offset(i, given.joint_offsets[i], 1)}'
        for i in far.tolist()
    )
    several = len(far) > 1
    found = (
        f'the data fit to {error_text} with the zero{"s" * several} of {listed}, more than a '
        'mastered robot has'
    )
    if never_mastered:
        return Sense(True, f'{found}, as was said', error_m=given.error_m)
    these = 'these joints' if several else 'this joint'
    return Sense(
        False,
        f'{found}: master {these} and measure again; if the arm was never mastered (hobby servos, '
        f'a motor that was replaced), the data are right as they are and {these} '
        f'{"are" if several else "is"} corrected by so much; if it was, is the URDF that of this '
        'arm?',
        NEVER_MASTERED,
        given.error_m,
    )


def _nothing_found(given: Fitted, error_text: str, chain: SerialChain, oriented: bool) -> Sense:
    """Finding that the table does not fit and no known mistake explains it.

    `given`: fit of the table as it is; `error_text`: its error, for the sentence; `oriented`:
    whether a sensor off the tool measured orientations, which adds advice on --on-tool.
    """
    equal = np.abs(given.joint_offsets) / given.per_radian
    worst = int(np.argmax(equal))
    if chain.slides.any():
        off = f', joint {worst + 1} by {chain.shown_offset(worst, given.joint_offsets[worst], 1)}'
        return Sense(
            False,
            f'the data fit to {error_text} only, with zero-offsets{off}; check units, signs and '
            'order of the joints (where a joint slides other mistakes are not looked for), that '
            'the URDF is that of this arm, and that each point stands beside its own joints',
            error_m=given.error_m,
        )
    return Sense(
        False,
        f'the data fit to {error_text} only, and it is none of these, which were tried: {TRIED}; '
        'check that the URDF is that of this arm, that each point stands beside its own joints, '
        'and that one marker was measured throughout'
        f'{ON_TOOL if oriented else ""}',
        error_m=given.error_m,
    )


def columns_of(rows: RawRows, chain: SerialChain) -> Columns:
    """Names of the columns of joints and points, and their units, for sentences on mistakes.

    Points are those of the first marker, or X, Y and Z.
    """
    joints = tuple(split_unit(column)[0] for column in rows.joint_columns)
    return Columns(
        joints=joints,
        # A column without a name is called as the robot's joint.
        shown=tuple(
            joint_name if name.isdigit() else name
            for name, joint_name in zip(joints, chain.joint_names)
        ),
        points=next(iter(rows.points.values()), ('X', 'Y', 'Z')),
        length_unit=rows.length_unit,
        angle_unit=rows.angle_unit or 'rad',
    )
