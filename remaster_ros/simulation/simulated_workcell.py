# SPDX-License-Identifier: Apache-2.0
"""Simulated session of a workcell, planned and measured as with the fake devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.tour_order import Tour
from remaster_ros.session.cells.workcell import CellRobot, Workcell, config_path
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.records.reader import URDF_LIMIT
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.simulated_session import DEFAULT_OFFSET_STD, simulate_session
from remaster_ros.simulation.simulated_tour import plan_tour, visit
from remaster_ros.simulation.truth import (
    SessionTruth,
    SimulatedSensor,
    Warming,
    place_sensor,
)
from remaster_ros.types import Session

PLACEMENT_STD_M = 0.05
"""Standard deviation of a sensor's position from its rough place in the cell file, m."""
WARMING = Warming(kelvin=5.0, time_s=1200.0)
"""Warming of the arm during the session."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """Session with no more in it than a recorded one, its truth, and its tour of poses."""

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
    depth_sigma_m: float = 0.0,
    turn_sigma_rad: float | None = None,
    pose_turn_sigma_rad: float = 0.0,
    on_tool: bool = False,
    outlier_share: float = 0.0,
    joint_offset_std: float = DEFAULT_OFFSET_STD,
    effects: Sequence[EffectSpec] = (),
    measuring: Callable[[], object] = lambda: None,
) -> SimulatedRun:
    """Session of a workcell: planned poses, random truth, simulated measurements.

    Parameters
    ----------
    cell, chain
        Workcell and its arm, see `choose_robot`.
    rng
        Source of all randomness.
    poses, validation_poses
        Number of candidate poses; poses that cannot be reached are dropped.
    sigma_m, pose_sigma_m
        Noise of every point, and error common to the solutions of a pose, m per axis.
    depth_sigma_m
        Noise along the line of sight at 1 m, m; it grows with the square of the distance.
    turn_sigma_rad, pose_turn_sigma_rad
        The same two of orientations, rad per axis; without the first none are measured. These and
        the depth noise apply to the sensors that measure poses according to the cell; to all
        sensors if the cell names none.
    on_tool
        Whether all sensors are on the tool and measure targets at their places; otherwise only
        those that the cell has on the tool.
    outlier_share
        Share of the observations that are 20 mm off.
    joint_offset_std
        Standard deviation of the true zero-offsets, rad.
    effects
        Effects of the arm or the sensors.
    measuring
        Called when the planning has ended.

    Raises
    ------
    InputError
        If the inverse kinematics of this robot cannot be solved, it can reach no pose, or a sensor
        cannot measure so.
    """
    moving = {name for name, sensor in cell.sensors.items() if on_tool or sensor.mounted_on}
    posed = {name for name, sensor in cell.sensors.items() if sensor.pose_topic} or {*cell.sensors}
    if turn_sigma_rad is None and (moving or pose_turn_sigma_rad):
        what = 'on the tool' if moving else 'with noise of pose orientations'
        raise InputError(
            f'sensors {what} measure poses; state the noise of an orientation as well '
            '(--orientation-noise-deg, in Python orientation_noise_rad)'
        )
    marker_names = [marker for sensor in cell.sensors.values() for marker in sensor.markers]
    if on_tool and not len(cell.sensors) == len(marker_names) == len(set(marker_names)):
        raise InputError(
            'the marker of a sensor on the tool is its own origin, and it has no other; choose '
            'such sensors (--sensors, in Python sensors)'
        )
    # Separate random streams: other noise, for instance, does not change the poses and offsets.
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
            depth_sigma_m=depth_sigma_m if name in posed else 0.0,
            turn_sigma_rad=turn_sigma_rad if name in posed else None,
            pose_turn_sigma_rad=pose_turn_sigma_rad if name in posed else 0.0,
            on_tool=name in moving,
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
    """Chain of the cell's robot, or of another robot that replaces it in the cell.

    ``robot``: name of a shipped URDF or path of a file, None for the cell's; ``base_link,
    tip_link``: None for those of the cell, or, with another robot, for its URDF's root and only
    end. The cell is changed in place: its robot, and its ``held_joint``, which becomes '' if
    another robot has no such joint or at most six joints. Raises InputError if there is no such
    robot, its URDF is invalid, or it has several ends and none is named.
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
        # The redundant joint in the cell is another robot's: the inverse kinematics choose one.
        cell.held_joint = ''
    return chain


def choose_sensors(cell: Workcell, chosen: tuple[str, ...] | None) -> None:
    """Reduce the cell to the chosen sensors (names, at least one), in place; None leaves all.

    If ``aim_at``, the sensor that poses face, is not chosen, they face the first one chosen.
    Raises InputError if the cell has no such sensor; then nothing is changed.
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
