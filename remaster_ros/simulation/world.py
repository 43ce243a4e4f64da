# SPDX-License-Identifier: Apache-2.0
"""Hidden World behind all fakes: the true arm, the true sensors, world time.

The fakes run as separate processes. They share one World through a folder that no estimating code
reads: ``world.json`` holds the truth and the clock, ``motion.jsonl`` the trajectories that the
fake robot has begun, a line each. The arm's motion is a closed form of these (see `arm_motion`),
so every process computes the same joint positions at the same world time. A killed fake reads the
folder again and continues.

World time runs `rate` times as fast as the wall clock: a settling time of 3 s is 3 s of world
time. It waits for slow processes, see `world_clock`.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.line_of_sight import LinkCapsules
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.files import write_atomically
from remaster_ros.session.yaml_records import from_plain, to_plain
from remaster_ros.simulation.arm_motion import Motion, ServoPoint
from remaster_ros.simulation.dynamics import CameraTiming, Dynamics, LinkSide
from remaster_ros.simulation.faults import Faults, Numbers, in_outage
from remaster_ros.simulation.hidden_arm import TrueArm
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor
from remaster_ros.simulation.world_clock import WorldClock
from remaster_ros.types import FloatArray

START_S = 100.0
"""World time at the beginning, s; ROS reads a time of 0 as "no time yet"."""
WORLD_FILE = 'world.json'
MOTION_FILE = 'motion.jsonl'


@dataclass(frozen=True, eq=False)
class WorldContent:
    """Content of a World's file: truth, arm, seed, rate and dynamics."""

    truth: SessionTruth  # True arm, markers and sensors
    seed: int  # Seed of everything random
    rate: float  # World time over wall time
    # The nominal arm
    urdf: str
    base_link: str | None
    tip_link: str | None
    start_q: FloatArray  # Reported joint positions at the beginning, rad or m, (k,)
    link_radius_m: float  # Radius of the links that can hide a marker from a sensor
    dynamics: Dynamics | None = None  # None: the encoders see all of the arm's motion


class World:
    """Simulated truth for all fake devices: the true arm in front of the true sensors, and time.

    Made by `create` (the demo) or `open` (a fake); see the module's docstring. A fake sensor
    uses only `now`, `sleep_until`, `kept_up`, `faults`, `marker_in_sensor`, `line_of_sight`,
    `camera`, `warming_k`, `is_moving` and `joint_speed`, so that its tests need no arm.
    """

    def __init__(self, folder: Path, content: WorldContent) -> None:
        self.folder = folder
        self.truth, self.seed, self.rate = content.truth, content.seed, content.rate
        self.clock = WorldClock(folder, content.rate)
        self.chain = SerialChain.from_urdf(content.urdf, content.base_link, content.tip_link)
        self._capsules = LinkCapsules(self.chain, content.link_radius_m)
        self.start_q = content.start_q
        self._motion = Motion(START_S, self.start_q)
        self._wrong = TrueArm(self.chain, self.truth, START_S, self.start_q)
        self.dynamics, self._link = content.dynamics, None
        if content.dynamics is not None:
            offsets = self.truth.joint_offsets
            self._link = LinkSide(self.chain, content.dynamics, offsets, START_S)
        self._faults = Faults(folder)
        self._lines: TextIO | None = None
        self._torn = ''
        self._position = 0
        # The network thread and the streaming thread of a fake both read the World.
        self._lock = threading.Lock()

    @classmethod
    def create(cls, folder: Path, content: WorldContent) -> World:
        """Make a new World and write it into `folder`, in place of any World there.

        The folder is made if missing. World time begins at `START_S`.
        """
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / MOTION_FILE).write_text('')
        WorldClock.create(folder, START_S, time.monotonic())
        # Written atomically and last: other processes wait for this file, and then read it.
        write_atomically(folder / WORLD_FILE, json.dumps(to_plain(content)))
        return cls(folder, content)

    @classmethod
    def open(cls, folder: Path) -> World:
        """Read the World that another process wrote into `folder`; InputError if there is none."""
        try:
            text = (folder / WORLD_FILE).read_text()
        except OSError as error:
            raise InputError(
                f'{folder}: no fake world here ({error.strerror}); `remaster demo` makes one'
            ) from error
        return cls(folder, from_plain(json.loads(text), WorldContent))

    def close(self) -> None:
        """Close the file of motions; any later use opens it again."""
        with self._lock:
            if self._lines is not None:
                # The motions read so far are kept; reading goes on behind them.
                self._position = self._lines.tell()
                self._lines.close()
                self._lines = None

    # Time

    def now(self) -> float:
        """World time, s."""
        return self.clock.now()

    def sleep_until(self, t: float) -> None:
        """Wait until world time t, s; returns at once if it has passed."""
        self.clock.sleep_until(t)

    def kept_up(self, sensor: str, t: float) -> None:
        """Record that the fake of a sensor has done everything due until world time t, s.

        Nothing for a name that is no sensor of the World.
        """
        if sensor in self.truth.sensors:
            self.clock.kept_up(list(self.truth.sensors).index(sensor), t)

    # Motion

    def begin_motion(
        self,
        start_s: float,
        waypoints: Sequence[ServoPoint],
        reference: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """Move the arm along waypoints (reported joint positions), for all processes.

        ``start_s``: world time from which those of the waypoints count; ``reference``: as in
        `Motion.follow`. Appends a line to the file of motions, which every process reads when it
        next looks at the arm.
        """
        now = None if reference is None else [part.tolist() for part in reference]
        with (self.folder / MOTION_FILE).open('a') as file:
            file.write(json.dumps([start_s, to_plain(list(waypoints)), now]) + '\n')

    @property
    def has_moved(self) -> bool:
        """Whether the arm was ever commanded, by any process."""
        return (self.folder / MOTION_FILE).stat().st_size > 0

    def _read_motions(self) -> None:
        """Read the trajectories added to the file since the last call; the arm follows them.

        An incomplete last line is kept until its rest is there.
        """
        if self._lines is None:
            self._lines = (self.folder / MOTION_FILE).open()
            self._lines.seek(self._position)
        while line := self._lines.readline():
            self._torn += line
            if self._torn.endswith('\n'):
                (start_s, points, now), self._torn = json.loads(self._torn), ''
                waypoints = from_plain(points, list[ServoPoint])
                end_s, end = start_s + waypoints[-1].time_s, waypoints[-1].q
                self._wrong.move(start_s, self._motion.at(start_s)[0], end_s, end)
                reference = None if now is None else (np.array(now[0]), np.array(now[1]))
                if self._link is not None:
                    self._link.advance(self._motion, start_s)
                self._motion.follow(start_s, waypoints, reference)

    def reported(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Joint positions (rad or m) and velocities (per s) by the encoders at time t, (k,) each.

        Without noise and lag.
        """
        with self._lock:
            self._read_motions()
            return self._motion.at(t)

    def encoders(self, t: float) -> FloatArray:
        """Joint positions in a report of world time t, s, each late by its joint's lag, (k,)."""
        if self.dynamics is None:
            return self.reported(t)[0]
        late = t - self.dynamics.lag_s
        return np.array([self.reported(at)[0][joint] for joint, at in enumerate(late.tolist())])

    def camera(self, sensor: str) -> CameraTiming | None:
        """Timing of the camera of a sensor; None if a frame is sent at the time that it shows.

        So without dynamics, and for an unknown sensor.
        """
        return None if self.dynamics is None else self.dynamics.cameras.get(sensor)

    def joint_speed(self, t: float) -> float:
        """Largest joint speed at time t, rad/s; 0.25 m/s of a slide count as 1 rad/s."""
        return float(np.max(np.abs(self.reported(t)[1]) / self.chain.per_radian))

    def is_moving(self, t: float) -> bool:
        """Whether any joint moves faster than 0.1 mrad/s at time t."""
        return self.joint_speed(t) > 1e-4

    def faults(self, device: str) -> Numbers:
        """Present faults of the device ('robot' or a sensor), fault -> number; {} without any."""
        return self._faults.of(device)

    # What sensors see

    def marker_in_sensor(self, sensor: str, t: float, marker: str = '') -> FloatArray:
        """Noise-free position of a marker in the sensor's frame at world time t, s, m, (3,).

        ``marker``: name, '' for the first marker of the sensor, which alone the fault
        ``swapped`` shifts. Raises InputError for an unknown sensor.
        """
        seen_by = self._sensor(sensor)
        q, shift = self.reported(t)[0], None
        if self._link is not None:
            with self._lock:
                added, shift = self._link.at(self._motion, t)
            q = q + added
        if self.truth.effects:
            with self._lock:
                marker_N = self._wrong.marker_in_sensor(sensor, t, q, marker)
        else:
            # Without effects the same position, computed several times as fast.
            marker_N = self.truth.without_noise(self.chain, sensor, q, marker)
        if shift is not None:
            marker_N = marker_N + shift @ seen_by.T_R_N[:3, :3]
        faults = self.faults(sensor)
        if not marker:
            marker_N[0] += faults.get('swapped', 0.0)
        marker_N[1] += faults.get('bumped', 0.0)
        return marker_N

    def warming_k(self, t: float) -> float:
        """Temperature at world time t, s, above that of the beginning, K."""
        return float(self.truth.warming.at(np.array(t)))

    def line_of_sight(self, sensor: str, t: float, name: str = '') -> bool:
        """Whether the sensor sees a marker at world time t, s.

        ``name``: of the marker, '' for the first one of the sensor. False if a link is between
        them, beyond the sensor's acceptance angle from the tool's z axis, and with the faults
        ``occluded`` and ``intermittent``. Raises InputError for an unknown sensor.
        """
        true_sensor, faults = self._sensor(sensor), self.faults(sensor)
        if 'occluded' in faults or in_outage(faults.get('intermittent'), t):
            return False
        q = self.reported(t)[0] + self.truth.joint_offsets
        marker, origin = self.truth.markers[name or true_sensor.marker], true_sensor.T_R_N[:3, 3]
        T_R_T = self.chain.forward(q)
        line = origin - transforms.apply(T_R_T, marker)
        cosine = T_R_T[:3, 2] @ line / np.linalg.norm(line)
        if cosine < np.cos(true_sensor.acceptance_rad):
            return False
        return not bool(self._capsules.hides(q, marker, origin))

    def _sensor(self, name: str) -> SimulatedSensor:
        """Simulated sensor by name; InputError with the known names if there is none."""
        try:
            return self.truth.sensors[name]
        except KeyError:
            known = ', '.join(self.truth.sensors)
            raise InputError(f'the fake world has no sensor {name!r}; it has {known}') from None
