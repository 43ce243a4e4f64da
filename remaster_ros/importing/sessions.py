# SPDX-License-Identifier: Apache-2.0
"""Correction of a mistake in a session that was written already, by the options of import."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from remaster_ros.calibration.arrangement import Arrangement, arranged
from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import all_rows
from remaster_ros.types import Controller, PadJoint, Session

QUARTER_DEG = 90.0


@dataclass(frozen=True)
class Stretch:
    """A change of the observations from number `since` to before `until`; None: no such bound.

    `what`: the change as text: a number of rows, or the names of two markers.
    """

    what: str
    since: int | None = None
    until: int | None = None


def arrangement_of(
    session: Session,
    joint_names: Sequence[str],
    *,
    order: Sequence[str] = (),
    couple: Sequence[tuple[str, tuple[str, float]]] = (),
    reverse: Sequence[str] = (),
    add_deg: Sequence[tuple[str, float]] = (),
    angle_scale: float = 1.0,
    length_scale: float = 1.0,
    mirrored: bool = False,
    shift: Stretch | None = None,
    exchange: Stretch | None = None,
    turn: tuple[str, float] = ('', 0.0),
    tip_link: str = '',
) -> Arrangement:
    """Arrangement of a session's joint columns and points by the user's corrections.

    Parameters
    ----------
    order
        Joint whose column each joint, base to tip, takes; () for no change.
    couple, reverse, add_deg
        Corrections of joints as in `assemble.SessionOptions`; only joint 3 can be coupled, to
        joint 2, and angles are multiples of 90 degrees.
    angle_scale, length_scale
        Factors of the angles and of the points.
    mirrored
        Whether X and Y of the points are exchanged.
    shift, exchange
        Rows by which each point is moved on ('1' or '-1'), and two markers whose labels are
        exchanged ('a,b'); one of the two at a time.
    turn
        Axis, and degrees by which the markers are turned about it; '' for no turn.
    tip_link
        Tool frame; '' for no change.

    Raises
    ------
    InputError
        Names or observations that the session does not have, angles that are no multiple of 90
        degrees, or corrections that exclude each other.
    """
    k = len(joint_names)
    if order and len(order) != k:
        raise InputError(f'--joints names {len(order)} joints; the session has {k}')
    for stretch in (shift, exchange):
        for number in () if stretch is None else (stretch.since, stretch.until):
            if number is not None and number not in all_rows(session).observation:
                raise InputError(f'there is no observation {number} in the session; correct it')
    if shift is not None and exchange is not None:
        raise InputError('--shift-points and --exchange-markers: give one at a time')
    signs, quarters, coupled = [1] * k, [0] * k, 0
    for name in reverse:
        signs[_index(name, joint_names, '--reverse')] *= -1
    for name, angle in add_deg:
        quarters[_index(name, joint_names, '--offset')] += _quarters(angle, '--offset')
    for name, (other, sign) in couple:
        if (
            _index(name, joint_names, '--couple') != 2
            or _index(other, joint_names, '--couple') != 1
        ):
            raise InputError('--couple: in a session only joint 3 is coupled, to joint 2')
        coupled = int(sign)
    stretch = shift or exchange or Stretch('')
    axis, angle = turn
    return Arrangement(
        order=tuple(_index(name, joint_names, '--joints') for name in order) or tuple(range(k)),
        signs=tuple(signs),
        quarters=tuple(quarters),
        angle_scale=angle_scale,
        coupled=coupled,
        mirrored=mirrored,
        length_scale=length_scale,
        shift=0 if shift is None else -_row_shift(shift.what),
        exchanged=() if exchange is None else _marker_pair(exchange.what, session),
        since=stretch.since,
        until=stretch.until,
        turned=('xyz'.index(axis) if axis else 0, _quarters(angle, '--turn-tool')),
        tip_link=tip_link,
    )


def corrected_session(session: Session, arrangement: Arrangement) -> Session:
    """Session with a correction applied to all its rows, reference visits included.

    The session itself if the arrangement changes nothing. Raises InputError if joint 3 is to
    be coupled to joint 2, and the session's controller couples one of them already, or counts
    joint 2 from another zero than the URDF.
    """
    if arrangement == Arrangement.given(len(arrangement.order)):
        return session
    arranged_session = arranged(replace(session, measurements=all_rows(session)), arrangement)
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    arranged_session = replace(
        arranged_session, controller=_controller(session, arrangement, chain.joint_names)
    )
    m = arranged_session.measurements
    if m.is_reference is None:
        return arranged_session
    rows = replace(m, is_reference=None)
    return replace(
        arranged_session,
        measurements=rows.select(~m.is_reference),
        references=rows.select(m.is_reference),
    )


def _controller(
    session: Session, arrangement: Arrangement, joint_names: Sequence[str]
) -> Controller | None:
    """Unit, sign, zero and coupling by which the controller counts each joint, after a correction.

    The session's own controller (or None) if the arrangement leaves the joints as they are.
    Raises InputError if the arrangement couples joint 3 to joint 2, and one of them is coupled
    already, or the controller counts joint 2 from another zero than the URDF.
    """
    plain = Arrangement.given(len(joint_names))
    of_joints = (arrangement.order, arrangement.signs, arrangement.quarters, arrangement.coupled)
    if of_joints == (plain.order, plain.signs, plain.quarters, plain.coupled):
        return session.controller
    known = {} if session.controller is None else session.controller.joints
    now = {joint_names[column]: joint for joint, column in zip(joint_names, arrangement.order)}
    pads = {}
    for i, (joint, column) in enumerate(zip(joint_names, arrangement.order, strict=True)):
        pad = known.get(joint_names[column], PadJoint(joint_names[column]))
        coupling = {now[other]: share for other, share in pad.coupling.items()}
        sign: Literal[1, -1] = 1
        if arrangement.signs[i] < 0:
            sign = -1
        pads[joint] = replace(
            pad,
            sign=cast(Literal[1, -1], sign * pad.sign),
            zero_deg=sign * pad.zero_deg + QUARTER_DEG * arrangement.quarters[i],
            coupling=coupling,
        )
    if arrangement.coupled:
        second, third = (joint_names[arrangement.order[i]] for i in (1, 2))
        other = known.get(second, PadJoint(second))
        pad_of_third = known.get(third, PadJoint(third))
        if pad_of_third.coupling or other.coupling or other.zero_deg:
            raise InputError('--couple: the joints of this session are coupled or moved already')
        share = cast(Literal[1, -1], arrangement.coupled * pad_of_third.sign * other.sign)
        pads[joint_names[2]] = replace(pads[joint_names[2]], coupling={joint_names[1]: share})
    return Controller(pads, '' if session.controller is None else session.controller.maker)


def _row_shift(text: str) -> int:
    """Number of rows to shift by, 1 or -1. Raises InputError for other text."""
    try:
        rows = int(text)
    except ValueError:
        rows = 0
    if abs(rows) != 1:
        raise InputError(
            f'--shift-points: {text!r} is neither 1 nor -1; points are moved by a row'
        )
    return rows


def _marker_pair(text: str, session: Session) -> tuple[int, ...]:
    """Indices, from 0, of two markers of a text such as ``sir,smr``.

    Raises InputError for another number of names or an unknown one.
    """
    names = text.split(',')
    if len(names) != 2:
        raise InputError(f'--exchange-markers: {text!r} is not two markers, such as sir,smr')
    return tuple(_index(name, session.marker_names, '--exchange-markers') for name in names)


def _index(name: str, names: Sequence[str], option: str) -> int:
    """Index of a name in `names`, from 0. Raises InputError, with `option`, if it is absent."""
    if name not in names:
        raise InputError(
            f'{option}: there is no {name!r}; there are {", ".join(names)}'
            f'{did_you_mean(name, names)}'
        )
    return names.index(name)


def _quarters(angle: float, option: str) -> int:
    """Number of quarter turns in an angle, degrees, with sign.

    Raises InputError, with the option, if the angle is no multiple of 90.
    """
    quarters = angle / QUARTER_DEG
    if not np.isclose(quarters, round(quarters)):
        raise InputError(
            f'{option}: {angle:g} degrees are no multiple of 90; what is less is found by the fit'
        )
    return round(quarters)
