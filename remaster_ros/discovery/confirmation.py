"""Do the causes of one session predict another of the same arm? Only the set-up is refitted.

Zero-offsets and causes stay as found; the other session's registrations and markers are fitted to
its optimization rows, and the error is measured on its validation rows, or on the fitted ones
where it has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate, hold_offsets
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.gain import rms
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.errors import InputError
from remaster_ros.types import BoolArray, FloatArray, Session


@dataclass(frozen=True)
class Confirmation:
    """How causes found in one session do in another.

    Attributes
    ----------
    rms_before_m, rms_after_m
        RMS of the 3-D error in the other session with the frozen offsets alone, and with the
        frozen causes too.
    carried_over
        Share of the gain in mean square that carries over: 1 all, 0 none, negative where the
        causes make it worse.
    effects
        The same share for each cause alone, in the order of the discovery.
    confirmed
        More than half of the gain carries over.
    rms_own_m
        RMS where the other session's own zero-offsets are fitted, with or without the causes,
        whichever is less.
    same_offsets
        Whether the zero-offsets found do nearly as well there as its own. If not, that is another
        arm, or it was mastered anew in between.
    """

    rms_before_m: float
    rms_after_m: float
    carried_over: float
    effects: tuple[float, ...]
    confirmed: bool
    rms_own_m: float
    same_offsets: bool


# Zero-offsets with which a session's error is so many times that with its own are not its own.
OTHER_OFFSETS = 1.5


def confirm(discovery: Discovery, session: Session) -> Confirmation:
    """Apply a discovery, frozen, to another session of the same arm.

    Raises
    ------
    InputError
        Another robot, or other sensors.
    InsufficientDataError
        Data that do not allow a fit.
    """
    require_same_cell(discovery.fit.session, session)
    problem = Problem.of(session)
    found = estimate(problem)
    offsets = discovery.fit.joint_offsets
    before = _left(discovery, found, discovery.offsets_before[0], ())
    after = _left(discovery, found, offsets, discovery.groups)
    cured = _left(discovery, found, offsets, ())
    own = [_left(discovery, found, None, groups) for groups in ((), discovery.groups)]
    rows = problem.measurements.is_validation
    if not rows.any():
        rows = np.isin(np.arange(len(rows)), found.kept)
    base, best = rms(before, rows), rms(after, rows)
    gain = _own_gain(discovery)
    alone = tuple(_alone(discovery, found, group, best, rows) for group in discovery.groups)
    carried = float((base**2 - best**2) / gain) if gain > 0.0 else 0.0
    rms_own = min(rms(left, rows) for left in own)
    same = min(base, best, rms(cured, rows)) < OTHER_OFFSETS * rms_own
    return Confirmation(base, best, carried, alone, same and carried > 0.5, rms_own, same)


def _own_gain(discovery: Discovery) -> float:
    """Return by how much the causes lower the mean square in their own session, m²."""
    data = discovery.residuals
    rows = data.context.measurements.is_validation
    if not rows.any():
        rows = np.isin(np.arange(len(rows)), data.rows.source)
    return (
        rms(data.unexplained(discovery.selection.empty), rows) ** 2
        - rms(data.unexplained(discovery.selection.solution), rows) ** 2
    )


def _alone(
    discovery: Discovery,
    found: Estimate,
    group: tuple[Cell, ...],
    best: float,
    rows: BoolArray,
) -> float:
    """Return the share of a cause's own gain that it alone carries over."""
    data, solution = discovery.residuals, discovery.selection.solution
    rest = tuple(cell for cell in solution.cells if cell not in group)
    without = solve(data, rest, solution)
    if without is None:
        return float('nan')
    own_rows = data.context.measurements.is_validation
    if not own_rows.any():
        own_rows = np.isin(np.arange(len(own_rows)), data.rows.source)
    own = (
        rms(data.unexplained(without), own_rows) ** 2
        - rms(data.unexplained(solution), own_rows) ** 2
    )
    others = tuple(other for other in discovery.groups if other is not group)
    offsets = discovery.fit.joint_offsets
    lost = rms(_left(discovery, found, offsets, others), rows) ** 2 - best**2
    return float(lost / own) if own > 0.0 else 0.0


def _left(
    discovery: Discovery,
    found: Estimate,
    joint_offsets: FloatArray | None,
    groups: Sequence[tuple[Cell, ...]],
) -> FloatArray:
    """Return the errors of every row with causes held, m, (n, 3).

    Offsets (rad, (k,)) are held too, or, where None, refitted with registration and markers.
    """
    if joint_offsets is None:
        data, joints = Residuals.at(found, found.mode), 0
    else:
        data = Residuals.at(found, hold_offsets(found.mode, joint_offsets))
        joints = found.model.joints
    values = dict(zip(discovery.fit.theta_names, discovery.fit.theta, strict=True))
    cells = [cell for group in groups for cell in group]
    theta = np.array([values[name] for cell in cells for name in cell.parameters])
    left = data.full_errors - data.displaced(cells, theta)
    # What is not held again: a small step, so linear.
    columns = data.full_jacobian[:, :, joints:]
    white = data.noise_model.whitened(columns[data.rows.source], data.noise).reshape(
        3 * len(data), -1
    )
    target = data.noise_model.whitened(left[data.rows.source], data.noise).ravel()
    scale = np.linalg.norm(white, axis=0)
    step = np.linalg.lstsq(white / scale, target, rcond=1e-9)[0] / scale
    return left - columns @ step


def require_same_cell(session: Session, other: Session) -> None:
    """Refuse to compare sessions of different robots, sensors or markers.

    Raises
    ------
    InputError
        Says what differs.
    """
    mine, theirs = Problem.of(session), Problem.of(other)
    if mine.chain.joint_names != theirs.chain.joint_names:
        raise InputError(
            f'the other session is of another robot: its joints are '
            f'{", ".join(theirs.chain.joint_names)}, not {", ".join(mine.chain.joint_names)}'
        )
    if not np.allclose(mine.chain.T_fixed, theirs.chain.T_fixed, atol=1e-6):
        raise InputError(
            "the other session's URDF has another geometry; confirm with the same arm"
        )
    for kind, own, others in (
        ('sensors', mine.sensor_names, theirs.sensor_names),
        ('markers', mine.marker_names, theirs.marker_names),
    ):
        if own != others:
            raise InputError(
                f'the other session has the {kind} {", ".join(others)}, not {", ".join(own)}; '
                'confirm with a session of the same cell'
            )


def in_words(discovery: Discovery, confirmation: Confirmation) -> list[str]:
    """Return a sentence for each cause: how far it holds in the other session."""
    if not confirmation.same_offsets:
        least = min(confirmation.rms_before_m, confirmation.rms_after_m)
        return [
            f'The zero-offsets found here are not those of the other session: '
            f'{1e3 * least:.3f} mm with them, {1e3 * confirmation.rms_own_m:.3f} mm with its own. '
            'That is another arm, or it was mastered anew in between: nothing is confirmed.'
        ]
    return [
        _share_in_words(effect, share)
        for effect, share in zip(discovery.effects, confirmation.effects, strict=False)
    ]


def _share_in_words(effect: FoundEffect, share: float) -> str:
    if not np.isfinite(share):
        return f'{effect.cause} The other session does not determine it.'
    if share > 0.5:
        return f'{effect.cause} Confirmed: {100 * share:.0f} % of its gain carries over.'
    if share > 0.1:
        return f'{effect.cause} Changed: only {100 * share:.0f} % of its gain carries over.'
    return f'{effect.cause} Not there any more: its correction gains nothing in this session.'
