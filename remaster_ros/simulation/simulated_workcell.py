"""A simulated session of a workcell, planned and measured as with the fake devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.tour_order import Tour
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.reader import URDF_LIMIT
from remaster_ros.session.workcell import CellRobot, Workcell, config_path
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.offline_tour import plan_tour, visit
from remaster_ros.simulation.session_simulator import DEFAULT_OFFSET_STD, simulate_session
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor, Warming, place_sensor
from remaster_ros.types import Session

PLACEMENT_STD_M = 0.05
"""How far a sensor stands from its place in the cell file, which is known only roughly."""
WARMING = Warming(kelvin=5.0, time_s=1200.0)
"""The arm gets warmer while it works."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A session that has no more in it than a recorded one, what it was made from, its poses."""

    session: Session
    truth: SessionTruth
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
    joint_offset_std: float = DEFAULT_OFFSET_STD,
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
    # One stream each: other noise, for instance, leaves the poses and the offsets as they were.
    placement, planning, drawing, hiding = rng.spawn(4)
    middle = (0.0, 0.0, sum(cell.poses.height_m) / 2)
    sensors = {
        name: SimulatedSensor(
            sensor.marker,
            place_sensor(sensor.rough_position_m, middle, PLACEMENT_STD_M, placement),
            sigma_m,
            pose_sigma_m,
            further=sensor.further_markers,
            frame_sigma_m=sensor.frame_noise_m,
            single_shot=sensor.single_shot,
        )
        for name, sensor in cell.sensors.items()
    }
    counts = {'optimization': poses, 'validation': validation_poses}
    places = {name: sensor.T_R_N for name, sensor in sensors.items()}
    tour = plan_tour(chain, cell, places, counts, planning)
    visits = visit(tour, chain)
    measuring()
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
        warming=WARMING,
        effects=effects,
        effect_rng=hiding,
    )
    return SimulatedRun(session, truth, tour)


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
