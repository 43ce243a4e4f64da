# SPDX-License-Identifier: Apache-2.0
"""An arm that moves while it is measured, with dynamics that share no code with what estimates.

Kinematics and inverse dynamics are pinocchio's, with the URDF's inertia tensors. Friction winds a
joint up with memory (Dahl 1968: a spring that slips), where what estimates has a function of the
speed; the tool swings as an oscillator that is integrated, where that has an acceleration; servo
lags, stamps of sensor and joint states, their jitter and the encoder's resolution are applied to
times and angles, not to derivatives. The error field of the sensor is a Gaussian process over the
tool's pose, where what estimates has segments.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, dlsim
from worlds.hidden_arm import pin

from remaster_ros.types import FloatArray

# Samples of the simulation a second.
RATE_HZ = 500.0
# Rest of a stop, s.
REST_S = 4.0
# Where the arm works: LWR 4+ of the demo's cell, rad.
MIDDLE = np.array([0.0, 0.6, 0.0, -1.3, 0.0, 0.9, 0.0])
REACH = np.array([1.0, 0.6, 1.0, 0.6, 1.2, 0.7, 1.5])


@dataclass(frozen=True)
class Dynamics:
    """Sizes of what is hidden, RMS of what is drawn; `scale` multiplies all."""

    clock_s: float = 20e-3  # Largest offset of the sensor's clock
    drift: float = 2e-5
    lag_s: float = 0.3e-3  # Of each joint
    windup_rad: float = np.radians(0.003)
    presliding_rad: float = 3e-4  # Travel in which friction turns round
    stiffness_nm_rad: float = 12e3
    mode_hz: float = 12.0
    damping: float = 0.05
    jitter_s: float = 0.05e-3
    scale: float = 1.0  # Of lag, wind-up, inertia and mode


@dataclass(frozen=True)
class Errors:
    """Noise of the sensor and of the encoders."""

    white_m: float = 0.1e-3  # Per axis, of each marker in each frame
    field_m: float = 0.2e-3  # Common to the markers of the tool
    own_field_m: float = 0.0  # Of each marker by itself
    reach_m: float = 0.1
    reach_rad: float = 0.5
    encoder_rad: float = 1e-5
    resolution_rad: float = 2e-5


@dataclass(frozen=True, eq=False)
class Recording:
    """What was recorded, and the truth."""

    joint_stamps: FloatArray  # s, (j,)
    joints: FloatArray  # rad, (j, k)
    frame_stamps: FloatArray  # s, (f,)
    points: FloatArray  # m, in the sensor's frame, (f, m, 3)
    joint_offsets: FloatArray  # rad, (k,)
    clock_s: float  # Added to the frames' stamps to have the joints', at the middle of the time
    places: FloatArray  # True markers, m, (m, 3)
    lag_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    windup_rad: FloatArray = field(default_factory=lambda: np.zeros(0))
    softness: FloatArray = field(default_factory=lambda: np.zeros(0))  # rad/(N m), (k,)
    # What the offset of the clocks is with the mean of the lags, s: each weighted with the square
    # of the speed that its joint gives the first marker
    delay_s: float = 0.0


def path_of(
    lower: FloatArray,
    upper: FloatArray,
    speed: FloatArray,
    seconds: float,
    rng: np.random.Generator,
    *,
    share: float = 0.3,
    acceleration: float = 2.1,
    tool_speed: float | None = None,
    reach_of=None,
    stops: bool = False,
):
    """Return joint angles as a function of time, C2, within shares of the limits.

    ``tool_speed``, with ``reach_of`` (angles to points, m): the largest speed of the tool, m/s;
    ``stops``: rest for 4 s at each via point.
    """
    count = max(6, round(seconds / 0.9)) + 1
    via = MIDDLE + REACH * rng.uniform(-1.0, 1.0, (count, len(MIDDLE)))
    via = np.clip(via, lower + 0.1, upper - 0.1)
    durations = np.max(np.abs(np.diff(via, axis=0)) / (share * speed), axis=1)
    times = np.concatenate(([0.0], np.cumsum(np.maximum(durations, 0.3))))
    spline = CubicSpline(times, via, bc_type='clamped')
    at = np.linspace(0.0, times[-1], 4000)
    faster = np.max(np.abs(spline(at, 1)) / (share * speed))
    faster = max(faster, np.sqrt(np.max(np.abs(spline(at, 2))) / acceleration))
    if tool_speed is not None:
        moved = np.linalg.norm(np.gradient(reach_of(spline(at)), at, axis=0), axis=1)
        faster = max(faster, float(moved.max()) / tool_speed)
    times = times * faster
    if not stops:
        return CubicSpline(times, via, bc_type='clamped')
    return StopAndGo(via, 2.0 * np.diff(times))


class StopAndGo:
    """Joint angles of an arm that rests for 4 s at each via point, and between goes straight."""

    def __init__(self, via: FloatArray, seconds: FloatArray) -> None:
        self._via, self._seconds = via, seconds
        self._start = np.concatenate(([0.0], np.cumsum(seconds + REST_S)))
        # First and last time, as a spline has them.
        self.x = np.array([0.0, self._start[-1] + REST_S])

    def __call__(self, t: FloatArray, derivative: int = 0) -> FloatArray:
        """Return angles or their derivatives at times (n,), (n, k)."""
        index = np.clip(np.searchsorted(self._start, t, side='right') - 1, 0, len(self._via) - 1)
        last = index == len(self._via) - 1
        seconds = np.append(self._seconds, 1.0)[index]
        s = np.clip((t - self._start[index] - REST_S) / seconds, 0.0, 1.0)
        s = np.where(last, 0.0, s)
        along = (
            s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
            30.0 * s**2 * (1.0 - s) ** 2 / seconds,
            60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / seconds**2,
        )[derivative]
        step = np.concatenate((np.diff(self._via, axis=0), np.zeros((1, self._via.shape[1]))))
        base = self._via[index] if derivative == 0 else 0.0
        return base + along[:, None] * step[index]


class MovingWorld:
    """A true arm, tool and sensor, recorded along paths."""

    def __init__(
        self, urdf: str, rng: np.random.Generator, *, markers: int = 4, tip_link: str = 'tool'
    ) -> None:
        self.model = pin.buildModelFromXML(urdf)
        self.model.gravity.linear = np.array([0.0, 0.0, -9.81])
        self._data, self._rng = self.model.createData(), rng
        self._tip = self.model.getFrameId(tip_link)
        k = self.model.nq
        self.joint_offsets = np.radians(0.3) * rng.standard_normal(k)
        self.nominal = np.array(
            [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.02], [0.02, -0.09, 0.05]]
        )[:markers]
        self.places = self.nominal + 0.5e-3 * rng.standard_normal((markers, 3))
        turn = pin.exp3(rng.normal(0.0, 0.5, 3))
        self.sensor = pin.SE3(turn, rng.uniform(-2.5, 2.5, 3))

    def _tools(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rotation and origin of the tool, (n, 3, 3) and (n, 3)."""
        turns, origins = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
        for i, angles in enumerate(q):
            pin.forwardKinematics(self.model, self._data, angles)
            placed = pin.updateFramePlacement(self.model, self._data, self._tip)
            turns[i], origins[i] = placed.rotation, placed.translation
        return turns, origins

    def tool_points(self, q: FloatArray) -> FloatArray:
        """Return the first marker, for the speed of the tool, m, (n, 3)."""
        turns, origins = self._tools(q)
        return origins + turns @ self.nominal[0]

    def record(
        self,
        path: CubicSpline,
        dynamics: Dynamics,
        errors: Errors,
        *,
        joints_hz: float = 250.0,
        camera_hz: float = 120.0,
        start_s: float = 1000.0,
    ) -> Recording:
        """Move along a path once and record it."""
        rng, k, scale = self._rng, self.model.nq, dynamics.scale
        grid = np.arange(path.x[0], path.x[-1], 1.0 / RATE_HZ)
        q, v, a = path(grid), path(grid, 1), path(grid, 2)
        lag = scale * dynamics.lag_s * rng.standard_normal(k)
        windup = scale * dynamics.windup_rad * rng.standard_normal(k)
        link = q + self.joint_offsets
        link = link - windup * _dahl(q, dynamics.presliding_rad)
        softness = scale / dynamics.stiffness_nm_rad * rng.uniform(0.5, 1.5, k)
        inertia = np.array(
            [
                pin.rnea(self.model, self._data, *state)
                - pin.computeGeneralizedGravity(self.model, self._data, state[0])
                for state in zip(q, v, a)
            ]
        )
        link = link - softness * inertia
        turns, origins = self._tools(link)
        # The tool swings in its own axes, driven by its acceleration.
        accelerated = np.gradient(np.gradient(origins, grid, axis=0), grid, axis=0)
        driven = np.einsum('nji,nj->ni', turns, accelerated)
        origins = origins + np.einsum(
            'nij,nj->ni', turns, scale * _swung(driven, dynamics.mode_hz, dynamics.damping)
        )
        # True times of the frames, and what they say.
        margin = 0.1
        frames = np.arange(path.x[0] + margin, path.x[-1] - margin, 1.0 / camera_hz)
        # The sensor's clock is off by `clock`: its stamps are those of the joints less it.
        clock = dynamics.clock_s * rng.uniform(-1.0, 1.0)
        middle = 0.5 * (frames[0] + frames[-1])
        drift = dynamics.drift * rng.standard_normal()
        stamps = frames - clock - drift * (frames - middle)
        stamps = stamps + dynamics.jitter_s * rng.standard_normal(len(frames))
        tools = self._at(frames, grid, turns, origins)
        points = tools[1][:, None, :] + np.einsum('nij,mj->nmi', tools[0], self.places)
        shift = self._field(tools, errors, errors.field_m)[:, None, :]
        if errors.own_field_m:
            marker_fields = [self._field(tools, errors, errors.own_field_m) for _ in self.places]
            shift = shift + np.stack(marker_fields, axis=1)
        sensor = self.sensor.inverse()
        points = (points + shift) @ sensor.rotation.T + sensor.translation
        points += errors.white_m * rng.standard_normal(points.shape)
        # An encoder's report at a stamp is where the motor was a lag before.
        reports = np.arange(path.x[0], path.x[-1], 1.0 / joints_hz)
        reported_q = np.stack(
            [path(np.maximum(reports - lag[j], path.x[0]))[:, j] for j in range(k)], axis=1
        )
        reported_q += errors.encoder_rad * rng.standard_normal(reported_q.shape)
        reported_q = np.round(reported_q / errors.resolution_rad) * errors.resolution_rad
        reported = reports + dynamics.jitter_s * rng.standard_normal(len(reports))
        return Recording(
            start_s + np.sort(reported),
            reported_q,
            start_s + stamps,
            points,
            self.joint_offsets,
            clock,
            self.places,
            lag,
            windup,
            softness,
            clock + float(self._weights(q[::50], v[::50]) @ lag),
        )

    def _weights(self, q: FloatArray, v: FloatArray) -> FloatArray:
        power = np.zeros(self.model.nq)
        place = np.append(self.places.mean(axis=0), 1.0)
        for angles, speeds in zip(q, v):
            J = pin.computeFrameJacobian(
                self.model, self._data, angles, self._tip, pin.LOCAL_WORLD_ALIGNED
            )
            arm = pin.updateFramePlacement(self.model, self._data, self._tip).rotation @ place[:3]
            moved = (J[:3] + np.cross(J[3:].T, arm).T) * speeds
            power += np.sum(moved**2, axis=0)
        return power / power.sum()

    def _at(
        self, times: FloatArray, grid: FloatArray, turns: FloatArray, origins: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return tools between the samples, by splines of their axes and origins."""
        flat = CubicSpline(grid, np.concatenate((turns.reshape(-1, 9), origins), axis=1))(times)
        left, _, right = np.linalg.svd(flat[:, :9].reshape(-1, 3, 3))
        return left @ right, flat[:, 9:]

    def _field(
        self, tools: tuple[FloatArray, FloatArray], errors: Errors, size: float
    ) -> FloatArray:
        """Draw a Gaussian process over the tool's pose, squared exponential, m, (n, 3)."""
        rng, waves = self._rng, 400
        # Columns of a rotation by an angle a move by sqrt(2) a in all.
        place = np.concatenate(
            (tools[1] / errors.reach_m, tools[0].reshape(-1, 9) / (np.sqrt(2) * errors.reach_rad)),
            axis=1,
        )
        frequency = rng.standard_normal((place.shape[1], waves))
        phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        weight = rng.standard_normal((waves, 3)) * np.sqrt(2.0 / waves)
        return size * np.cos(place @ frequency + phase) @ weight


def _dahl(q: FloatArray, presliding: float) -> FloatArray:
    """Return the share of its largest torque that friction has, (n, k): -1 to 1, with memory."""
    share = np.zeros_like(q)
    for i in range(1, len(q)):
        step = (q[i] - q[i - 1]) / presliding
        side = np.sign(step)
        share[i] = side + (share[i - 1] - side) * np.exp(-np.abs(step))
    return share


def _swung(driven: FloatArray, hz: float, damping: float) -> FloatArray:
    """Return what an oscillator is deflected by, m, (n, 3), driven by accelerations m/s²."""
    w = 2.0 * np.pi * hz
    system = (
        np.array([[0.0, 1.0], [-(w**2), -2.0 * damping * w]]),
        np.array([[0.0], [-1.0]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    A, B, C, D, dt = cont2discrete(system, 1.0 / RATE_HZ)
    return np.concatenate([dlsim((A, B, C, D, dt), column)[1] for column in driven.T], axis=1)


def without_dynamics(dynamics: Dynamics) -> Dynamics:
    """Return the same with nothing but the clock."""
    return replace(dynamics, scale=0.0, drift=0.0)
