"""The hidden World behind all fakes: the true arm, the true sensors, world time.

The fakes run as separate processes. They share one World through a folder that no estimating
code ever sees: ``world.yaml`` holds the truth and the clock, ``motion.jsonl`` the trajectories
that the fake robot has begun, a line each. The arm's motion is a closed form of these (see
`motion`), so every process computes the same joint positions at the same world time. A killed fake
reads the folder again and goes on.

World time runs `rate` times as fast as the wall clock: a 3 s settle is 3 s of world time. All
processes of one machine read the same monotonic clock.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, TextIO

import numpy as np
import yaml

from remaster_ros.errors import InputError
from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.line_of_sight import LinkCapsules
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.arm_motion import Motion, ServoPoint
from remaster_ros.simulation.faults import Faults, Numbers, is_out
from remaster_ros.simulation.hidden_effects import HiddenEffect
from remaster_ros.simulation.world_model import StagedSensor
from remaster_ros.simulation.wrong_arm import Warming, WrongArm
from remaster_ros.types import FloatArray

START_S = 100.0
"""World time at the beginning, s; ROS reads a time of 0 as "no time yet"."""
NO_WARMING = Warming(0.0, 1.0, START_S)


class WorldView(Protocol):
    """What a fake sensor may ask the World."""

    def now(self) -> float:
        """World time, s."""

    def sleep(self, seconds: float) -> None:
        """Wait that much world time."""

    def marker_in_sensor(self, sensor: str, t: float) -> FloatArray:
        """True position of the sensor's marker in the sensor's frame at time t, m, (3,)."""

    def is_moving(self, t: float) -> bool:
        """Whether any joint moves at time t."""

    def joint_speed(self, t: float) -> float:
        """Largest joint speed at time t, rad/s."""

    def line_of_sight(self, sensor: str, t: float) -> bool:
        """Whether the sensor sees its marker at time t."""

    def warming_k(self, t: float) -> float:
        """How much warmer than at the beginning it is at time t, K."""

    def faults(self, device: str) -> Numbers:
        """Faults of the device now, see `remaster_ros.simulation.faults`."""


@dataclass(frozen=True)
class SensorTruth:
    """A sensor as it really stands.

    Attributes
    ----------
    T_R_N
        Sensor frame N in the robot base R, (4, 4).
    marker
        True marker position in the tool frame T, m, (3,).
    acceptance_rad
        Largest angle between the tool's z axis and the line to the sensor at which the marker
        is seen, rad (a retroreflector takes about 30 degrees, a sphere more).
    """

    T_R_N: FloatArray
    marker: FloatArray
    acceptance_rad: float


@dataclass(frozen=True)
class WorldTruth:
    """Everything an estimate is to find, and the seed it came from.

    Attributes
    ----------
    joint_offsets
        True joint angle minus reported one, rad, (k,).
    sensors
        Sensor name -> `SensorTruth`.
    repeatability_rad
        Standard deviation with which a joint comes back to a commanded position, rad.
    encoder_rad
        Standard deviation of the noise of a reported joint position, rad.
    warming
        How the arm, and the air around it, warms up.
    effects
        What else is wrong with the arm or the sensors.
    """

    seed: int
    joint_offsets: FloatArray
    sensors: dict[str, SensorTruth]
    repeatability_rad: float = 2e-5
    encoder_rad: float = 2e-6
    warming: Warming = NO_WARMING
    effects: tuple[HiddenEffect, ...] = ()

    @classmethod
    def draw(
        cls,
        seed: int,
        joints: int,
        markers: dict[str, FloatArray],
        marker_std_m: float,
        placements: dict[str, dict[str, Any]],
        offset_std_rad: float = np.deg2rad(0.3),
    ) -> WorldTruth:
        """Draw a truth.

        Parameters
        ----------
        seed
            Of the generator; the same seed gives the same truth.
        joints
            Number of joints k.
        markers
            Sensor name -> nominal position of its marker in T, m.
        marker_std_m
            Standard deviation of a true marker about its nominal position, per axis, m.
        placements
            Sensor name -> `position_m`, `look_at_m` (in R), `acceptance_deg`.
        offset_std_rad
            Standard deviation of a zero-offset, rad.
        """
        rng = np.random.default_rng([seed, 1])
        sensors = {}
        for name, place in placements.items():
            position = np.asarray(place['position_m'], float) + rng.normal(0, 0.03, 3)
            turn = transforms.looking_at(position, place['look_at_m'], rng.uniform(-0.2, 0.2))
            T_R_N = transforms.transform(turn, position)
            marker = np.asarray(markers[name], float) + rng.normal(0, marker_std_m, 3)
            sensors[name] = SensorTruth(T_R_N, marker, np.deg2rad(place['acceptance_deg']))
        joint_offsets = rng.normal(0, offset_std_rad, joints)
        warming = Warming(rng.uniform(2.0, 6.0), rng.uniform(300.0, 1500.0), START_S)
        return cls(seed, joint_offsets, sensors, warming=warming)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for YAML."""
        return {
            'seed': self.seed,
            'joint_offsets_rad': self.joint_offsets.tolist(),
            'repeatability_rad': self.repeatability_rad,
            'encoder_rad': self.encoder_rad,
            'warming': asdict(self.warming),
            'effects': [effect.to_dict() for effect in self.effects],
            'sensors': {
                name: {
                    'T_R_N': s.T_R_N.tolist(),
                    'marker_m': s.marker.tolist(),
                    'acceptance_rad': float(s.acceptance_rad),
                }
                for name, s in self.sensors.items()
            },
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> WorldTruth:
        """Undo `to_dict`."""
        sensors = {
            name: SensorTruth(np.array(s['T_R_N']), np.array(s['marker_m']), s['acceptance_rad'])
            for name, s in data['sensors'].items()
        }
        return cls(
            data['seed'],
            np.array(data['joint_offsets_rad']),
            sensors,
            data['repeatability_rad'],
            data['encoder_rad'],
            Warming(**data['warming']),
            tuple(HiddenEffect.from_dict(effect) for effect in data['effects']),
        )

    def staged(self) -> tuple[dict[str, StagedSensor], dict[str, FloatArray]]:
        """Return sensors and true markers, one of its own for each, as a stage wants them."""
        sensors = {
            name: StagedSensor(s.T_R_N[:3, :3], s.T_R_N[:3, 3], name)
            for name, s in self.sensors.items()
        }
        return sensors, {name: s.marker for name, s in self.sensors.items()}


class World:
    """The true arm in front of the true sensors.

    Make one with `create` (the demo) or `open` (a fake); see the module's text.
    """

    def __init__(self, folder: Path, data: dict[str, Any]) -> None:
        self.folder = folder
        self.truth = WorldTruth.from_dict(data['truth'])
        self.rate = float(data['rate'])
        self._started = float(data['started_monotonic_s'])
        self.chain = SerialChain.from_urdf(data['urdf'], data['base_link'], data['tip_link'])
        self._capsules = LinkCapsules(self.chain, data['link_radius_m'])
        self.start_q = np.array(data['start_q_rad'], float)
        self._motion = Motion(START_S, self.start_q)
        self._wrong = WrongArm(
            self.chain,
            self.truth.joint_offsets,
            *self.truth.staged(),
            self.truth.effects,
            START_S,
            self.start_q,
            self.truth.warming,
        )
        self._faults = Faults(folder)
        self._lines: TextIO | None = None
        self._torn = ''
        self._position = 0
        # A fake asks from its network thread and from its streaming thread.
        self._lock = threading.Lock()

    @classmethod
    def create(
        cls,
        folder: Path,
        truth: WorldTruth,
        *,
        urdf: str,
        base_link: str | None,
        tip_link: str | None,
        rate: float,
        start_q: FloatArray,
        link_radius_m: float,
    ) -> World:
        """Write a new World into `folder`; its time begins now."""
        data = {
            'truth': truth.to_dict(),
            'rate': float(rate),
            'started_monotonic_s': time.monotonic(),
            'urdf': urdf,
            'base_link': base_link,
            'tip_link': tip_link,
            'start_q_rad': np.asarray(start_q, float).tolist(),
            'link_radius_m': float(link_radius_m),
        }
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / 'motion.jsonl').write_text('')
        (folder / 'world.yaml').write_text(yaml.safe_dump(data, sort_keys=False))
        return cls(folder, data)

    @classmethod
    def open(cls, folder: Path) -> World:
        """Open the World that another process wrote.

        Raises
        ------
        InputError
            If there is none.
        """
        try:
            text = (folder / 'world.yaml').read_text()
        except OSError as error:
            raise InputError(
                f'{folder}: no fake world here ({error.strerror}); `remaster demo` makes one'
            ) from error
        return cls(folder, yaml.safe_load(text))

    def close(self) -> None:
        """Close the file of motions; the World can be asked again, which opens it again."""
        with self._lock:
            if self._lines is not None:
                # What has been read stays learned: go on behind it.
                self._position = self._lines.tell()
                self._lines.close()
                self._lines = None

    # Time

    def now(self) -> float:
        """World time, s."""
        return START_S + (time.monotonic() - self._started) * self.rate

    def sleep(self, seconds: float) -> None:
        """Wait that much world time."""
        if seconds > 0:
            time.sleep(seconds / self.rate)

    # Motion

    def begin_motion(self, start_s: float, waypoints: Sequence[ServoPoint]) -> None:
        """Send the arm along waypoints (reported joint positions); every process learns of it."""
        points = [
            [p.time_s, p.q.tolist(), None if p.velocity is None else p.velocity.tolist()]
            for p in waypoints
        ]
        line = json.dumps({'start_s': start_s, 'points': points})
        with (self.folder / 'motion.jsonl').open('a') as file:
            file.write(line + '\n')

    def _learn(self) -> None:
        """Read the trajectories that have been added to the file since the last look."""
        if self._lines is None:
            self._lines = (self.folder / 'motion.jsonl').open()
            self._lines.seek(self._position)
        while line := self._lines.readline():
            self._torn += line
            if self._torn.endswith('\n'):
                trajectory, self._torn = json.loads(self._torn), ''
                waypoints = [
                    ServoPoint(time_s, np.array(q), None if v is None else np.array(v))
                    for time_s, q, v in trajectory['points']
                ]
                start_s = trajectory['start_s']
                end_s, end = start_s + waypoints[-1].time_s, waypoints[-1].q
                self._wrong.move(start_s, self._motion.at(start_s)[0], end_s, end)
                self._motion.follow(start_s, waypoints)

    def reported(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Joint positions (rad) and velocities (rad/s) as the encoders have them, each (k,)."""
        with self._lock:
            self._learn()
            return self._motion.at(t)

    def joint_speed(self, t: float) -> float:
        """Largest joint speed at time t, rad/s."""
        return float(np.max(np.abs(self.reported(t)[1])))

    def is_moving(self, t: float) -> bool:
        """Whether any joint moves faster than 0.1 mrad/s at time t."""
        return self.joint_speed(t) > 1e-4

    def faults(self, device: str) -> Numbers:
        """Faults of the device now, see `remaster_ros.simulation.faults`."""
        return self._faults.of(device)

    # What sensors see

    def marker_in_sensor(self, sensor: str, t: float) -> FloatArray:
        """True position of the sensor's marker in the sensor's frame at time t, m, (3,)."""
        truth = self._sensor(sensor)
        q = self.reported(t)[0]
        if self.truth.effects:
            with self._lock:
                marker_N = self._wrong.marker_in_sensor(sensor, t, q)
        else:
            # The same, without working out what is nothing.
            marker_R = self.chain.positions(q, truth.marker, self.truth.joint_offsets)
            marker_N = transforms.apply(transforms.inverse(truth.T_R_N), marker_R)
        faults = self.faults(sensor)
        marker_N[0] += faults.get('swapped', 0.0)
        marker_N[1] += faults.get('bumped', 0.0)
        return marker_N

    def warming_k(self, t: float) -> float:
        """How much warmer than at the beginning it is at time t, K."""
        return float(self.truth.warming.at(np.array(t)))

    def line_of_sight(self, sensor: str, t: float) -> bool:
        """Whether the sensor sees its marker at time t: turned to it, and no link between."""
        truth, faults = self._sensor(sensor), self.faults(sensor)
        if 'occluded' in faults or is_out(faults.get('intermittent'), t):
            return False
        q = self.reported(t)[0] + self.truth.joint_offsets
        T_R_T = self.chain.forward(q)
        marker_R = transforms.apply(T_R_T, truth.marker)
        line = truth.T_R_N[:3, 3] - marker_R
        cosine = T_R_T[:3, 2] @ line / np.linalg.norm(line)
        if cosine < np.cos(truth.acceptance_rad):
            return False
        return not bool(self._capsules.hides(q, truth.marker, truth.T_R_N[:3, 3]))

    def _sensor(self, name: str) -> SensorTruth:
        try:
            return self.truth.sensors[name]
        except KeyError:
            known = ', '.join(self.truth.sensors)
            raise InputError(f'the fake world has no sensor {name!r}; it has {known}') from None
