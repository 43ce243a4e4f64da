# SPDX-License-Identifier: Apache-2.0
"""A world that the estimating code cannot see and that shares no physics with it.

Its kinematics and gravity are pinocchio's (`hidden_arm`); the effects and the least squares that
measure them are those of the fakes (`remaster_ros.simulation.hidden_effects`, `.world_model`),
which share no code with what estimates either. Only `hidden_tours`, which chooses the
configurations, uses the package's planning, as a real cell does.

A world predicts what every sensor sees of an arm with any effects. `measure` adds noise and
returns the session, with no more in it than a recorded one, and the truth, for the judges alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from worlds.hidden_arm import PinocchioArm

from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.simulation.world_model import Round, WorldModel
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

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
    memory
        Correlation of the new part from one measurement of a sensor to its next, in time order.
    degrees_of_freedom
        The new part has Student's t-distribution, one factor for the three axes, of the same RMS;
        None for a normal one.
    mispaired_share
        Share of the readings that are of the configuration before.
    """

    sigma_m: float = 0.1e-3
    pose_sigma_m: float = 0.0
    depth_ratio: float = 1.0
    range_power: float = 0.0
    outlier_share: float = 0.0
    held_out_outliers: bool = True
    memory: float = 0.0
    degrees_of_freedom: float | None = None
    mispaired_share: float = 0.0

    @property
    def faults(self) -> tuple[str, ...]:
        """What about it no noise model of a calibration has."""
        return tuple(
            fault
            for fault, there in (
                ('memory', self.memory > 0.0),
                ('tails', self.degrees_of_freedom is not None),
                ('pairing', self.mispaired_share > 0.0),
            )
            if there
        )

    def draw(self, sensor: IntArray, rng: np.random.Generator) -> FloatArray:
        """Draw the new part of the rows of these sensors, of RMS 1, (n, 3)."""
        white = rng.standard_normal((len(sensor), 3))
        if self.degrees_of_freedom is not None:
            dof = self.degrees_of_freedom
            white *= np.sqrt((dof - 2.0) / rng.chisquare(dof, (len(sensor), 1)))
        if self.memory > 0.0:
            fresh = np.sqrt(1.0 - self.memory**2)
            for index in np.unique(sensor):
                mine = np.flatnonzero(sensor == index)
                for before, row in pairwise(mine):
                    white[row] = self.memory * white[before] + fresh * white[row]
        return white


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
        Rows with a gross error, those that are paired wrongly among them.
    faults
        See `Noise.faults`.
    """

    effects: tuple[HiddenEffect, ...]
    size_m: tuple[float, ...]
    joint_offsets: FloatArray
    clean: FloatArray
    std: FloatArray
    pose_std: FloatArray
    outliers: IntArray
    faults: tuple[str, ...]


class HiddenWorld(WorldModel):
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
        Draws the offsets (0.3° each), the true markers, the times (10 s and more per
        configuration) and the temperature (a warming by 3 to 10 K and a slow swing).
    marker_std_m
        How far the true markers are from the nominal ones, per axis, m, as the session states it.
    """

    def __init__(
        self,
        urdf: str,
        visits: Visits,
        sensors: Mapping[str, SimulatedSensor],
        markers: Mapping[str, FloatArray],
        rng: np.random.Generator,
        marker_std_m: float = MARKER_STD_M,
    ) -> None:
        m, k = visits.q.shape
        arm = PinocchioArm(urdf)
        # 1.3 mm of what slides.
        size = np.where(arm.slides, 0.25, 1.0) * np.deg2rad(0.3)
        joint_offsets = size * rng.standard_normal(k)
        true_markers = {
            name: position + marker_std_m * rng.standard_normal(3)
            for name, position in markers.items()
        }
        self.urdf, self.visits, self.nominal_markers = urdf, visits, markers
        self.marker_std_m = marker_std_m
        self._came_from = np.concatenate((visits.home[None], visits.q[:-1]))
        travel = np.max(np.abs(visits.q - self._came_from), axis=1) / 0.5
        self.stamp_s = np.cumsum(10.0 + travel + rng.uniform(0.0, 3.0, m))
        since = self.stamp_s - self.stamp_s[0]
        warming = rng.uniform(3.0, 10.0) * (1.0 - np.exp(-since / rng.uniform(1000.0, 4000.0)))
        swing = rng.uniform(0.5, 1.5) * np.sin(2 * np.pi * since / rng.uniform(1500.0, 6000.0))
        self.temperature_c = 21.0 + warming + swing + 0.05 * rng.standard_normal(m)
        super().__init__(
            arm,
            Round(visits.q, visits.home, since, warming + swing),
            sensors,
            true_markers,
            joint_offsets,
        )
        # Rows as recorded: at every configuration one of each sensor.
        self.configuration = np.repeat(np.arange(m), len(sensors))
        self.sensor = np.tile(np.arange(len(sensors)), m)
        names = list(markers)
        follows = [names.index(sensor.marker) for sensor in sensors.values()]
        self.marker = np.tile(follows, m)

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
        position = clean + std * noise.draw(self.sensor, rng) + pose_std * common
        gross = rng.random(n) < noise.outlier_share
        if not noise.held_out_outliers:
            gross &= ~self.visits.is_validation[self.configuration]
        outliers = np.flatnonzero(gross)
        direction = rng.standard_normal((len(outliers), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        position[outliers] += rng.uniform(3e-3, 30e-3, (len(outliers), 1)) * direction
        if noise.mispaired_share > 0.0:
            step = len(self.sensors)
            wrong = np.flatnonzero(rng.random(n) < noise.mispaired_share)
            wrong = wrong[wrong >= step]
            position[wrong] += clean[wrong - step] - clean[wrong]
            outliers = np.union1d(outliers, wrong)
        truth = HiddenTruth(
            effects=tuple(effects),
            size_m=tuple(self.size_m(effect) for effect in effects),
            joint_offsets=self.joint_offsets,
            clean=clean,
            std=std,
            pose_std=pose_std,
            outliers=outliers,
            faults=noise.faults,
        )
        return self._session(position), truth

    def on(self, visits: Visits) -> HiddenWorld:
        """Return the same arm, sensors and markers on other visits, spread over the same time."""
        rng = np.random.default_rng(0)
        other = HiddenWorld(self.urdf, visits, self.sensors, self.nominal_markers, rng)
        m, since = len(visits.q), self.visited.time_s
        time_s = np.linspace(0.0, since[-1], m)
        warming_k = np.interp(time_s, since, self.visited.warming_k)
        other.visited = Round(visits.q, visits.home, time_s, warming_k)
        other.stamp_s = self.stamp_s[0] + time_s
        other.temperature_c = np.interp(time_s, since, self.temperature_c)
        other.joint_offsets, other.markers = self.joint_offsets, self.markers
        other.marker_std_m = self.marker_std_m
        return other

    def without_noise(self, effects: Sequence[HiddenEffect]) -> Session:
        """Return a session of what the sensors would see without noise."""
        return self._session(self.seen(effects))

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
            markers=dict(self.nominal_markers),
            sensors={name: sensor.marker for name, sensor in self.sensors.items()},
            measurements=measurements,
            marker_std_m=self.marker_std_m,
            exit_status='complete',
        )
