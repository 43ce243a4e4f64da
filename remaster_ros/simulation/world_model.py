# SPDX-License-Identifier: Apache-2.0
"""Sensor readings of an arm with hidden effects, on one round of visits.

Every hidden world uses this model: the fakes with the package's chain, the tests with pinocchio's.
By a least-squares fit of its own it also computes the error of an effect that remains after
registration, zero-offsets and markers are fitted: the size of the effect in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.simulation.hidden_effect import (
    SLACK_RAD,
    SLIDE_M,
    Circumstances,
    Deviation,
    HiddenEffect,
)
from remaster_ros.simulation.hidden_effects import add_effect
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class ArmState:
    """Joint origins, frames and axes, and the tool, at n configurations, in the base frame R."""

    origin: FloatArray  # Origin of every joint, before its own motion, m, (n, k, 3)
    # Rotation of each joint's frame before and after the joint's own, (n, k, 3, 3)
    before: FloatArray
    after: FloatArray
    axis: FloatArray  # Unit axis of each joint, (n, k, 3)
    # Origin of the tool frame, m, (n, 3), and its rotation, (n, 3, 3)
    tool_origin: FloatArray
    tool: FloatArray


class Arm(Protocol):
    """Kinematics and gravity of an arm of k joints as drawn."""

    joints: int
    slides: BoolArray  # Whether each joint slides, (k,)

    def state(self, q: FloatArray) -> ArmState:
        """Origins, frames and axes of all joints, and the tool, at true positions q (n, k).

        In the robot base frame R. ``q``: rad or m.
        """

    def gravity_torque(self, q: FloatArray) -> FloatArray:
        """Gravity's torque about each joint, in its positive direction, N m, (n, k).

        The force along it, N, for a joint that slides. q: true positions.
        """

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Torque of the moving links' weight about the origin of the base, N m, (n, 3).

        In the robot base frame R. ``q``: true positions, rad or m, (n, k).
        """

    def carried_moment(self, q: FloatArray) -> FloatArray:
        """Gravity's torque on all links behind each joint about its origin, N m, (n, k, 3).

        In the robot base frame R. ``q``: true positions, rad or m, (n, k).
        """

    def segments(self) -> FloatArray:
        """Vectors from the base to joint 1, from joint to joint, and to the tool, m, (k + 1, 3).

        Of the nominal arm, without hidden errors. Row j is in the frame after joint j, row 0 in
        that of the base.
        """


@dataclass(frozen=True, eq=False)
class Round:
    """Configurations that the arm visits, in their order, with times and temperatures."""

    q: FloatArray  # Joint angles as reported by the robot, rad, (m, k)
    home: FloatArray  # Joint angles before the first visit, rad, (k,)
    time_s: FloatArray  # Time since the beginning, s, (m,)
    warming_k: FloatArray  # Temperature of the arm above that of the beginning, K, (m,)

    @cached_property
    def previous_q(self) -> FloatArray:
        """Configuration before each visit, rad or m, (m, k): home before the first."""
        return np.concatenate((self.home[None], self.q[:-1]))


def circumstances(arm: Arm, visited: Round, joint_offsets: FloatArray) -> Circumstances:
    """Quantities on which hidden effects may depend, at each visited configuration.

    Torques and frames are those of the reported angles plus ``joint_offsets``, rad or m, (k,).
    A joint's approach (direction of its last move) is 0 until it moves.
    """
    q, per_radian = visited.q + joint_offsets, np.where(arm.slides, SLIDE_M, 1.0)
    move = visited.q - visited.previous_q
    approach = np.zeros_like(q)
    last = np.zeros(arm.joints)
    for i, step in enumerate(move):
        last = np.where(np.abs(step) > SLACK_RAD * per_radian, np.sign(step), last)
        approach[i] = last
    state = arm.state(q)
    return Circumstances(
        q=visited.q,
        move=move,
        approach=approach,
        time_s=visited.time_s,
        warming_k=visited.warming_k,
        torque=arm.gravity_torque(q),
        base_moment=arm.base_moment(q),
        carried_moment=np.einsum('nkji,nkj->nki', state.before, arm.carried_moment(q)),
        segments=arm.segments(),
        axes=np.einsum('kji,kj->ki', state.after[0], state.axis[0]),
        tool=state.tool,
        per_radian=per_radian,
    )


def deviation(
    effects: Sequence[HiddenEffect],
    c: Circumstances,
    sensors: tuple[str, ...],
    markers: tuple[str, ...],
) -> Deviation:
    """Deviation of arm and sensors by all effects together, at n configurations.

    ``c``: what they depend on; ``sensors, markers``: names. Zero without effects.
    """
    n, k = c.q.shape
    total = Deviation.none(n, k, sensors, markers)
    for effect in effects:
        add_effect(effect, total, c)
    return total


def placed(state: ArmState, marker: FloatArray, wrong: Deviation | None) -> FloatArray:
    """Positions of a point given in the tool frame, with deviations of the arm, m, (n, 3).

    In the robot base frame R. ``marker``: the point, m, (3,) or (n, 3); ``wrong``: deviations
    but for those of the joint angles, which ``state`` has already; None for none. Small
    motions within the chain are exact: T₁D₁T₂D₂p = (A₁D₁A₁⁻¹)(A₂D₂A₂⁻¹)A₂p with A₂ = T₁T₂, so
    each moves the part of the arm behind it, the outermost first, in the frames of the chain
    as drawn.
    """
    markers = np.broadcast_to(marker, state.tool_origin.shape)
    point = state.tool_origin + np.einsum('nij,nj->ni', state.tool, markers)
    if wrong is None:
        return point
    for j in range(state.origin.shape[1], 0, -1):
        point = point + np.einsum('nij,nj->ni', state.after[:, j - 1], wrong.shift[:, j])
        tilt = np.einsum('nij,nj->ni', state.before[:, j - 1], wrong.tilt[:, j - 1])
        arm = point - state.origin[:, j - 1]
        point = state.origin[:, j - 1] + Rotation.from_rotvec(tilt).apply(arm)
    return Rotation.from_rotvec(wrong.base).apply(point + wrong.shift[:, 0])


def measured(
    state: ArmState,
    name: str,
    sensor: SimulatedSensor,
    marker: str,
    position: FloatArray,
    wrong: Deviation | None,
) -> FloatArray:
    """Readings, without noise, of a marker by a sensor in its frame N, m, (n, 3).

    ``name``: of the sensor; ``marker``: name of the marker; ``position``: in the tool frame,
    m, (3,); ``wrong``: deviation of arm and sensors, None without effects.
    """
    if wrong is None:
        return sensor.in_sensor(placed(state, position, None))
    moved = position + wrong.marker[:, wrong.markers.index(marker)]
    return wrong.measured(name, sensor.in_sensor(placed(state, moved, wrong)))


@dataclass(eq=False)
class WorldModel:
    """True arm and sensors on one round of visits, and the readings with hidden effects."""

    arm: Arm  # Arm as drawn
    visited: Round
    sensors: Mapping[str, SimulatedSensor]
    # True positions in the tool frame without effects, m, name -> (3,)
    markers: Mapping[str, FloatArray]
    joint_offsets: FloatArray  # True joint angle minus reported one, rad, (k,)

    @cached_property
    def circumstances(self) -> Circumstances:
        """Quantities on which effects may depend, at each visited configuration."""
        return circumstances(self.arm, self.visited, self.joint_offsets)

    def seen(self, effects: Sequence[HiddenEffect] = ()) -> FloatArray:
        """Readings of the sensors without noise, each in its own frame N, m, (n, 3).

        One row for each configuration, sensor and marker of the sensor, in this order, as a
        session records them.
        """
        state, wrong = self._true_state(effects)
        points = [
            measured(state, name, sensor, marker, self.markers[marker], wrong)
            for name, sensor in self.sensors.items()
            for marker in sensor.markers
        ]
        return np.stack(points, axis=1).reshape(-1, 3)

    def tool_seen(self, effects: Sequence[HiddenEffect] = ()) -> FloatArray:
        """Orientation of the tool in each sensor's frame without noise, R_N_T, (n, sensors, 3, 3).

        Of a sensor's own errors only its rotation turns the tool; the others move points.
        """
        state, wrong = self._true_state(effects)
        origin = placed(state, np.zeros(3), wrong)
        tool = np.stack([placed(state, axis, wrong) - origin for axis in np.eye(3)], axis=-1)
        seen = np.stack([x.T_R_N[:3, :3].T @ tool for x in self.sensors.values()], axis=1)
        if wrong is None:
            return seen
        turn = Rotation.from_rotvec(wrong.turn.reshape(-1, 3)).as_matrix()
        return np.asarray(turn.reshape(seen.shape) @ seen)

    def _true_state(self, effects: Sequence[HiddenEffect]) -> tuple[ArmState, Deviation | None]:
        """State of the arm at the true angles of all visits, and the deviation by effects.

        The deviation is None without effects.
        """
        q = self.visited.q + self.joint_offsets
        if not effects:
            return self.arm.state(q), None
        names = tuple(self.sensors), tuple(self.markers)
        wrong = deviation(effects, self.circumstances, *names)
        return self.arm.state(q + wrong.angle), wrong

    @cached_property
    def distance_m(self) -> dict[str, float]:
        """Mean distance of each sensor's markers from it over the visits, m, by name."""
        seen_by = [name for name, sensor in self.sensors.items() for _ in sensor.markers]
        points = self._as_drawn.reshape(-1, len(seen_by), 3)
        length = np.linalg.norm(points, axis=2).mean(axis=0)
        return {
            name: float(np.mean(length[[name == marker_sensor for marker_sensor in seen_by]]))
            for name in self.sensors
        }

    def response(self, effect: HiddenEffect) -> FloatArray:
        """Change of the sensors' readings by one effect alone, m, (n, 3), rows as of `seen`."""
        return self.seen([effect]) - self._as_drawn

    @cached_property
    def _as_drawn(self) -> FloatArray:
        """Readings without effects, as `seen`, m, (n, 3)."""
        return self.seen()

    @cached_property
    def nuisance(self) -> FloatArray:
        """Derivatives of the readings by what a fit estimates, m per rad or m, (n, 3, p).

        Parameters: joint offsets (k), then shift and rotation of each sensor (6), then the
        position of each marker (3). Rows as of `seen`.
        """
        state = self.arm.state(self.visited.q + self.joint_offsets)
        blocks = []
        seen = [(s, marker) for s, x in enumerate(self.sensors.values()) for marker in x.markers]
        for s, marker in seen:
            point = placed(state, self.markers[marker], None)
            turns = np.cross(state.axis, point[:, None] - state.origin)
            moves = np.where(self.arm.slides[:, None], state.axis, turns)
            offsets = np.swapaxes(moves, 1, 2)
            centered = point - point.mean(axis=0)
            turned = np.stack([np.cross(axis, centered) for axis in np.eye(3)], axis=-1)
            shifted = np.broadcast_to(np.eye(3), (len(point), 3, 3))
            frames = np.zeros((len(point), 3, 6 * len(self.sensors)))
            frames[:, :, 6 * s : 6 * s + 6] = np.concatenate((shifted, turned), axis=2)
            places = np.zeros((len(point), 3, 3 * len(self.markers)))
            first = 3 * list(self.markers).index(marker)
            places[:, :, first : first + 3] = state.tool
            block = np.concatenate((offsets, frames, places), axis=2)
            R_R_N = list(self.sensors.values())[s].T_R_N[:3, :3]
            blocks.append(np.einsum('ji,njp->nip', R_R_N, block))
        return np.stack(blocks, axis=1).reshape(-1, 3, blocks[0].shape[2])

    def left(self, response: FloatArray, *, fit_markers: bool = True) -> FloatArray:
        """Part of a change of the readings that remains after a fit, m, (n, 3).

        ``response``: the change, m, (n, 3). The linear fit absorbs changes of sensor poses and
        joint offsets, and of markers if ``fit_markers``.
        """
        basis = self._basis if fit_markers else self._basis_without_markers
        flat = response.ravel()
        return (flat - basis @ (basis.T @ flat)).reshape(-1, 3)

    @cached_property
    def _basis(self) -> FloatArray:
        """Orthonormal basis of what a fit with free markers absorbs, (3 n, rank)."""
        return _span(self.nuisance.reshape(-1, self.nuisance.shape[2]))

    @cached_property
    def _basis_without_markers(self) -> FloatArray:
        """Orthonormal basis of what a fit with fixed markers absorbs, (3 n, rank)."""
        fixed = self.nuisance[:, :, : -3 * len(self.markers)]
        return _span(fixed.reshape(-1, fixed.shape[2]))

    def size_m(self, effect: HiddenEffect) -> float:
        """Size of an effect: RMS length, m, of what remains of it in all rows after the fit.

        The fit is that of `left`. A wrong marker is compared with a marker fixed at its
        nominal position: a fitted marker would absorb it.
        """
        remainder = self.left(self.response(effect), fit_markers=effect.kind != 'marker_offset')
        return float(np.sqrt(np.mean(np.sum(remainder**2, axis=1))))

    def of_size(self, effect: HiddenEffect, size_m: float) -> HiddenEffect:
        """Return an effect scaled so that `size_m`, the method, gives the size ``size_m``, m.

        Approximately: it is scaled three times, as the size is not quite linear in the values.
        """
        for _ in range(3):  # all but linear
            effect = effect.scaled(size_m / self.size_m(effect))
        return effect


def _span(design: FloatArray) -> FloatArray:
    """Orthonormal basis of the column space of a matrix (3 n, p), (3 n, rank)."""
    basis, singular, _ = np.linalg.svd(design, full_matrices=False)
    return basis[:, singular > 1e-9 * singular[0]]
