# SPDX-License-Identifier: Apache-2.0
"""Sessions in which something begins, or ends, at a moment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from worlds.hidden_sessions import Recipe, hidden_session

from remaster_ros.types import Session

CHANGING = (
    'backlash',
    'settling',
    'joint_compliance',
    'base_compliance',
    'sensor_scale',
    'registration_drift',
)
"""Kinds that come and go in mid-session: play, a setting, a payload, a foot, a warp, a mount."""


@dataclass(frozen=True, eq=False)
class Changing:
    """A session, and the truth, which is for the judges alone."""

    session: Session
    moment_s: float  # s since the first reading
    duration_s: float
    kind: str
    joints: tuple[int, ...]


def changing_session(recipe: Recipe, share: float, *, ends: bool = False) -> Changing:
    """Make a session whose effect begins after a share of its time, or ends then.

    A drift begins from nothing. The recipe has one kind.
    """
    source = hidden_session(recipe)
    (effect,) = source.truth.effects
    m = source.session.measurements
    moved = source.truth.clean - source.world.seen(())
    since = m.stamp_s - m.stamp_s.min()
    duration = float(np.ptp(since))
    moment = share * duration
    if effect.kind == 'registration_drift':
        shift = np.maximum(since - moment, 0.0)[:, None] * effect.values
    else:
        shift = moved * ((since <= moment) if ends else (since > moment))[:, None]
    session = replace(source.session, measurements=replace(m, position=m.position - moved + shift))
    return Changing(session, moment, duration, effect.kind, tuple(effect.joints))
