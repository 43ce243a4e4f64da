# SPDX-License-Identifier: Apache-2.0
"""An arm and its controller that execute every command; no ROS, times are arguments.

It stands for joint_trajectory_controller and a position-controlled arm: each trajectory is
interpolated from where the arm is (or, in open loop, from where the last trajectory leads now)
to its points, nothing is clamped or refused, and every command is kept with the state from which
it began. The interpolation is written from joint_trajectory_controller's documentation: linear
without velocities, cubic with them, quintic with accelerations too.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from remaster_ros.types import FloatArray

STEP_S = 0.002
"""Step of the servo, s."""
SERVO_RAD_S = 40.0
"""Natural frequency of the critically damped servo, rad/s: it lags by 2 / 40 s."""
BRAKE_S = 0.15
"""How long the arm takes to stop by its own brakes, s."""


@dataclass(frozen=True, eq=False)
class Command:
    """A trajectory as it arrived.

    Attributes
    ----------
    arrival_s
        Monotonic time, s.
    times_s, q, v, a
        Its points: time from start (n,), positions (n, k), and velocities and accelerations
        where it has them.
    start_q, start_v
        Where the interpolation begins: rad, rad/s, (k,).
    obeyed
        False where it was lost on the way, or the arm was in emergency stop.
    emergency
        The arm was in emergency stop.
    foreign
        It came from another node than the bridge.
    begins_s
        Its stamp on the arm's monotonic clock, s; None for at once. Points whose time has passed
        when it arrives are behind it: it goes on between those around that time.
    """

    arrival_s: float
    times_s: FloatArray
    q: FloatArray
    v: FloatArray | None
    a: FloatArray | None
    start_q: FloatArray
    start_v: FloatArray
    obeyed: bool = True
    emergency: bool = False
    foreign: bool = False
    begins_s: float | None = None

    @property
    def zero_s(self) -> float:
        """From when its times count, s."""
        return self.arrival_s if self.begins_s is None else self.begins_s

    @property
    def end_s(self) -> float:
        """When it is over, s."""
        return self.zero_s + float(self.times_s[-1])

    def spline(self) -> Spline:
        """Return what the controller makes of it."""
        k = self.q.shape[1]
        since_s = self.arrival_s - self.zero_s
        if self.times_s[0] > since_s:
            edges = np.concatenate([[since_s], self.times_s])
            q = np.vstack([self.start_q, self.q])
            v = None if self.v is None else np.vstack([self.start_v, self.v])
            a = None if self.a is None or v is None else np.vstack([np.zeros(k), self.a])
        else:
            edges, q, v, a = self.times_s, self.q, self.v, self.a
        pieces = [
            _piece(
                edges[i + 1] - edges[i],
                q[i],
                q[i + 1],
                None if v is None else (v[i], v[i + 1]),
                None if a is None else (a[i], a[i + 1]),
            )
            for i in range(len(q) - 1)
        ]
        return Spline(self.zero_s, edges, pieces, q[-1])


def _piece(
    duration_s: float,
    q0: FloatArray,
    q1: FloatArray,
    v: tuple[FloatArray, FloatArray] | None,
    a: tuple[FloatArray, FloatArray] | None,
) -> FloatArray:
    """Coefficients, lowest power first, (6, k), of the piece between two points."""
    T = max(duration_s, 1e-9)
    gap = q1 - q0
    out = np.zeros((6, len(q0)))
    out[0] = q0
    if v is None:
        out[1] = gap / T
    elif a is None:
        out[1] = v[0]
        out[2] = (3 * gap - (2 * v[0] + v[1]) * T) / T**2
        out[3] = (-2 * gap + (v[0] + v[1]) * T) / T**3
    else:
        out[1], out[2] = v[0], a[0] / 2
        c0 = gap - v[0] * T - a[0] * T**2 / 2
        c1 = v[1] - v[0] - a[0] * T
        c2 = a[1] - a[0]
        out[3] = (10 * c0 - 4 * c1 * T + c2 * T**2 / 2) / T**3
        out[4] = (-15 * c0 + 7 * c1 * T - c2 * T**2) / T**4
        out[5] = (6 * c0 - 3 * c1 * T + c2 * T**2 / 2) / T**5
    return out


def _derivative(coefficients: FloatArray) -> FloatArray:
    return coefficients[1:] * np.arange(1, len(coefficients))[:, None]


class Spline:
    """A reference over time, made of polynomials; its end is held.

    Parameters
    ----------
    begin_s
        Time of its start, s.
    edges_s
        Times of the ends of its pieces from there, the first one 0, s.
    pieces
        Their coefficients, lowest power first, (n, k) each, in the time from their own start.
    end
        Held afterwards, rad, (k,).
    """

    def __init__(
        self, begin_s: float, edges_s: FloatArray, pieces: list[FloatArray], end: FloatArray
    ) -> None:
        self.begin_s, self.edges_s, self.pieces, self.end = begin_s, edges_s, pieces, end

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity at a time, (k,) each."""
        s = max(time_s - self.begin_s, float(self.edges_s[0]))
        index = int(np.searchsorted(self.edges_s, s, side='right')) - 1
        if index >= len(self.pieces):
            return self.end, np.zeros_like(self.end)
        c = self.pieces[index]
        powers = (s - self.edges_s[index]) ** np.arange(len(c))
        return powers @ c, powers[:-1] @ _derivative(c)

    def sample(self, per_piece: int = 60) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, velocities, accelerations along it, (n, k) each, both ends of each piece."""
        out: tuple[list[FloatArray], ...] = ([], [], [])
        for i, c in enumerate(self.pieces):
            s = np.linspace(0.0, self.edges_s[i + 1] - self.edges_s[i], per_piece)
            first, second = _derivative(c), _derivative(_derivative(c))
            for rows, coefficients in zip(out, (c, first, second)):
                rows.append(s[:, None] ** np.arange(len(coefficients)) @ coefficients)
        return np.vstack(out[0]), np.vstack(out[1]), np.vstack(out[2])


def _at_rest(q: FloatArray, time_s: float) -> Spline:
    return Spline(time_s, np.array([0.0]), [], q)


@dataclass
class HostileArm:
    """An arm that obeys everything and keeps it.

    Parameters
    ----------
    q
        Where it stands first, rad, (k,).
    begin_s
        Monotonic time then, s.
    exact
        It is where the controller commands it; else a servo lags a little behind.
    open_loop
        Trajectories begin at the former reference, not at the measured state.
    keeps_stamps
        The controller keeps the stamps of trajectories; else it begins each at once.
    """

    q: FloatArray
    begin_s: float
    exact: bool = False
    open_loop: bool = False
    keeps_stamps: bool = True
    commands: list[Command] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)

    def __post_init__(self) -> None:
        self.q = np.array(self.q, float)
        self.v = np.zeros_like(self.q)
        self.emergency = False
        self.time_s = self.begin_s
        self._reference = _at_rest(self.q.copy(), self.begin_s)
        # Time, position, velocity of every step of about the last minute.
        self.history: deque[tuple[float, FloatArray, FloatArray]] = deque(maxlen=30_000)
        # x - r and v after a step in which r stands: a critically damped second-order servo.
        w, decay = SERVO_RAD_S, np.exp(-SERVO_RAD_S * STEP_S)
        self._step = decay * np.array(
            [[1 + w * STEP_S, STEP_S], [-w * w * STEP_S, 1 - w * STEP_S]]
        )

    def advance(self, now_s: float) -> None:
        """Move on to `now_s`."""
        with self.lock:
            while self.time_s + STEP_S <= now_s:
                self.time_s += STEP_S
                if self.exact or self.emergency:
                    self.q, self.v = self._reference.at(self.time_s)
                else:
                    r, _ = self._reference.at(self.time_s - STEP_S / 2)
                    off, self.v = self._step @ np.array([self.q - r, self.v])
                    self.q = r + off
                self.history.append((self.time_s, self.q, self.v))

    def take(
        self,
        now_s: float,
        times_s: FloatArray,
        q: FloatArray,
        v: FloatArray | None,
        a: FloatArray | None = None,
        lost: bool = False,
        foreign: bool = False,
        begins_s: float | None = None,
    ) -> Command:
        """Obey a trajectory, unless it was lost or the arm is in emergency stop."""
        with self.lock:
            self.advance(now_s)
            start_q, start_v = self.q, self.v
            if self.open_loop:
                start_q, start_v = self._reference.at(now_s)
            obeyed = not (lost or self.emergency or not np.all(np.isfinite(q)))
            begins_s = begins_s if self.keeps_stamps else None
            # What is over when it comes is refused, as joint_trajectory_controller does.
            obeyed = obeyed and (begins_s is None or begins_s + times_s[-1] > now_s)
            command = Command(
                now_s,
                times_s,
                q,
                v,
                a,
                start_q,
                start_v,
                obeyed,
                self.emergency,
                foreign,
                begins_s,
            )
            self.commands.append(command)
            if obeyed:
                self._reference = command.spline()
            return command

    def stop_by_brakes(self, now_s: float) -> None:
        """Begin an emergency stop: the brakes close, the controller is switched off."""
        with self.lock:
            self.advance(now_s)
            braking = np.array([self.q, self.v, -0.5 * self.v / BRAKE_S])
            end = self.q + 0.5 * BRAKE_S * self.v
            self._reference = Spline(now_s, np.array([0.0, BRAKE_S]), [braking], end)
            self.emergency = True

    def release(self, now_s: float) -> None:
        """End the emergency stop: the controller holds where the arm stands."""
        with self.lock:
            self.advance(now_s)
            self._reference = _at_rest(self.q, now_s)
            self.v, self.emergency = np.zeros_like(self.q), False

    def ends_in(self, now_s: float) -> float:
        """Return how long the last command that it obeyed goes on, s."""
        with self.lock:
            obeyed = [command for command in self.commands if command.obeyed]
        return obeyed[-1].end_s - now_s if obeyed else 0.0

    def speed(self) -> float:
        """Speed of the fastest joint now, rad/s."""
        return float(np.max(np.abs(self.v)))

    def fastest(self, since_s: float, limits: FloatArray) -> float:
        """Largest share of the joint speeds `limits` (k,) that the arm reached since then."""
        with self.lock:
            rows = [v for t, _, v in self.history if t >= since_s]
        return float(np.max(np.abs(rows) / limits)) if rows else 0.0
