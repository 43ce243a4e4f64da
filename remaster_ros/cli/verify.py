# SPDX-License-Identifier: Apache-2.0
"""Whether a correction acts exactly once, and what error remains."""

from __future__ import annotations

import argparse
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.cli.console import tell
from remaster_ros.cli.sessions import refuse_moving
from remaster_ros.compensation.file import Compensation, read_compensation
from remaster_ros.compensation.verification import (
    Estimate,
    Verdict,
    VerificationResult,
    Visits,
    verify,
)
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.planning.tour_order import nearest_solution
from remaster_ros.session.records.reader import HEADER, ROWS, read_session
from remaster_ros.types import BoolArray, Correction, FloatArray, IntArray, Session

FORMAT = 'remaster-verify/1'
WORDS: dict[Verdict, str] = {
    'in_use': 'The correction acts, and not twice.',
    'not_in_use': 'The correction does not act: load it, or see why it is not taken.',
    'twice': 'The correction acts twice: take it out of one of the two places (the zeros on the '
    'pad and a layer or model, say).',
    'wrong_sign': 'The correction acts with the wrong sign: undo what you entered, then enter it '
    'with the other sign.',
    'other': 'Something acts that is not this correction as a whole: see the joints.',
    'unclear': 'These rows do not tell.',
}

log = logging.getLogger('remaster_ros')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster verify``."""
    parser.add_argument(
        'session',
        metavar='SESSION',
        type=Path,
        help='session folder: some ten poses that no fit has used, each with the correction on, '
        'or off and on; columns wanted1_rad … and correction',
    )
    parser.add_argument(
        '--compensation',
        metavar='FILE',
        type=Path,
        required=True,
        help='apply/compensation.json of the correction',
    )
    parser.add_argument('--json', action='store_true', help='print what was found as JSON')


def run(args: argparse.Namespace) -> int:
    """Evaluate a session, and print the verdict; return 0, whatever it is.

    Raises InputError: a file is invalid, of another arm, or lacks what was wanted or the state of
    the correction. Warnings are logged.
    """
    session, compensation = read_session(args.session), read_compensation(args.compensation)
    refuse_moving(session, args.session, 'verify')
    require_same_arm(session, compensation, args.session)
    found = verify(compensation.compensator, visits(session, args.session))
    warnings = _warnings(session, compensation)
    for warning in warnings:
        log.warning('%s: %s', args.session, warning)
    tell(args, _content(found, warnings), _text(found))
    return 0


def visits(session: Session, folder: Path) -> Visits:
    """Return all rows of a session as visits, for `verify`; ``folder``: for messages.

    Raises InputError if a row does not tell whether the correction was on, or which joint
    angles were wanted.
    """
    m = session.measurements
    on = _on(session, folder)
    wanted = _wanted(session, folder, on)
    return Visits(
        wanted,
        on,
        _together(m.configuration, wanted, JointUnits.of(_chain(session))),
        tuple(session.sensor_names[i] for i in m.sensor.tolist()),
        tuple(session.marker_names[i] for i in m.marker.tolist()),
        m.position,
    )


def _together(configuration: IntArray, wanted: FloatArray, units: JointUnits) -> IntArray:
    """Return configuration numbers, (n,), in which repeated visits have that of the first one.

    A visit is repeated if it has the same wanted joints as an earlier one
    (`nearest_solution`). ``configuration``: numbers of the rows, (n,); ``wanted``: rad or m,
    (n, k).
    """
    numbers, firsts = configuration.copy(), dict[int, FloatArray]()
    for each in dict.fromkeys(configuration.tolist()):
        mine = configuration == each
        q = wanted[mine][0]
        neighbour = nearest_solution(np.array(list(firsts.values())), q, units) if firsts else None
        same = each if neighbour is None else list(firsts)[neighbour]
        numbers[mine], firsts[same] = same, firsts.get(same, q)
    return numbers


def _chain(session: Session) -> SerialChain:
    """Return the arm of the session, from its URDF, base and tip.

    Raises InputError as `SerialChain.from_urdf`.
    """
    return SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)


def _on(session: Session, folder: Path) -> BoolArray:
    """Return whether the correction was on at each row, (n,).

    Rows of which it is not known count as on if the session states a correction; else
    InputError, with the first of them. ``folder``: of the session, for the error.
    """
    m = session.measurements
    state = np.full(len(m), -1) if m.correction is None else m.correction
    if session.correction is not None:
        state = np.where(state < 0, 1, state)
    for row in np.flatnonzero(state < 0)[:1]:
        raise InputError(
            f'{folder / ROWS}: observation {m.observation[row]} does not tell whether the '
            f'correction was on; fill the column correction with on or off, or give {HEADER} the '
            'key correction: {form: pad}'
        )
    return state == 1


def _wanted(session: Session, folder: Path, on: BoolArray) -> FloatArray:
    """Return the desired joint angles of each row, rad, (n, k): the session's columns ``wanted``.

    In a row without these, the reported angles are taken if the correction was on (``on``,
    (n,)) and is made inside the controller. Raises InputError, with the ``folder``, for the
    first row that has neither.
    """
    m = session.measurements
    wanted = np.full_like(m.q, np.nan) if m.wanted is None else m.wanted.copy()
    missing = np.isnan(wanted[:, 0])
    if session.correction is not None and session.correction.is_inside:
        # The reported angles are the true ones: what was wanted is what is reported.
        missing_on = missing & on
        wanted[missing_on] = m.q[missing_on]
        missing &= ~on
    for row in np.flatnonzero(missing)[:1]:
        raise InputError(
            f'{folder / ROWS}: observation {m.observation[row]} does not tell what was wanted; '
            'fill the columns wanted1_rad … with the joints at which the nominal robot has the '
            'pose, before any correction: what is reported tells nothing where the correction is '
            'made outside of the controller'
        )
    return wanted


def require_same_arm(session: Session, compensation: Compensation, folder: Path) -> None:
    """Raise InputError if a session cannot be judged by a correction: it is of another arm.

    Joints, base and tip link have to be the same by name, and markers among the correction's.
    Also raised for the session that the correction was computed from. ``folder``: for
    messages.
    """
    chain, robot = _chain(session), compensation.content.robot
    for quantity, session_value, correction_value in (
        ('joints', list(chain.joint_names), robot.joint_names),
        ('base link', session.base_link, robot.base_link),
        ('tip link', session.tip_link, robot.tip_link),
    ):
        if session_value != correction_value:
            raise InputError(
                f'{folder}: its {quantity} {_named(session_value)} are not those of '
                f'{compensation.path} ({_named(correction_value)}); give the correction of this '
                'arm'
            )
    for marker in {session.marker_names[i] for i in session.measurements.marker.tolist()}:
        if marker not in compensation.model.markers:
            raise InputError(
                f'{folder}: marker {marker!r} is none of {compensation.path} '
                f'({_named(list(compensation.model.markers))}); rename it, or measure one of these'
            )
    if session.observations_sha256 == compensation.content.source.observations_sha256:
        raise InputError(
            f'{folder}: is the session that the correction was made of; measure ten poses that '
            'were never used'
        )


def _named(names: Any) -> str:
    """Return names as text for a message."""
    return names if isinstance(names, str) else ', '.join(names)


def _warnings(session: Session, compensation: Compensation) -> list[str]:
    """Return warnings on a session that is to be verified, as text; [] if there are none.

    Warned of are: another file than the correction that was on, another accuracy option of the
    maker, no wanted joints, a correction that was measured on top of another one.
    """
    state = compensation.content.state
    stated, before = session.correction, state.get('correction')
    found = []
    if stated is not None and stated.sha256 not in ('', compensation.sha256):
        found.append('the correction that was on is another file than the one given')
    was, option = state.get('accuracy_option', ''), session.accuracy_option
    if was and option and was != option:
        found.append(
            f"the maker's accuracy option is {option}, and was {was} when the correction was "
            'measured, which belongs to that state alone'
        )
    if session.measurements.wanted is None:
        found.append(
            'what was wanted is not recorded, so that a layer or model beside the controller is '
            'not seen'
        )
    if before and not Correction(before.get('form', '')).is_beside:
        found.append(
            f'the correction was measured on top of another one ({before.get("form", "?")}), '
            'which must still be on'
        )
    return found


def _content(found: VerificationResult, warnings: list[str]) -> dict[str, Any]:
    """Return the result of a verification as printed by --json."""
    return {
        'format': FORMAT,
        'verdict': found.verdict,
        'text': _in_words(found),
        'toggle': found.toggle and asdict(found.toggle),
        'absolute': asdict(found.absolute),
        'joints': [{'joint': name, **asdict(estimate)} for name, estimate in found.joints.items()],
        'error_mm': {
            'off': found.error_off and asdict(found.error_off),
            'on': asdict(found.error_on),
        },
        'remains_mm': found.remains_mm,
        'noise_mm': found.noise_mm,
        'poses': found.poses,
        'warnings': warnings,
    }


def _in_words(found: VerificationResult) -> str:
    """Return the verdict of a verification as a sentence.

    If it is 'unclear', followed by the number of poses that would do, or that no number would.
    """
    words = WORDS[found.verdict]
    if found.verdict != 'unclear':
        return words
    if found.poses:
        return f'{words} Some {found.poses} poses would do.'
    return (
        f'{words} No number of poses would do: the correction is about as small as what is not '
        'known of it.'
    )


def _text(found: VerificationResult) -> str:
    """Text that ``remaster verify`` prints: the verdict, then a line for each figure.

    Figures: shares of the correction that act, of all joints and of each; mean errors off and
    on, mm, each if there are such rows; RMS of what remains, mm.
    """
    lines = [f'{found.verdict}: {_in_words(found)}']
    lines.append(f'share that acts, of the rows with it on: {_share(found.absolute)}')
    if found.toggle is not None:
        lines.append(f'share that is switched, of on - off: {_share(found.toggle)}')
    lines += [f'  {name}: {_share(estimate)}' for name, estimate in found.joints.items()]
    for side, error in (('off', found.error_off), ('on', found.error_on)):
        if error is not None:
            low, high = error.interval95_mm
            lines.append(f'mean error {side}: {error.mean_mm:.3f} mm [{low:.3f}, {high:.3f}]')
    noise = '' if found.noise_mm is None else f'; noise of a row {found.noise_mm:.3f} mm'
    return '\n'.join([*lines, f'remains: {found.remains_mm:.3f} mm RMS{noise}'])


def _share(estimate: Estimate) -> str:
    """Return a share with its standard deviation and verdict: '+1.000 ± 0.050 (in_use)'."""
    return f'{estimate.share:+.3f} ± {estimate.std:.3f} ({estimate.verdict})'
