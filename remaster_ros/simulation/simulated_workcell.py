"""A simulated session of a workcell: planned, measured and hidden in as the fakes do it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import looking_at, quaternion_xyzw, transform
from remaster_ros.planning.tour_order import Tour
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.reader import URDF_LIMIT
from remaster_ros.session.workcell import CellRobot, Workcell, config_path
from remaster_ros.simulation.effect_sampling import EffectSpec, hide
from remaster_ros.simulation.hidden_arm import ChainArm
from remaster_ros.simulation.hidden_effects import HiddenEffect
from remaster_ros.simulation.offline_tour import plan_tour, visit
from remaster_ros.simulation.session_simulator import (
    SessionTruth,
    SimulatedSensor,
    simulate_session,
)
from remaster_ros.simulation.world_model import Round, StagedSensor, WorldModel
from remaster_ros.simulation.wrong_arm import Warming
from remaster_ros.types import FloatArray, Session

# How far a sensor stands from where the cell has it: roughly known places are good to this.
PLACEMENT_STD_M = 0.05
ROLL_RAD = 0.2
SECONDS_PER_CONFIGURATION = 10.0
AMBIENT_C = 20.0
# The arm gets warmer while it works.
WARMING = Warming(kelvin=5.0, time_s=1200.0, start_s=0.0)


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A simulated session, and all that an estimate of it is to find.

    Attributes
    ----------
    session
        No more than a recorded one has.
    truth
        What it was made from.
    hidden
        What else is wrong, with the RMS of what is left of each after offsets, registration and
        marker are fitted, m.
    tour
        The planned poses.
    """

    session: Session
    truth: SessionTruth
    hidden: tuple[tuple[HiddenEffect, float], ...]
    tour: Tour


def simulate_workcell(
    cell: Workcell,
    chain: SerialChain,
    rng: np.random.Generator,
    *,
    poses: int = 60,
    validation_poses: int = 60,
    sigma_m: float = 0.1e-3,
    pose_sigma_m: float = 0.2e-3,
    outlier_share: float = 0.0,
    joint_offset_std: float = float(np.deg2rad(0.3)),
    effects: Sequence[EffectSpec] = (),
    measuring: Callable[[], object] = lambda: None,
) -> SimulatedRun:
    """Plan in a workcell, draw a truth, and measure.

    Parameters
    ----------
    cell, chain
        The workcell and its arm, see `choose_robot`.
    rng
        Source of all randomness.
    poses, validation_poses
        Candidate poses; those that cannot be reached are dropped.
    sigma_m, pose_sigma_m
        Noise of every point, and error common to the solutions of a pose, m per axis.
    outlier_share
        Share of the observations that are 20 mm off.
    joint_offset_std
        Of the true zero-offsets, rad.
    effects
        What else is wrong with the arm or the sensors.
    measuring
        Called when the planning has ended.

    Raises
    ------
    InputError
        No closed form for this robot, or no pose that it can take.
    """
    # One stream each: less noise, say, leaves the poses and the offsets as they were.
    placement, planning, drawing, hiding = rng.spawn(4)
    sensors = {
        name: SimulatedSensor(
            sensor.marker,
            place_sensor(cell, np.array(sensor.rough_position_m), placement),
            sigma_m,
            pose_sigma_m,
        )
        for name, sensor in cell.sensors.items()
    }
    counts = {'optimization': poses, 'validation': validation_poses}
    places = {name: sensor.T_R_N for name, sensor in sensors.items()}
    tour = plan_tour(chain, cell, places, counts, planning)
    visits = visit(tour, chain)
    measuring()
    hidden = _Hidden(chain, sensors, visits, effects, hiding)
    session, truth = simulate_session(
        chain,
        cell.urdf_text,
        drawing,
        poses=visits['optimization'],
        validation_poses=visits['validation'],
        sensors=sensors,
        markers={name: np.array(position) for name, position in cell.markers.items()},
        joint_offset_std=joint_offset_std,
        marker_std_m=cell.marker_std_m,
        outlier_share=outlier_share,
        seconds_per_configuration=SECONDS_PER_CONFIGURATION,
        temperature_c=AMBIENT_C + hidden.round.warming_k,
        seen=hidden.seen if effects else None,
    )
    return SimulatedRun(session, truth, tuple(hidden.found), tour)


class _Hidden:
    """What is hidden in a session; drawn when the truth is known, of the size it has there."""

    def __init__(
        self,
        chain: SerialChain,
        sensors: dict[str, SimulatedSensor],
        visits: dict[str, list[FloatArray]],
        requests: Sequence[EffectSpec],
        rng: np.random.Generator,
    ) -> None:
        self._chain, self._sensors, self._requests, self._rng = chain, sensors, requests, rng
        q = np.concatenate([*visits['optimization'], *visits['validation']])
        time_s = SECONDS_PER_CONFIGURATION * np.arange(len(q), dtype=float)
        self.round = Round(q, q[0], time_s, WARMING.at(time_s))
        self.found: list[tuple[HiddenEffect, float]] = []

    def seen(self, joint_offsets: FloatArray, markers: dict[str, FloatArray]) -> FloatArray:
        """See the parameter of `simulate_session`; remembers the effects and their sizes, m."""
        staged = {
            name: StagedSensor(sensor.T_R_N[:3, :3], sensor.T_R_N[:3, 3], sensor.marker)
            for name, sensor in self._sensors.items()
        }
        stage = WorldModel(ChainArm(self._chain), self.round, staged, markers, joint_offsets)
        effects = hide(stage, self._requests, self._rng)
        self.found = [(effect, stage.size_m(effect)) for effect in effects]
        return stage.seen(effects).reshape(len(self.round.q), len(staged), 3)


def choose_robot(
    cell: Workcell,
    robot: str | None = None,
    base_link: str | None = None,
    tip_link: str | None = None,
) -> SerialChain:
    """Put another robot into the cell where one is named; return the chain.

    Raises
    ------
    InputError
        No such robot, or a URDF that is none.
    """
    if robot is not None:
        shipped = config_path(f'robots/{robot}.urdf')
        path = shipped if shipped.is_file() else Path(robot)
        known = ', '.join(sorted(file.stem for file in shipped.parent.glob('*.urdf')))
        missing = f'--robot takes a URDF file, or one of {known}'
        cell.urdf_text = decode_text(read_limited(path, URDF_LIMIT, missing), path)
        cell.robot = CellRobot(str(path))
    cell.robot.base_link = base_link or cell.robot.base_link
    cell.robot.tip_link = tip_link or cell.robot.tip_link
    try:
        chain = cell.chain()
    except InputError as error:
        raise InputError(f'{cell.robot.urdf}: {error}') from None
    if robot is not None and (
        len(chain) <= FREE_JOINTS or cell.held_joint not in chain.joint_names
    ):
        # The cell's joint is another robot's: the inverse kinematics then choose by themselves.
        cell.held_joint = ''
    return chain


def choose_sensors(cell: Workcell, chosen: tuple[str, ...] | None) -> None:
    """Leave the chosen sensors in the cell; aim at the first of them if need be.

    Raises
    ------
    InputError
        The cell has no such sensor.
    """
    if chosen is None:
        return
    for name in chosen:
        if name not in cell.sensors:
            raise InputError(
                f'--sensors: no sensor {name!r} in the cell ({", ".join(cell.sensors)})'
            )
    cell.sensors = {name: cell.sensors[name] for name in chosen}
    if cell.aim_at not in chosen:
        cell.aim_at = chosen[0]


def place_sensor(cell: Workcell, rough: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return T_R_N of a sensor near its rough place that looks at the middle of the workspace."""
    position = rough + rng.normal(0.0, PLACEMENT_STD_M, 3)
    middle = (0.0, 0.0, sum(cell.poses.height_m) / 2)
    return transform(looking_at(position, middle, rng.uniform(-ROLL_RAD, ROLL_RAD)), position)


def truth_to_dict(
    truth: SessionTruth,
    chain: SerialChain,
    seed: int,
    hidden: Sequence[tuple[HiddenEffect, float]],
) -> dict[str, Any]:
    """Return everything that an estimate of the session is to find."""
    return {
        'format': 'remaster-truth/1',
        'seed': seed,
        'robot': chain.name,
        'joint_offsets': [
            {'joint': name, 'offset_deg': float(np.rad2deg(offset))}
            for name, offset in zip(chain.joint_names, truth.joint_offsets)
        ],
        'registration': {
            name: {
                'translation_m': sensor.T_R_N[:3, 3].tolist(),
                'rotation_xyzw': quaternion_xyzw(sensor.T_R_N[:3, :3]).tolist(),
            }
            for name, sensor in truth.sensors.items()
        },
        'markers': {
            name: {'position_m': position.tolist()} for name, position in truth.markers.items()
        },
        'noise': {
            name: {'sigma_m': sensor.sigma_m, 'pose_sigma_m': sensor.pose_sigma_m}
            for name, sensor in truth.sensors.items()
        },
        'outliers': list(truth.outliers),
        'effects': [{**effect.to_dict(), 'size_mm': 1e3 * size} for effect, size in hidden],
    }
