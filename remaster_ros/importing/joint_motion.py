# SPDX-License-Identifier: Apache-2.0
"""Joint positions, velocities and accelerations at any time, from a stream of joint states.

Smoothing splines (cubic: Reinsch 1967, Numer. Math. 10) of each stretch without a gap; the
smoothing leaves residuals of the size of the reports' noise: of encoders, their resolution, and
stamps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from remaster_ros.errors import InputError
from remaster_ros.importing.standstills import Stream
from remaster_ros.types import BoolArray, FloatArray

# Lowest rate of joint states that shows accelerations: an arm changes its speed within 0.1 s.
LEAST_RATE_HZ = 40.0
# Longest gap within a stretch, s, or in usual steps.
LONGEST_GAP_S, LONGEST_GAP_STEPS = 0.1, 5.0
# Shortest stretch that shows accelerations, s.
SHORTEST_S = 0.5
# Longest smoothing time h, s: the equivalent kernel of the spline (Silverman 1984, Ann. Stat. 12)
# averages over some 3 h, and an arm's speed changes more slowly.
LONGEST_SMOOTHING_S = 0.04
# Ratio of successive smoothing times that are tried.
SMOOTHING_STEP = 1.4
# Largest number of reports for the choice of the smoothing.
MOST_TRIED = 3_000
# Ratio of scores below which two smoothing times count as equal.
ALIKE = 1.03


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Joint positions as functions of time: smoothing splines over stretches without a gap."""

    begin: FloatArray  # Of each stretch, s, (stretches,)
    end: FloatArray
    splines: tuple[tuple[BSpline, ...], ...]  # Of each stretch, one for each joint
    noise: FloatArray  # Standard deviation of a report about its spline, rad, (k,)
    rate_hz: float  # Of the reports, the median

    @classmethod
    def of(cls, joints: Stream, where: str) -> JointMotion:
        """Smoothing splines of the joint positions in a stream of joint states, rad.

        A gap of over 0.1 s and over five usual steps ends a stretch; stretches of under 0.5 s
        are left out. Raises InputError if the median rate is below 40 Hz (`LEAST_RATE_HZ`), or
        no stretch is long enough. ``where``: name of the recording, for messages.
        """
        stamps, values = _increasing(joints)
        if len(stamps) < 2:
            raise InputError(f'{where}: no joint states with times that increase')
        step = float(np.median(np.diff(stamps)))
        if step * LEAST_RATE_HZ > 1.0:
            raise InputError(
                f'{where}: joint states at {1.0 / step:.0f} Hz; at least {LEAST_RATE_HZ:.0f} Hz '
                'are needed to measure while the arm moves: have the controller report more '
                'often, or import the standstills, without --moving'
            )
        gap = max(LONGEST_GAP_S, LONGEST_GAP_STEPS * step)
        edges = np.flatnonzero(np.diff(stamps) > gap) + 1
        stretches = [
            part
            for part in np.split(np.arange(len(stamps)), edges)
            if stamps[part[-1]] - stamps[part[0]] >= SHORTEST_S
        ]
        if not stretches:
            raise InputError(
                f'{where}: the joint states are interrupted every {SHORTEST_S:g} s or sooner'
            )
        chosen = [_smoothing(stamps, column, step) for column in values.T]
        splines = tuple(
            tuple(
                make_smoothing_spline(stamps[part], column[part], lam=time_s**4 / step)
                for column, (time_s, _) in zip(values.T, chosen, strict=True)
            )
            for part in stretches
        )
        return cls(
            np.array([stamps[part[0]] for part in stretches]),
            np.array([stamps[part[-1]] for part in stretches]),
            splines,
            np.array([noise for _, noise in chosen]),
            1.0 / step,
        )

    def stretch(self, times: FloatArray) -> FloatArray:
        """Index, from 0, of the stretch that contains each time, (n,); -1 for times outside all.

        ``times``: s, (n,).
        """
        index = np.searchsorted(self.begin, times, side='right') - 1
        inside = (index >= 0) & (times <= self.end[np.maximum(index, 0)])
        return np.where(inside, index, -1)

    def at(self, times: FloatArray, derivative: int = 0) -> FloatArray:
        """Joint positions, rad, at n times, (n, k); NaN at times outside all stretches.

        ``times``: s, (n,); ``derivative``: 1 or 2 for velocities, rad/s, or accelerations,
        rad/s².
        """
        stretch = self.stretch(times)
        result = np.full((len(times), len(self.noise)), np.nan)
        for index, splines in enumerate(self.splines):
            in_stretch = stretch == index
            if in_stretch.any():
                result[in_stretch] = np.stack(
                    [s(times[in_stretch], derivative) for s in splines], axis=1
                )
        return result


def _increasing(joints: Stream) -> tuple[FloatArray, FloatArray]:
    """Stamps, s, (m,), and values, (m, k), of reports with increasing stamps.

    Reports within 1 µs of the one before are left out.
    """
    kept: BoolArray = np.diff(joints.stamps, prepend=-np.inf) > 1e-6
    return joints.stamps[kept], joints.values[kept]


def _smoothing(stamps: FloatArray, values: FloatArray, step: float) -> tuple[float, float]:
    """Smoothing time of a joint's spline, s, and the standard deviation of its reports, rad.

    The longest time whose score of generalised cross-validation (Craven & Wahba 1979, Numer.
    Math. 31) is within 3 % of the least; the residuals are then noise. By the 3,000 reports at
    most in which the joint moves most. ``values``: of one joint, rad, (n,); ``step``: median
    step of ``stamps``, s.
    """
    moved = np.abs(np.diff(values, prepend=values[0]))
    middle = int(np.argmax(np.convolve(moved, np.ones(min(MOST_TRIED, len(moved))), 'same')))
    first = max(0, min(middle - MOST_TRIED // 2, len(values) - MOST_TRIED))
    times, places = stamps[first : first + MOST_TRIED], values[first : first + MOST_TRIED]
    tried = []
    time_s = 0.5 * step
    while time_s <= LONGEST_SMOOTHING_S:
        spline = make_smoothing_spline(times, places, lam=time_s**4 / step)
        # The middle of the equivalent kernel, times the step.
        leverage = min(0.9, step / (2.0 * np.sqrt(2.0) * time_s))
        square = float(np.mean((places - spline(times))[10:-10] ** 2))
        tried.append((square / (1.0 - leverage) ** 2, time_s, np.sqrt(square / (1.0 - leverage))))
        time_s *= SMOOTHING_STEP
    least = min(score for score, _, _ in tried)
    _, time_s, noise = max(
        (trial for trial in tried if trial[0] <= ALIKE * max(least, 1e-20)),
        key=lambda trial: trial[1],
    )
    return time_s, float(noise)
