# SPDX-License-Identifier: Apache-2.0
"""Mistakes of people in the tables of a session, made on purpose, for the tests.

Each is returned with the option of ``remaster import`` that undoes it; None where the session has
not what it takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix
from remaster_ros.types import Session

Spoil = Callable[[Session, np.random.Generator], 'tuple[Session, str] | None']


def _with(session: Session, **columns: np.ndarray) -> Session:
    return replace(session, measurements=replace(session.measurements, **columns))


def names(session: Session) -> list[str]:
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    return list(chain.joint_names)


def reversed_joint(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """One joint, not an outer one, counts the other way round."""
    q = session.measurements.q.copy()
    joint = rng.integers(1, q.shape[1] - 1)
    q[:, joint] *= -1.0
    return _with(session, q=q), f'--reverse {names(session)[joint]}'


def exchanged_columns(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """Two joints' columns are exchanged."""
    q = session.measurements.q.copy()
    a, b = np.sort(rng.choice(q.shape[1], 2, replace=False))
    q[:, [a, b]] = q[:, [b, a]]
    order = np.array(names(session))
    order[[a, b]] = order[[b, a]]
    return _with(session, q=q), f'--joints {",".join(order)}'


def reversed_order(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """The columns stand tip to base."""
    q = session.measurements.q[:, ::-1].copy()
    return _with(session, q=q), f'--joints {",".join(names(session)[::-1])}'


def quarter_off(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """The zero of a joint, not an outer one, is 90 degrees off."""
    q = session.measurements.q.copy()
    joint, turn = rng.integers(1, q.shape[1] - 1), rng.choice((-1, 1))
    q[:, joint] += turn * np.pi / 2.0
    return _with(session, q=q), f'--offset {names(session)[joint]}={-90 * turn}'


def degrees_for_radians(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """Radians that somebody converted once more."""
    return _with(session, q=np.deg2rad(session.measurements.q)), '--multiply-angles 57.29'


def millimetres(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """Points in mm, or in km."""
    scale = float(rng.choice((1e3, 1e-3)))
    option = '--length mm' if scale > 1.0 else '--multiply-points 1000.0'
    return _with(session, position=scale * session.measurements.position), option


def shifted_rows(session: Session, rng: np.random.Generator) -> tuple[Session, str]:
    """Every sensor's points stand beside the joints of its row before, or behind."""
    m = session.measurements
    shift = int(rng.choice((-1, 1)))
    keep, q = np.ones(len(m), bool), m.q.copy()
    for sensor in np.unique(m.sensor):
        for marker in np.unique(m.marker[m.sensor == sensor]):
            rows = np.flatnonzero((m.sensor == sensor) & (m.marker == marker))
            q[rows] = np.roll(m.q[rows], shift, axis=0)
            keep[rows[0 if shift > 0 else -1]] = False
    return _with(session, q=q).select(np.flatnonzero(keep)), f'--shift-points={shift}'


def shifted_from_a_row_on(
    session: Session, rng: np.random.Generator
) -> tuple[Session, str] | None:
    """From a row on the points stand one row too early: one of them is missing."""
    m = session.measurements
    if len(np.unique(m.sensor)) > 1 or len(np.unique(m.marker)) > 1:
        return None
    at = int(rng.integers(len(m) // 3, 2 * len(m) // 3))
    position = np.concatenate((m.position[:at], m.position[at + 1 :], m.position[-1:]))
    return _with(session, position=position).select(np.arange(len(m) - 1)), '--shift-points=1@'


def exchanged_markers(session: Session, rng: np.random.Generator) -> tuple[Session, str] | None:
    """From a row on, the labels of two markers of one sensor are exchanged."""
    m = session.measurements
    for sensor in np.unique(m.sensor):
        seen = np.unique(m.marker[m.sensor == sensor])
        if len(seen) > 1:
            a, b = rng.choice(seen, 2, replace=False)
            at = int(rng.integers(len(m) // 4, 3 * len(m) // 4))
            late = np.arange(len(m)) >= at
            marker = m.marker.copy()
            marker[late & (m.marker == a)] = b
            marker[late & (m.marker == b)] = a
            a, b = (session.marker_names[index] for index in sorted((a, b)))
            return _with(session, marker=marker), f'--exchange-markers {a},{b}@'
    return None


def turned_tool(session: Session, rng: np.random.Generator) -> tuple[Session, str] | None:
    """The places of the markers are given in a tool frame that is turned by 90 degrees."""
    if session.marker_std_m > 0.01:
        return None
    axis, turn = rng.integers(3), rng.choice((-1, 1, 2))
    R = rotation_vector_to_matrix(turn * np.pi / 2.0 * np.eye(3)[axis])
    places = {name: R @ place for name, place in session.markers.items()}
    return replace(session, markers=places), f'--turn-tool {"xyz"[axis]}='


SPOILS: dict[str, Spoil] = {
    'sign': reversed_joint,
    'columns': exchanged_columns,
    'order': reversed_order,
    'zero': quarter_off,
    'angle unit': degrees_for_radians,
    'length unit': millimetres,
    'rows': shifted_rows,
    'rows from a row on': shifted_from_a_row_on,
    'marker labels': exchanged_markers,
    'tool': turned_tool,
}


def with_offsets(session: Session, rng: np.random.Generator, degrees: float) -> Session:
    """The inner joints' zeros are off by so many degrees, and nothing else is wrong."""
    q = session.measurements.q.copy()
    q[:, 1:-1] += np.deg2rad(degrees) * rng.choice((-1.0, 1.0), q.shape[1] - 2)
    return _with(session, q=q)
