# SPDX-License-Identifier: Apache-2.0
"""What sensors measure of an arm with hidden effects, on one round of visits.

Every hidden world uses this model: the fakes with the package's chain, the tests with pinocchio's.
It also works out, by least squares of its own, how much of an effect is left when registration,
zero-offsets and markers are fitted: that is the size of an effect in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.simulation.hidden_effects import (
    SLACK_RAD,
    SLIDE_M,
    Circumstances,
    Deviation,
    HiddenEffect,
    add_effect,
)
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class ArmState:
    """The arm at n configurations, everything in the base frame R."""

    origin: FloatArray  # Origin of every joint, before its own move, m, (n, k, 3)
    # Rotation of each joint's frame before and after its own turn, (n, k, 3, 3)
    before: FloatArray
    after: FloatArray
    axis: FloatArray  # Unit axis of each joint, (n, k, 3)
    # Of the tool frame, m, (n, 3) and (n, 3, 3)
    tool_origin: FloatArray
    tool: FloatArray


class Arm(Protocol):
    """Kinematics and gravity of an arm of k joints as drawn."""

    joints: int
    slides: BoolArray  # Which of them slide, (k,)

    def state(self, q: FloatArray) -> ArmState:
        """Where every joint is for true joint angles q, rad, (n, k)."""

    def gravity_torque(self, q: FloatArray) -> FloatArray:
        """Torque with which gravity turns each joint its own way, N m, (n, k)."""

    def base_moment(self, q: FloatArray) -> FloatArray:
        """Moment of the moving links' weight about the base's origin, N m, (n, 3)."""

    def carried_moment(self, q: FloatArray) -> FloatArray:
        """Gravity's moment on what each joint carries about its origin, in R, N m, (n, k, 3)."""

    def segments(self) -> FloatArray:
        """From each joint to the next one, the last to the tool, m, (k + 1, 3).

        Segment j is fixed in the frame after joint j; segment 0, before joint 1, in the base.
        """


@dataclass(frozen=True, eq=False)
class Round:
    """The configurations visited, in that order."""

    q: FloatArray  # As the robot reported them, rad, (m, k)
    home: FloatArray  # Where it came from first, rad, (k,)
    time_s: FloatArray  # Since the beginning, (m,)
    warming_k: FloatArray  # Temperature of the arm above that of the beginning, K, (m,)

    @cached_property
    def came_from(self) -> FloatArray:
        """Configuration before each, rad, (m, k)."""
        return np.concatenate((self.home[None], self.q[:-1]))


def circumstances(arm: Arm, visited: Round, joint_offsets: FloatArray) -> Circumstances:
    """Return what effects may depend on, per configuration."""
    q, per_radian = visited.q + joint_offsets, np.where(arm.slides, SLIDE_M, 1.0)
    move = visited.q - visited.came_from
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
    """Return what all the effects together do to sensors and markers of these names."""
    n, k = c.q.shape
    together = Deviation.none(n, k, sensors, markers)
    for effect in effects:
        add_effect(effect, together, c)
    return together


def placed(state: ArmState, marker: FloatArray, wrong: Deviation | None) -> FloatArray:
    """Where a marker of the tool frame (3,) or (n, 3) is in R, m, (n, 3).

    Small motions within the chain are exact: T₁D₁T₂D₂p = (A₁D₁A₁⁻¹)(A₂D₂A₂⁻¹)A₂p with A₂ = T₁T₂,
    so each moves what lies outside it, the outermost first, in the frames of the chain as drawn.
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
    """What the named sensor measures of a marker at a position of the tool frame (3,), m, (n, 3).

    In the sensor's frame N.
    """
    if wrong is None:
        return sensor.in_sensor(placed(state, position, None))
    moved = position + wrong.marker[:, wrong.markers.index(marker)]
    return wrong.measured(name, sensor.in_sensor(placed(state, moved, wrong)))


@dataclass(eq=False)
class WorldModel:
    """The true arm and sensors on one round."""

    arm: Arm  # As drawn
    visited: Round
    sensors: Mapping[str, SimulatedSensor]
    # True positions in the tool frame where nothing is hidden, m, name -> (3,)
    markers: Mapping[str, FloatArray]
    joint_offsets: FloatArray  # True joint angle minus reported one, rad, (k,)

    @cached_property
    def circumstances(self) -> Circumstances:
        """What effects may depend on, per configuration."""
        return circumstances(self.arm, self.visited, self.joint_offsets)

    def seen(self, effects: Sequence[HiddenEffect] = ()) -> FloatArray:
        """What the sensors see without noise, each in its own frame N, m, (n, 3).

        Rows as they are recorded: at every configuration one of each marker of each sensor.
        """
        state, wrong = self._reached(effects)
        points = [
            measured(state, name, sensor, marker, self.markers[marker], wrong)
            for name, sensor in self.sensors.items()
            for marker in sensor.markers
        ]
        return np.stack(points, axis=1).reshape(-1, 3)

    def tool_seen(self, effects: Sequence[HiddenEffect] = ()) -> FloatArray:
        """How the tool stands before each sensor without noise, R_N_T, (n, sensors, 3, 3).

        Of what a sensor does by itself only a turn turns it; the rest moves points.
        """
        state, wrong = self._reached(effects)
        origin = placed(state, np.zeros(3), wrong)
        tool = np.stack([placed(state, axis, wrong) - origin for axis in np.eye(3)], axis=-1)
        seen = np.stack([x.T_R_N[:3, :3].T @ tool for x in self.sensors.values()], axis=1)
        if wrong is None:
            return seen
        turn = Rotation.from_rotvec(wrong.turn.reshape(-1, 3)).as_matrix()
        return np.asarray(turn.reshape(seen.shape) @ seen)

    def _reached(self, effects: Sequence[HiddenEffect]) -> tuple[ArmState, Deviation | None]:
        """Return where the arm truly is, and what else is wrong there."""
        q = self.visited.q + self.joint_offsets
        if not effects:
            return self.arm.state(q), None
        names = tuple(self.sensors), tuple(self.markers)
        wrong = deviation(effects, self.circumstances, *names)
        return self.arm.state(q + wrong.angle), wrong

    @cached_property
    def distance_m(self) -> dict[str, float]:
        """Mean distance of what each sensor measures, m."""
        seen_by = [name for name, sensor in self.sensors.items() for _ in sensor.markers]
        points = self._as_drawn.reshape(-1, len(seen_by), 3)
        length = np.linalg.norm(points, axis=2).mean(axis=0)
        return {
            name: float(np.mean(length[[name == other for other in seen_by]]))
            for name in self.sensors
        }

    def response(self, effect: HiddenEffect) -> FloatArray:
        """How far an effect moves what the sensors see, m, (n, 3)."""
        return self.seen([effect]) - self._as_drawn

    @cached_property
    def _as_drawn(self) -> FloatArray:
        return self.seen()

    @cached_property
    def nuisance(self) -> FloatArray:
        """Derivatives of what is seen by offsets, registrations, markers: m, (n, 3, p).

        Offsets first (k), then six per sensor, last three per marker.
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
        """What of a response (n, 3) no registration, offsets and markers take up, m, (n, 3)."""
        basis = self._basis if fit_markers else self._basis_without_markers
        flat = response.ravel()
        return (flat - basis @ (basis.T @ flat)).reshape(-1, 3)

    @cached_property
    def _basis(self) -> FloatArray:
        return _span(self.nuisance.reshape(-1, self.nuisance.shape[2]))

    @cached_property
    def _basis_without_markers(self) -> FloatArray:
        fixed = self.nuisance[:, :, : -3 * len(self.markers)]
        return _span(fixed.reshape(-1, fixed.shape[2]))

    def size_m(self, effect: HiddenEffect) -> float:
        """What is left of an effect, RMS of the 3-D error over all rows, m.

        A wrong marker is measured against a marker that is held where it should be: if it were
        fitted, nothing would be left.
        """
        left = self.left(self.response(effect), fit_markers=effect.kind != 'marker_offset')
        return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))

    def of_size(self, effect: HiddenEffect, size_m: float) -> HiddenEffect:
        """Scale an effect so that this is left of it."""
        for _ in range(3):  # all but linear
            effect = effect.scaled(size_m / self.size_m(effect))
        return effect


def _span(design: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what the columns of a design span, (3 n, rank)."""
    basis, singular, _ = np.linalg.svd(design, full_matrices=False)
    return basis[:, singular > 1e-9 * singular[0]]
