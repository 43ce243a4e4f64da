"""A world that the estimating code cannot see and that shares no physics with it.

Its kinematics and gravity are pinocchio's, its effects are written from their equations
(`hidden_effects`), its registration and its least squares are its own. From `remaster_ros` it
takes the plain records of a session; only `hidden_tours`, which chooses the configurations, asks
the robot's own software, as a real cell does.

A world predicts what every sensor sees of an arm with any effects. `measure` adds noise and
returns the session, with no more in it than a recorded one, and the truth, for the judges alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from hidden_arm import Arm, ArmState
from hidden_effects import SLACK_RAD, Circumstances, Deviation, HiddenEffect
from scipy.spatial.transform import Rotation

from remaster_ros.core.types import BoolArray, FloatArray, IntArray, Measurements, Session

MARKER_STD_M = 0.5e-3


@dataclass(frozen=True, eq=False)
class Visits:
    """The configurations in the order visited, as the robot reported them.

    Attributes
    ----------
    q
        rad, (m, k).
    pose
        Which commanded pose, (m,).
    is_validation
        Held out, (m,).
    home
        Where the arm came from first, rad, (k,).
    """

    q: FloatArray
    pose: IntArray
    is_validation: BoolArray
    home: FloatArray


@dataclass(frozen=True, eq=False)
class HiddenSensor:
    """A sensor: where it stands (rotation and origin of its frame N in R) and what it follows."""

    rotation: FloatArray
    origin: FloatArray
    marker: str


@dataclass(frozen=True)
class Noise:
    """How a sensor errs.

    Attributes
    ----------
    sigma_m
        RMS per axis of what is new at every measurement.
    pose_sigma_m
        RMS per axis of what all measurements of one sensor at one pose share.
    depth_ratio
        How many times worse along z of N than across.
    range_power
        The errors grow with this power of the distance (0: everywhere the same).
    outlier_share
        Share of the observations that are gross errors of 3 to 30 mm.
    held_out_outliers
        Whether rows held out have them too.
    """

    sigma_m: float = 0.1e-3
    pose_sigma_m: float = 0.0
    depth_ratio: float = 1.0
    range_power: float = 0.0
    outlier_share: float = 0.0
    held_out_outliers: bool = True


@dataclass(frozen=True, eq=False)
class HiddenTruth:
    """What a session was made of.

    Attributes
    ----------
    effects
        What was hidden.
    size_m
        What each effect leaves alone after registration, offsets and marker are fitted, RMS of
        the 3-D error over all rows.
    joint_offsets
        rad, (k,).
    clean
        What the sensors would have seen without noise, m, (n, 3).
    std, pose_std
        True standard deviations per row and axis of the two parts of the noise, m, (n, 3) each.
    outliers
        Rows with a gross error.
    """

    effects: tuple[HiddenEffect, ...]
    size_m: tuple[float, ...]
    joint_offsets: FloatArray
    clean: FloatArray
    std: FloatArray
    pose_std: FloatArray
    outliers: IntArray


class HiddenWorld:
    """An arm with true offsets and markers in front of true sensors, on one round of visits.

    Parameters
    ----------
    urdf
        The nominal arm.
    visits
        Where it goes.
    sensors, markers
        By name; true places, and nominal positions in the tool frame, m.
    rng
        Draws the offsets (0.3° each), the true markers (0.5 mm per axis), the times (10 s and
        more per configuration) and the temperature (a warming by 3 to 10 K and a slow swing).
    """

    def __init__(
        self,
        urdf: str,
        visits: Visits,
        sensors: Mapping[str, HiddenSensor],
        markers: Mapping[str, FloatArray],
        rng: np.random.Generator,
    ) -> None:
        self.arm = Arm(urdf)
        self.urdf, self.visits, self.sensors, self.markers = urdf, visits, sensors, markers
        m, k = visits.q.shape
        self.joint_offsets = np.deg2rad(0.3) * rng.standard_normal(k)
        self.true_markers = {
            name: position + MARKER_STD_M * rng.standard_normal(3)
            for name, position in markers.items()
        }
        self._came_from = np.concatenate((visits.home[None], visits.q[:-1]))
        travel = np.max(np.abs(visits.q - self._came_from), axis=1) / 0.5
        self.stamp_s = np.cumsum(10.0 + travel + rng.uniform(0.0, 3.0, m))
        since = self.stamp_s - self.stamp_s[0]
        warming = rng.uniform(3.0, 10.0) * (1.0 - np.exp(-since / rng.uniform(1000.0, 4000.0)))
        swing = rng.uniform(0.5, 1.5) * np.sin(2 * np.pi * since / rng.uniform(1500.0, 6000.0))
        self._warming_k = warming + swing
        self.temperature_c = 21.0 + self._warming_k + 0.05 * rng.standard_normal(m)
        # Rows as recorded: at every configuration one of each sensor.
        self.configuration = np.repeat(np.arange(m), len(sensors))
        self.sensor = np.tile(np.arange(len(sensors)), m)
        names = list(markers)
        follows = [names.index(sensor.marker) for sensor in sensors.values()]
        self.marker = np.tile(follows, m)

    # The physics

    @cached_property
    def circumstances(self) -> Circumstances:
        """What effects may depend on, per configuration."""
        q = self.visits.q
        state = self.arm.state(q + self.joint_offsets)
        move = q - self._came_from
        approach = np.zeros_like(q)
        last = np.zeros(q.shape[1])
        for i, step in enumerate(move):
            last = np.where(np.abs(step) > SLACK_RAD, np.sign(step), last)
            approach[i] = last
        home = self.arm.state(np.zeros((1, q.shape[1])))
        axes = np.einsum('kji,kj->ki', home.after[0], home.axis[0])
        return Circumstances(
            q=q,
            move=move,
            approach=approach,
            time_s=self.stamp_s - self.stamp_s[0],
            warming_k=self._warming_k,
            torque=self.arm.gravity_torque(q + self.joint_offsets),
            base_moment=self.arm.base_moment(q + self.joint_offsets),
            segments=self.arm.segments(),
            axes=axes,
            tool=state.tool,
        )

    def seen(self, effects: Sequence[HiddenEffect] = ()) -> FloatArray:
        """What the sensors see without noise, each in its own frame N, m, (n, 3)."""
        m, k = self.visits.q.shape
        deviation = Deviation.none(m, k)
        for effect in effects:
            effect.add_to(deviation, self.circumstances)
        state = self.arm.state(self.visits.q + self.joint_offsets + deviation.angle)
        points = np.empty((m, len(self.sensors), 3))
        for s, (name, sensor) in enumerate(self.sensors.items()):
            marker = self.true_markers[sensor.marker] + deviation.marker
            in_base = _placed(state, marker, deviation)
            in_sensor = (in_base - sensor.origin) @ sensor.rotation
            added = [rule(in_sensor) for rule in deviation.sensors.get(name, [])]
            points[:, s] = in_sensor + sum(added)
        return points.reshape(-1, 3)

    def response(self, effect: HiddenEffect) -> FloatArray:
        """How far an effect moves what the sensors see, m, (n, 3)."""
        return self.seen([effect]) - self._as_drawn

    @cached_property
    def _as_drawn(self) -> FloatArray:
        return self.seen()

    # What registration, offsets and marker can take up

    @cached_property
    def nuisance(self) -> FloatArray:
        """Derivatives of what is seen by offsets, registrations, markers: m, (n, 3, p).

        Offsets first (k), then six per sensor, last three per marker.
        """
        state = self.arm.state(self.visits.q + self.joint_offsets)
        blocks = []
        for s, sensor in enumerate(self.sensors.values()):
            marker = self.true_markers[sensor.marker]
            point = _placed(state, marker, None)
            turns = np.cross(state.axis, point[:, None] - state.origin)
            offsets = np.swapaxes(turns, 1, 2)
            centered = point - point.mean(axis=0)
            turned = np.stack([np.cross(axis, centered) for axis in np.eye(3)], axis=-1)
            shifted = np.broadcast_to(np.eye(3), (len(point), 3, 3))
            frames = np.zeros((len(point), 3, 6 * len(self.sensors)))
            frames[:, :, 6 * s : 6 * s + 6] = np.concatenate((shifted, turned), axis=2)
            places = np.zeros((len(point), 3, 3 * len(self.markers)))
            first = 3 * list(self.markers).index(sensor.marker)
            places[:, :, first : first + 3] = state.tool
            block = np.concatenate((offsets, frames, places), axis=2)
            blocks.append(np.einsum('ji,njp->nip', sensor.rotation, block))
        return np.stack(blocks, axis=1).reshape(len(self.configuration), 3, -1)

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

    # The measurement

    def measure(
        self, effects: Sequence[HiddenEffect], noise: Noise, rng: np.random.Generator
    ) -> tuple[Session, HiddenTruth]:
        """Visit everything once and measure."""
        clean = self.seen(effects)
        n = len(clean)
        distance = np.linalg.norm(clean, axis=1)
        growth = (distance / np.sqrt(np.mean(distance**2))) ** noise.range_power
        shape = np.array([1.0, 1.0, noise.depth_ratio])
        spread = growth[:, None] * shape
        spread /= np.sqrt(np.mean(spread**2))
        pose = self.visits.pose[self.configuration]
        groups = np.unique(np.stack((pose, self.sensor)), axis=1, return_inverse=True)[1].ravel()
        common = rng.standard_normal((groups.max() + 1, 3))[groups]
        std, pose_std = noise.sigma_m * spread, noise.pose_sigma_m * spread
        position = clean + std * rng.standard_normal((n, 3)) + pose_std * common
        gross = rng.random(n) < noise.outlier_share
        if not noise.held_out_outliers:
            gross &= ~self.visits.is_validation[self.configuration]
        outliers = np.flatnonzero(gross)
        direction = rng.standard_normal((len(outliers), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        position[outliers] += rng.uniform(3e-3, 30e-3, (len(outliers), 1)) * direction
        truth = HiddenTruth(
            effects=tuple(effects),
            size_m=tuple(self.size_m(effect) for effect in effects),
            joint_offsets=self.joint_offsets,
            clean=clean,
            std=std,
            pose_std=pose_std,
            outliers=outliers,
        )
        return self._session(position), truth

    def _session(self, position: FloatArray) -> Session:
        n, k = len(position), self.arm.joints
        came_from = self._came_from.copy()
        came_from[0] = np.nan
        row = self.configuration
        measurements = Measurements(
            observation=np.arange(n),
            pose=self.visits.pose[row],
            configuration=row,
            is_validation=self.visits.is_validation[row],
            stamp_s=self.stamp_s[row],
            sensor=self.sensor,
            marker=self.marker,
            q=self.visits.q[row],
            from_q=came_from[row].reshape(n, k),
            position=position,
            std=np.full((n, 3), np.nan),
            samples=np.full(n, -1, dtype=np.int64),
            temperature_c=self.temperature_c[row],
        )
        return Session(
            urdf=self.urdf,
            base_link='base_link',
            tip_link='tool',
            markers=dict(self.markers),
            sensors={name: sensor.marker for name, sensor in self.sensors.items()},
            measurements=measurements,
            marker_std_m=MARKER_STD_M,
            exit_status='complete',
        )


def _placed(state: ArmState, marker: FloatArray, deviation: Deviation | None) -> FloatArray:
    """Where a marker of the tool frame (3,) or (n, 3) is in R, m, (n, 3).

    Small motions within the chain are exact: T₁D₁T₂D₂p = (A₁D₁A₁⁻¹)(A₂D₂A₂⁻¹)A₂p with A₂ = T₁T₂,
    so each moves what lies outside it, the outermost first, in the frames of the chain as drawn.
    """
    markers = np.broadcast_to(marker, state.tool_origin.shape)
    point = state.tool_origin + np.einsum('nij,nj->ni', state.tool, markers)
    if deviation is None:
        return point
    for j in range(state.origin.shape[1], 0, -1):
        point = point + np.einsum('nij,nj->ni', state.after[:, j - 1], deviation.shift[:, j])
        tilt = np.einsum('nij,nj->ni', state.before[:, j - 1], deviation.tilt[:, j - 1])
        arm = point - state.origin[:, j - 1]
        point = state.origin[:, j - 1] + Rotation.from_rotvec(tilt).apply(arm)
    return Rotation.from_rotvec(deviation.base).apply(point + deviation.shift[:, 0])


def _span(design: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what the columns of a design span, (3 n, rank)."""
    basis, singular, _ = np.linalg.svd(design, full_matrices=False)
    return basis[:, singular > 1e-9 * singular[0]]
