# SPDX-License-Identifier: Apache-2.0
"""Dynamics of the fake arm: what its encoders do not see while it moves.

The encoders are on the motors' side (`arm_motion`). Between them and the marker::

    friction   the joint is wound up by w f, f Dahl's friction (1968, Aerospace Corp. TOR-0158),
               which turns round within a travel and keeps its side while the arm stands
    inertia    the joint yields by s τ, τ the torque of the moving masses about its axis
    tool       each of its axes is an oscillator that its own acceleration drives

Reports of each joint are late by a lag of its own. A camera shows the middle of an exposure, sends
it later, and has a clock that is faster or slower. Everything here is integrated or differenced
along the motion, and shares no code with what estimates (`calibration.dynamics`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.simulation.arm_motion import Motion
from remaster_ros.types import FloatArray

STEP_S = 4e-3
"""Step of the integration, s: a twentieth of a period of the tool's mode."""
KEPT_S = 1.0
"""Time for which states are kept, s: cameras show the past of some hundredths of a second."""
# Sizes of real machines at a scale of 1.
LAG_STD_S = 0.3e-3
WINDUP_STD_RAD = np.radians(0.003)
TRAVEL_RAD = 3e-4
STIFFNESS_NM_RAD = 12e3
MODE_HZ, MODE_DAMPING = 12.0, 0.05
JITTER_S = 0.05e-3
EXPOSURE_S, LATENCY_S, LARGEST_DRIFT = (1e-3, 5e-3), (3e-3, 20e-3), 5e-5


@dataclass(frozen=True)
class CameraTiming:
    """Exposure, latency and clock drift of a camera's frames."""

    exposure_s: float  # A frame shows its middle, and is stamped with its beginning
    latency_s: float  # From the beginning of the exposure until the frame is sent
    drift: float  # Seconds per second by which the camera's clock is fast

    @property
    def late_s(self) -> float:
        """Time from what a frame shows, the middle of its exposure, until it is sent, s."""
        return self.latency_s - 0.5 * self.exposure_s


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Motion that encoders do not see: lag, friction, elasticity, vibration; timing of cameras."""

    lag_s: FloatArray  # Delay of each joint's reported position, s, (k,)
    windup_rad: FloatArray  # Largest wind-up by friction, rad or m, (k,)
    travel_rad: FloatArray  # Travel within which friction turns round, rad or m, (k,)
    softness: FloatArray  # rad/(N m) or m/N, (k,)
    mode_hz: float
    mode_damping: float
    jitter_s: float  # Standard deviation of the stamps of joint states, s
    cameras: Mapping[str, CameraTiming]  # By sensor

    @classmethod
    def drawn(
        cls, chain: SerialChain, sensors: tuple[str, ...], scale: float, rng: np.random.Generator
    ) -> Dynamics:
        """Random dynamics of an arm, with random timing of a camera for each sensor.

        ``scale``: factor on lags, wind-up and softness, 1 for sizes of real machines. The
        frequency of the arm's vibration is divided by the root of it; infinite for 0. Camera
        timing does not depend on it.
        """
        k = len(chain)
        cameras = {
            name: CameraTiming(
                float(rng.uniform(*EXPOSURE_S)),
                float(rng.uniform(*LATENCY_S)),
                float(rng.uniform(-LARGEST_DRIFT, LARGEST_DRIFT)),
            )
            for name in sensors
        }
        lag = scale * LAG_STD_S * rng.standard_normal(k)
        return cls(
            # Nothing is reported before it was there.
            lag - lag.min(),
            scale * WINDUP_STD_RAD * rng.standard_normal(k) * chain.per_radian,
            TRAVEL_RAD * chain.per_radian,
            scale / STIFFNESS_NM_RAD * rng.uniform(0.5, 1.5, k) * chain.per_radian**2,
            MODE_HZ / np.sqrt(scale) if scale > 0.0 else np.inf,
            MODE_DAMPING,
            JITTER_S,
            cameras,
        )


class LinkSide:
    """Difference between the links of a moving arm and its encoders, over time.

    ``offsets``: true joint angle minus reported one, rad or m, (k,); ``start_s``: time at
    which the arm stands, s.
    """

    def __init__(
        self, chain: SerialChain, dynamics: Dynamics, offsets: FloatArray, start_s: float
    ) -> None:
        self._chain, self._dynamics, self._offsets = chain, dynamics, offsets
        self._done_s, self._share = start_s, np.zeros(len(chain))
        self._last: FloatArray | None = None
        self._swing = np.zeros((2, 3))  # Of the tool's axes: deflection, m, and speed, m/s
        self._free, self._driven = _oscillator(dynamics.mode_hz, dynamics.mode_damping)
        still = (start_s, np.zeros(len(chain)), np.zeros(3))
        self._states: deque[tuple[float, FloatArray, FloatArray]] = deque([still])

    def advance(self, motion: Motion, until_s: float) -> None:
        """Compute the difference along a motion, in steps of `STEP_S`, up to a world time, s.

        Nothing if that time has been reached already.
        """
        count = int(np.ceil((until_s - self._done_s) / STEP_S - 1e-9))
        if count <= 0:
            return
        times = self._done_s + STEP_S * np.arange(1, count + 1)
        around = np.concatenate(([times[0] - STEP_S], times, [times[-1] + STEP_S]))
        reported = np.array([motion.at(t)[0] for t in around])
        angles, dynamics, chain = reported + self._offsets, self._dynamics, self._chain
        frames = chain.frames(angles)
        tool = frames[:, -1] @ chain.T_fixed[-1]
        yields = dynamics.softness * _inertial_torque(chain, frames)
        pushed = _second_difference(tool[:, :3, 3])
        turn = tool[1:-1, :3, :3]
        along = np.einsum('nia,ni->na', turn, pushed)
        last = reported[0] if self._last is None else self._last
        for i, t in enumerate(times.tolist()):
            step = reported[i + 1] - last
            last = reported[i + 1]
            side = np.sign(step)
            kept = np.exp(-np.abs(step) / dynamics.travel_rad)
            self._share = side + (self._share - side) * kept
            self._swing = self._free @ self._swing - np.outer(self._driven, along[i])
            # What friction holds back, the link lacks of the motor's turn.
            added = yields[i] - dynamics.windup_rad * self._share
            self._states.append((t, added, turn[i] @ self._swing[0]))
        self._last, self._done_s = last, float(times[-1])
        while len(self._states) > 2 and self._states[1][0] < self._done_s - KEPT_S:
            self._states.popleft()

    def at(self, motion: Motion, t: float) -> tuple[FloatArray, FloatArray]:
        """Angles to add to the reported ones, (k,), and shift of the tool, (3,), at a time t.

        The angles, rad or m, do not contain ``offsets``; the shift, m, by vibration, is in the
        robot base frame R. Computed along ``motion`` up to world time t if it was not yet, and
        interpolated between steps. For times before the oldest kept step: the values there.
        """
        self.advance(motion, t)
        after = next((i for i, state in enumerate(self._states) if state[0] >= t), -1)
        before_s, added, shift = self._states[max(after - 1, 0)]
        after_s, added_after, shift_after = self._states[after]
        if after_s == before_s:
            return added, shift
        part = min(max((t - before_s) / (after_s - before_s), 0.0), 1.0)
        return added + part * (added_after - added), shift + part * (shift_after - shift)


def _oscillator(hz: float, damping: float) -> tuple[FloatArray, FloatArray]:
    """Matrices A (2, 2) and b (2,) of a step `STEP_S` of a damped oscillator: x becomes A x + b u.

    x: deflection and speed; u: acceleration, constant during the step. ``hz``: natural
    frequency; zeros if it is infinite.
    """
    if not np.isfinite(hz):
        return np.zeros((2, 2)), np.zeros(2)
    w = 2.0 * np.pi * hz
    rates = np.array([[0.0, 1.0, 0.0], [-w * w, -2.0 * damping * w, 1.0], [0.0, 0.0, 0.0]])
    step = expm(STEP_S * rates)
    return step[:2, :2], step[:2, 2]


def _second_difference(values: FloatArray) -> FloatArray:
    """Second time derivative, (n, ...), of n + 2 values in steps of `STEP_S`, at the inner n."""
    found: FloatArray = (values[2:] - 2.0 * values[1:-1] + values[:-2]) / STEP_S**2
    return found


def _inertial_torque(chain: SerialChain, frames: FloatArray) -> FloatArray:
    """Torque of the links' inertia about each joint, N m, or force along it, N, (n, k).

    At the inner n of n + 2 ``frames`` of the joints in the robot base frame R, (n + 2, k, 4,
    4), `STEP_S` apart. The mass of each link is at its centre.
    """
    centers = apply(frames, chain.centers_of_mass)
    force = -chain.masses[:, None] * _second_difference(centers)
    inner, axes = frames[1:-1], chain.axes_in_base(frames)[1:-1]
    torque = np.zeros(inner.shape[:2])
    for joint in range(len(chain)):
        carried = force[:, joint:]
        if chain.slides[joint]:
            total = carried.sum(axis=1)
        else:
            arms = centers[1:-1, joint:] - inner[:, joint, None, :3, 3]
            total = np.cross(arms, carried).sum(axis=1)
        torque[:, joint] = np.sum(axes[:, joint] * total, axis=1)
    return torque
