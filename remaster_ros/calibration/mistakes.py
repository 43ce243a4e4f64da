# SPDX-License-Identifier: Apache-2.0
"""Mistakes in a session that does not fit its robot: each is corrected by trial and fitted.

Reversed joints, columns in another order, zero positions 90 degrees off, units, mirrored points
and points next to the joints of another row are tried in `arrangement`. Here are tried the
mistakes that begin at a row, found by two fits without that row, and those of the tool: another
tip link, a turned tool frame, a wrong marker position. A mistake is named only if the session
without it is estimated like any other session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations, product
from shlex import quote

import numpy as np

from remaster_ros.calibration.arrangement import (
    ALIKE,
    CONVINCING,
    FEWEST_ROWS,
    Arrangement,
    Fitted,
    arranged,
    closest,
    closest_fit,
    exchanged,
    fit_arrangement,
    joint_rows_of_points,
    search,
    some_rows,
)
from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import CAUCHY_WIDTH, robust_spread
from remaster_ros.calibration.priors import DISPLACED, LARGEST_OFFSET, UNCALIBRATED_ERROR_M
from remaster_ros.errors import (
    InputError,
    InsufficientDataError,
    MisfitError,
    MistakeFoundError,
    RemasterError,
)
from remaster_ros.kinematics.arm_ends import likely_tips
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import FloatArray, Measurements, Priors, Session

# Standard deviation of an unknown marker position, as the session format advises.
UNKNOWN_MARKER_STD_M = 0.3
# Smallest distance between the fitted and the stated position of a marker on another link, m.
MARKER_SHIFT_M = UNCALIBRATED_ERROR_M
# Units of tables, in m and in rad.
LENGTHS: Mapping[str, float] = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254}
ANGLES: Mapping[str, float] = {'rad': 1.0, 'deg': np.pi / 180.0, 'gon': np.pi / 200.0}
TRIED = (
    'joints reversed or in another order, zero positions by 90 degrees, units, joint 3 coupled to '
    'joint 2, mirrored points, points beside the joints of a row before or behind it, labels of '
    'markers exchanged (also from a row on), a turned tool, another tip link'
)


@dataclass(frozen=True, eq=False)
class Mistakes:
    """Fit of a session as it is, and fits with a likely mistake in its tables corrected."""

    given: Fitted  # The fit of the session as it is, with unknown marker positions
    # Fits without a mistake, the simplest first; several if the data cannot tell them apart
    fitting: tuple[Fitted, ...]


def find_mistakes(session: Session) -> Mistakes:
    """Robust fit of a session as it is, and the fits with a mistake corrected that fit the robot.

    Each likely mistake is corrected by trial and fitted. None is tried (``fitting`` is ())
    with fewer than 12 rows (`FEWEST_ROWS`) or a joint that slides. ``session``: does not fit
    its robot, or fits with gross offsets or errors. Raises InsufficientDataError if there are
    too few rows for a fit.
    """
    joints = session.measurements.q.shape[1]
    # A marker that is firm at a wrong place would bend the fit.
    part = replace(session, marker_std_m=max(session.marker_std_m, UNKNOWN_MARKER_STD_M))
    given = fit_arrangement(part, Arrangement.given(joints))
    # Nearly all that is tried is of angles.
    slides = not np.all(given.per_radian == 1.0)
    if len(session.measurements) < FEWEST_ROWS or slides:
        return Mistakes(given, ())
    found = [] if given.gross else _tool_mistakes(session, given)
    if not found:
        lengths = {a / b for a, b in product(LENGTHS.values(), repeat=2) if a != b}
        found = search(part, given, sorted(lengths))
        for arrangement in () if found else _mistakes_from_row(part):
            try:
                fit = fit_arrangement(part, arrangement)
            except RemasterError:
                continue
            if not fit.gross and fit.worst_error_m * CONVINCING < given.worst_error_m:
                found.append(fit)
    return Mistakes(given, tuple(fit for fit in closest(found) if _is_sound(session, fit)))


def _is_sound(session: Session, fit: Fitted) -> bool:
    """Whether the rearranged session can be estimated without gross offsets or errors.

    By up to 200 rows; False if the estimation fails.
    """
    try:
        found = estimate(Problem.of(some_rows(arranged(session, fit.arrangement))))
    except (RemasterError, np.linalg.LinAlgError):
        return False
    return not is_gross(found)


def is_gross(found: Estimate) -> bool:
    """Whether an estimate has larger offsets or errors than a mastered robot can have.

    An offset above 5 degrees (`LARGEST_OFFSET`, times ``per_radian`` for a slide), or a sensor's
    sigma above 5 mm (`UNCALIBRATED_ERROR_M`).
    """
    offsets = found.mode.z[: found.model.joints]
    sigma = found.posterior.noise(found.mode.eta).sigma
    limit = LARGEST_OFFSET * found.model.chain.per_radian
    return bool(np.any(np.abs(offsets) > limit) or np.any(sigma > UNCALIBRATED_ERROR_M))


@one_thread
def sound_estimate(
    session: Session,
    priors: Priors | None = None,
    fitted: Callable[[Problem], Estimate] = estimate,
) -> Estimate:
    """Estimate of a session that fits its robot; else an error, with the mistake if one is found.

    A gross estimate (`is_gross`) is returned all the same if no mistake explains it.
    ``fitted``: function that estimates. Raises MistakeFoundError if the session does not fit
    the robot, or is gross, and fits with a mistake corrected; MisfitError if it does not fit
    and none of the tried mistakes explains it; and InsufficientDataError and InputError as
    ``fitted``.
    """
    try:
        found = fitted(Problem.of(session, priors))
    except MisfitError as error:
        refused = error
    else:
        if not is_gross(found):
            return found
        mistakes = find_mistakes(session)
        if mistakes.fitting:
            raise _mistake_found(session, mistakes, 'the session does not fit the robot')
        return found
    try:
        mistakes = find_mistakes(session)
    except InsufficientDataError:
        raise refused from None
    if not mistakes.fitting:
        few = len(session.measurements) < FEWEST_ROWS
        slides = not np.all(mistakes.given.per_radian == 1.0)
        why = (
            'mistakes are not looked for where a joint slides'
            if slides
            else f'{len(session.measurements)} rows are too few to look for the reason'
            if few
            else f'tried, and it is none of these: {TRIED}'
        )
        raise MisfitError(refused.what, f'{refused.remedy}; {why}')
    raise _mistake_found(session, mistakes, refused.what)


def _mistake_found(session: Session, mistakes: Mistakes, what: str) -> MistakeFoundError:
    """Error that names the mistakes, with the import's options that correct the first.

    ``mistakes``: with at least one fit; ``what``: beginning of its sentence.
    """
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    columns = Columns(chain.joint_names, chain.joint_names)
    sentence, options = sentence_of_mistakes(mistakes, session, columns)
    return MistakeFoundError(f'{what}; {sentence}', options)


def _tool_mistakes(session: Session, given: Fitted) -> list[Fitted]:
    """Fits of tip links, tool turns and exchanged labels with markers at their stated positions.

    A marker is at its stated position if the fit is within 5.5 of its stated standard
    deviations, or within 5 mm, of it. [] if all markers of ``given`` are already, or if
    nothing tried brings them there.
    """
    allowed = max(DISPLACED * session.marker_std_m, MARKER_SHIFT_M)
    if given.marker_shift_m < allowed:
        return []
    plain = given.arrangement
    candidates = [
        replace(plain, tip_link=tip)
        for tip in likely_tips(parse_urdf(session.urdf), session.base_link)
        if tip != session.tip_link
    ]
    candidates += [
        replace(plain, turned=(axis, quarters)) for axis in range(3) for quarters in (1, -1, 2)
    ]
    candidates += [replace(plain, exchanged=pair) for pair in _pairs(session.measurements)]
    part = replace(session, marker_std_m=max(session.marker_std_m, UNKNOWN_MARKER_STD_M))
    found = []
    for arrangement in candidates:
        try:
            fit = fit_arrangement(part, arrangement)
        except (InputError, InsufficientDataError):
            continue
        if fit.marker_shift_m < allowed:
            found.append(fit)
    return found


def _pairs(m: Measurements) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of markers (indices) that one sensor has measured, sorted."""
    pairs: set[tuple[int, int]] = set()
    for sensor in np.unique(m.sensor):
        pairs |= set(combinations(np.unique(m.marker[m.sensor == sensor]).tolist(), 2))
    return sorted(pairs)


def _mistakes_from_row(session: Session) -> Iterator[Arrangement]:
    """Yield arrangements with a mistake from a row on, or up to a row, at the row that fits best.

    Mistakes are labels of two markers exchanged from or until a row, and points shifted by one
    row from a row on. The first half of the rows is fitted as if before the change, and the
    last half as if after it; each fit gives one row at most (`_divisions`).
    """
    m = session.measurements
    plain, everywhere = Arrangement.given(m.q.shape[1]), np.ones(len(m), bool)
    numbers = m.observation.tolist()
    for pair in _pairs(m):
        other = exchanged(m, *pair, everywhere)
        for row in _divisions(session, m, other):
            yield replace(plain, exchanged=pair, since=numbers[row])
        for row in _divisions(session, other, m):
            yield replace(plain, exchanged=pair, until=numbers[row])
    for shift in (-1, 1):
        of, _ = joint_rows_of_points(m, shift, everywhere)
        for row in _divisions(session, m, replace(m, q=m.q[of])):
            yield replace(plain, shift=shift, since=numbers[row])


def _divisions(session: Session, before: Measurements, after: Measurements) -> Iterator[int]:
    """Yield rows (index from 0) at which a change from the first table to the second fits best.

    At most two rows: by the fit of the first half of ``before``, and by that of the last half
    of ``after``; the same row may come twice. None with fewer than 12 rows (`FEWEST_ROWS`) in
    a half, from a fit that fails, or if one table alone fits best.
    """
    half = len(before) // 2
    if half < FEWEST_ROWS:
        return
    for table, rows in ((before, slice(0, half)), (after, slice(half, len(before)))):
        costs = _costs(session, table.select(np.arange(len(before))[rows]), before, after)
        if costs is not None:
            least = int(np.argmin(np.concatenate(([0.0], np.cumsum(costs[0] - costs[1])))))
            if 0 < least < len(before):
                yield least


def _costs(
    session: Session, part: Measurements, before: Measurements, after: Measurements
) -> tuple[FloatArray, FloatArray] | None:
    """Robust cost of every row of two tables, (n,) each, by a fit of a part; None if it fails.

    Also None if a table has other sensors or markers than the part. The cost is log(1 + d² / w²)
    of the distance d, w being 2.5 (`CAUCHY_WIDTH`) times the sensor's robust spread.
    """

    def problem(m: Measurements) -> Problem:
        fitted = replace(m, is_validation=np.zeros(len(m), bool))
        return Problem.of(replace(session, measurements=fitted))

    try:
        fitted = problem(some_rows(replace(session, measurements=part)).measurements)
        start, z, rows = closest_fit(fitted)
    except (InsufficientDataError, np.linalg.LinAlgError):
        return None
    spread = robust_spread(rows.target - start.predict(z, rows), rows)
    costs = []
    for table in (before, after):
        table_problem = problem(table)
        if (table_problem.sensor_names, table_problem.marker_names) != (
            fitted.sensor_names,
            fitted.marker_names,
        ):
            return None
        rows = Rows.of(table_problem.measurements, table_problem.fitted, start.reference)
        squares = np.sum((rows.target - start.predict(z, rows)) ** 2, axis=1)
        width = CAUCHY_WIDTH * spread[table_problem.measurements.sensor[rows.source]]
        cost = np.empty(len(rows))
        cost[rows.source] = np.log1p(squares / width**2)
        costs.append(cost)
    return costs[0], costs[1]


@dataclass(frozen=True)
class Columns:
    """Names and units of a table's columns."""

    # Columns of joints, and their names in a sentence
    joints: tuple[str, ...]
    shown: tuple[str, ...]
    points: tuple[str, ...] = ('x_m', 'y_m', 'z_m')  # Columns of x, y and z
    # Units in which the numbers were read
    length_unit: str = 'm'
    angle_unit: str = 'rad'


def sentence_of_mistakes(
    mistakes: Mistakes, session: Session, columns: Columns
) -> tuple[str, str]:
    """Sentence with the mistakes, and the options of ``remaster import`` that correct the first.

    The sentence also names other arrangements that fit as well, with their options, if these
    have at most one change more than the first. ``mistakes``: with at least one fit.
    """
    found, given = mistakes.fitting[0], mistakes.given
    words, options = in_words(found.arrangement, session, columns)
    sentence = f'with {words} the data fit to {shown_mm(found.error_m)}; without, to '
    # Where only a part of the rows is off, the median does not show it.
    sentence += shown_mm(
        given.error_m if given.error_m > UNCALIBRATED_ERROR_M else given.worst_error_m
    )
    if given.worst_error_m < ALIKE * found.worst_error_m:
        largest, least = (
            np.degrees(np.abs(np.angle(np.exp(1j * fit.joint_offsets))).max())
            for fit in (given, found)
        )
        sentence = (
            f'with {words} the zero-offsets are below {max(1.0, least):.1f} degrees; without, one '
            f'is {largest:.0f} degrees'
        )
        if found.marker_shift_m + MARKER_SHIFT_M < given.marker_shift_m:
            sentence = (
                f'with {words} the marker is {shown_mm(found.marker_shift_m)} from where it was '
                f'said to be; without, {shown_mm(given.marker_shift_m)}'
            )
    options_by_words = {words: options}
    for fit in mistakes.fitting[1:]:
        if fit.arrangement.changes <= found.arrangement.changes + 1:
            other, instead = in_words(fit.arrangement, session, columns)
            options_by_words.setdefault(other, instead)
    alternatives = [
        f'with {other} ({instead})' for other, instead in list(options_by_words.items())[1:]
    ]
    if alternatives:
        sentence += (
            f'; {" or ".join(alternatives)} they fit as well, and the data cannot tell which'
        )
    return sentence, options


def in_words(found: Arrangement, session: Session, columns: Columns) -> tuple[str, str]:
    """Changes of an arrangement in words, and the options of ``remaster import`` for them.

    Both are '' without a change. ``columns``: names and units of the table's columns.
    """
    names = [columns.shown[column] for column in found.order]
    words, options = [], []
    given = Arrangement.given(len(names))
    if found.order != given.order:
        words.append(f'the joints in the order {", ".join(names)}')
        options.append(f'--joints {quote(",".join(columns.joints[c] for c in found.order))}')
    for what, scale, unit, units in (
        ('angles', found.angle_scale, columns.angle_unit, ANGLES),
        ('length', found.length_scale, columns.length_unit, LENGTHS),
    ):
        if scale != 1.0:
            size = scale * units[unit]
            other = min(units, key=lambda name: abs(np.log(units[name] / size)))
            of = 'angles' if what == 'angles' else 'points'
            if np.isclose(units[other], size):
                words.append(f'the {of} in {other}')
                options.append(f'--{what} {other}')
            else:
                words.append(f'the {of} times {scale:.6g} (they were converted twice)')
                options.append(f'--multiply-{of} {scale!r}')
    if found.coupled:
        sign = '' if found.coupled > 0 else '-'
        words.append(
            f'{sign or "+"}{names[1]} added to {names[2]} (it counts from the horizontal)'
        )
        options.append(f'--couple {quote(f"{names[2]}={sign}{names[1]}")}')
    reversed_ = [names[i] for i, sign in enumerate(found.signs) if sign < 0]
    if reversed_:
        words.append(f'{" and ".join(reversed_)} reversed')
        options.append(f'--reverse {quote(",".join(reversed_))}')
    for i, quarter in enumerate(found.quarters):
        if quarter:
            words.append(f'{90 * quarter:+d} degrees on {names[i]}')
            options.append(f'--offset {quote(f"{names[i]}={90 * quarter}")}')
    if found.mirrored:
        x, y, z = columns.points
        words.append('X and Y exchanged (the points are mirrored)')
        options.append(f'--points {quote(f"{y},{x},{z}")}')
    stretch, at = _row_range(found)
    if found.shift:
        where = 'before' if found.shift > 0 else 'behind'
        words.append(f'each point{stretch} moved to the joints of the row {where} it')
        options.append(f'--shift-points={-found.shift}{at}')
    if found.exchanged:
        a, b = (session.marker_names[marker] for marker in found.exchanged)
        words.append(f'the labels {a} and {b} exchanged{stretch}')
        options.append(f'--exchange-markers {quote(f"{a},{b}{at}")}')
    if found.turned[1]:
        axis, angle = 'xyz'[found.turned[0]], 90 * found.turned[1]
        words.append(f"the markers' places turned by {angle} degrees about {axis} of the tool")
        options.append(f'--turn-tool {axis}={angle}')
    if found.tip_link:
        words.append(f'the tip link {found.tip_link}')
        options.append(f'--tip-link {quote(found.tip_link)}')
    return ', '.join(words), ' '.join(options)


def _row_range(found: Arrangement) -> tuple[str, str]:
    """Rows of a mistake in words, and as an option's suffix: '@12-' from, '@-12' before 12.

    Both are '' for all rows.
    """
    if found.since is not None:
        return f' from observation {found.since} on', f'@{found.since}-'
    if found.until is not None:
        return f' before observation {found.until}', f'@-{found.until}'
    return '', ''


def shown_mm(length: float) -> str:
    """Length, m, in mm for a sentence: whole mm from 10 mm on, below that two digits."""
    size = 1e3 * length
    return f'{size:.0f} mm' if size >= 10.0 else f'{size:.2g} mm'
