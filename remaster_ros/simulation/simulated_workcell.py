# SPDX-License-Identifier: Apache-2.0
"""Simulated session of a workcell, planned and measured as with the fake devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.planned_design import designed_plans
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.cells.workcell import CellRobot, Workcell, config_path
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.records.reader import URDF_LIMIT
from remaster_ros.simulation.effect_sampling import EffectSpec, with_effects
from remaster_ros.simulation.hidden_arm import SECONDS_PER_CONFIGURATION, model_of_tour
from remaster_ros.simulation.truth import (
    SessionTruth,
    SimulatedSensor,
    Warming,
    mount_body,
    place_sensor,
)
from remaster_ros.types import FloatArray, Measurements, Session

# A tour of a cell, planned and ordered as the planner node does it, all at once.


def plan_tour(
    chain: SerialChain,
    cell: Workcell,
    places: Mapping[str, FloatArray] | None,
    counts: Mapping[str, int],
    rng: np.random.Generator,
    *,
    without_meshes: bool = True,
) -> Tour:
    """Tour of poses that face one sensor and are visible to all, for every split with a count.

    Parameters
    ----------
    chain, cell
        Arm and workcell.
    places
        T_R_N of every sensor that has to see its marker, (4, 4); None for the cell's rough places.
    counts
        Split -> number of candidate poses.
    rng
        Source of randomness.
    without_meshes
        Whether capsules are used in place of meshes: a simulated arm can hurt no one, and its
        meshes may be on another machine.

    Raises
    ------
    InputError
        If the inverse kinematics of this robot cannot be solved, or it can reach no pose to fit.
    """
    if not counts.get('optimization'):
        raise InputError('no pose to fit is asked for; give at least one')
    scene = cell.planning_scene(chain, without_meshes=without_meshes)
    sensors_R = scene.rough_R
    if places is not None:
        sensors_R = {name: T_R_N[:3, 3] for name, T_R_N in places.items()}
    plans = {split: scene.plan(n, sensors_R, rng) for split, n in counts.items() if n}
    settings = cell.design_settings()
    if settings.optimal and plans['optimization'].poses:
        travel = TravelTime.of(scene.model, acceleration=cell.acceleration_limits(chain))
        plans = dict(designed_plans(scene, settings, plans, sensors_R, travel, rng).plans)
    tour = Tour(chain, plans)
    if not tour.poses['optimization']:
        raise InputError(
            f'{tour.describe()}: no pose is left to fit; give more --poses, or a --cell with '
            'ranges of poses that suit this robot'
        )
    return tour


def visit(tour: Tour, chain: SerialChain) -> dict[str, list[FloatArray]]:
    """Joint solutions, (m, k) per pose, of each split in the order of the visits.

    Keys are 'optimization' and 'validation', [] without poses. A simulated session begins at the
    position within the limits nearest to zero and goes from one split to the other, each nearest
    first.
    """
    visits: dict[str, list[FloatArray]] = {'optimization': [], 'validation': []}
    q = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
    for split, plan in tour.plans.items():
        part = Tour(chain, {split: plan})
        while (visit_of_pose := part.next(q)) is not None:
            visits[split].append(visit_of_pose.solutions)
            q = visit_of_pose.solutions[-1]
    return visits


# A session from a known truth: for users, for quick checks, for calibration studies.
#
# Poses come in as joint solutions; nothing is planned here. The truth is returned in a record of
# its own, which no estimator takes.


DEFAULT_OFFSET_STD = np.radians(0.3)
AMBIENT_C = 20.0


def simulate_session(
    chain: SerialChain,
    urdf: str,
    rng: np.random.Generator,
    *,
    poses: Sequence[FloatArray],
    sensors: Mapping[str, SimulatedSensor],
    markers: Mapping[str, FloatArray],
    validation_poses: Sequence[FloatArray] = (),
    joint_offsets: FloatArray | None = None,
    joint_offset_std: float = DEFAULT_OFFSET_STD,
    marker_std_m: float = 0.5e-3,
    outlier_share: float = 0.0,
    outlier_m: float = 0.02,
    warming: Warming | None = None,
    effects: Sequence[EffectSpec] = (),
    effect_rng: np.random.Generator | None = None,
) -> tuple[Session, SessionTruth]:
    """Session of a robot with random truth that visits the poses, with noise.

    ``chain, urdf``: nominal robot with k joints, and its URDF text; ``poses, validation_poses``:
    for each pose its joint solutions in the order visited, rad, (m, k); ``sensors``: by name; at
    every configuration each gives an observation of each of its markers, from one frame;
    ``markers``: nominal positions in the tool frame, m, (3,); true positions have the standard
    deviation ``marker_std_m``; ``joint_offsets``: true zero-offsets, rad or m, (k,), or None for
    draws from N(0, ``joint_offset_std``²), times `SerialChain.per_radian` for a joint that slides;
    ``outlier_share``: share of the observations shifted by ``outlier_m`` in a random direction;
    ``warming``: of the arm, measured as well, or None if no temperature is measured; ``effects,
    effect_rng``: effects of the arm or the sensors, and their source of randomness.

    Returns the session, with no more in it than a recorded one, and its truth. Raises InputError
    if solutions have a wrong shape, there are no poses, a sensor follows an unknown marker, or the
    arm cannot show an effect.
    """
    for name, sensor in sensors.items():
        for marker in sensor.markers:
            if marker not in markers:
                raise InputError(f"sensor '{name}' follows marker '{marker}', which is none")
    solutions = [np.atleast_2d(np.asarray(q, dtype=float)) for q in (*poses, *validation_poses)]
    if not sensors or not solutions or any(q.shape[-1] != len(chain) for q in solutions):
        raise InputError(
            f'nothing to simulate: at least one sensor and one pose with {len(chain)} joints each'
        )
    if joint_offsets is None:
        joint_offsets = joint_offset_std * chain.per_radian * rng.standard_normal(len(chain))
    nominal = {name: np.asarray(position, dtype=float) for name, position in markers.items()}
    true_markers = {
        name: position + marker_std_m * rng.standard_normal(3)
        for name, position in nominal.items()
    }
    truth = SessionTruth(
        np.asarray(joint_offsets, dtype=float), true_markers, dict(sensors), warming or Warming()
    )
    q = np.concatenate(solutions)
    model = model_of_tour(chain, truth, q)
    truth = with_effects(truth, model, effects, effect_rng or rng)
    seen_by = [s for s, sensor in enumerate(sensors.values()) for _ in sensor.markers]
    points = model.seen(truth.effects).reshape(len(q), len(seen_by), 3)

    pose = np.repeat(np.arange(len(solutions)), [len(part) for part in solutions])
    for s, sensor in enumerate(sensors.values()):
        common = sensor.pose_sigma_m * rng.standard_normal((len(solutions), 3))
        for place in np.flatnonzero(np.equal(seen_by, s)):
            points[:, place] += common[pose] + sensor.sigma_m * rng.standard_normal((len(q), 3))
        if sensor.further and not sensor.single_shot:
            shared = sensor.frame_sigma_m * rng.standard_normal((len(q), 1, 3))
            points[:, np.equal(seen_by, s)] += shared
    # Row order as recorded: configuration by configuration, sensor by sensor, marker by marker.
    position = points.reshape(-1, 3)
    gross = np.flatnonzero(rng.random(len(position)) < outlier_share)
    direction = rng.standard_normal((len(gross), 3))
    position[gross] += outlier_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # Drawn last, so that sessions of sensors without these errors do not change.
    bodies = {
        sensor.marker: mount_body(rng)
        for sensor in sensors.values()
        if sensor.turn_sigma_rad is not None
    }
    orientation = np.full((len(position), 4), np.nan)
    for s, sensor in enumerate(sensors.values()):
        if sensor.depth_sigma_m:
            selection = np.tile(np.equal(seen_by, s), len(q))
            distance = np.linalg.norm(position[selection], axis=1, keepdims=True)
            error = sensor.depth_sigma_m * rng.standard_normal((len(distance), 1))
            position[selection] += error * distance * position[selection]
        if sensor.turn_sigma_rad is not None:
            first = slice(seen_by.index(s), None, len(seen_by))
            common = sensor.pose_turn_sigma_rad * rng.standard_normal((len(solutions), 3))
            error = common[pose] + sensor.turn_sigma_rad * rng.standard_normal((len(q), 3))
            turn = Rotation.from_rotvec(error)
            true = model.tool_seen(truth.effects)[:, s] @ bodies[sensor.marker]
            orientation[first] = (turn * Rotation.from_matrix(true)).as_quat()
            if sensor.on_tool:
                # The sensor measures the position of its target in its own frame, which is turned.
                position[first] = turn.apply(position[first])

    n, names = len(position), list(markers)
    row = np.repeat(np.arange(len(q)), len(seen_by))
    several = len(seen_by) > len(sensors)
    one_by_one = [sensor.single_shot for sensor in sensors.values()]
    frame = np.where(np.tile(np.array(one_by_one)[seen_by], len(q)), -1, row)
    came_from = np.concatenate((np.full((1, len(chain)), np.nan), q[:-1]))
    measurements = Measurements(
        observation=np.arange(n),
        pose=pose[row],
        configuration=row,
        is_validation=pose[row] >= len(poses),
        stamp_s=np.asarray(SECONDS_PER_CONFIGURATION * (1.0 + row), dtype=float),
        sensor=np.tile(seen_by, len(q)),
        marker=np.tile(
            [names.index(marker) for sensor in sensors.values() for marker in sensor.markers],
            len(q),
        ),
        q=q[row],
        from_q=came_from[row],
        position=position,
        # A simulated session has neither dwell statistics nor torques.
        std=np.full((n, 3), np.nan),
        samples=np.full(n, -1, dtype=np.int64),
        temperature_c=(
            np.full(n, np.nan) if warming is None else AMBIENT_C + model.visited.warming_k[row]
        ),
        frame=frame if several else None,
        orientation=orientation if bodies else None,
    )
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers=nominal,
        sensors={name: sensor.marker for name, sensor in sensors.items()},
        further_markers={
            name: tuple(sensor.further) for name, sensor in sensors.items() if sensor.further
        },
        measurements=measurements,
        marker_std_m=marker_std_m,
        oriented=frozenset(n for n, x in sensors.items() if x.turn_sigma_rad is not None),
        on_tool=frozenset(n for n, x in sensors.items() if x.on_tool),
        exit_status='complete',
        notes='simulated',
    )
    return session, replace(truth, outliers=tuple(gross.tolist()), bodies=bodies)


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
    tip_link``: None for those of the cell. Changes the cell. Raises InputError if there is no such
    robot, or its URDF is invalid.
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
    """Reduce the cell to the chosen sensors, in place; if need be, poses face the first of them.

    None leaves all. Raises InputError if the cell has no such sensor.
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
