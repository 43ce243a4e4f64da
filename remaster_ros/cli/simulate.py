"""A session from a known truth, planned and ordered as the planner node does it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.cli.console import progress_bar, say
from remaster_ros.cli.options import integer, names, number
from remaster_ros.errors import InputError
from remaster_ros.kinematics.inverse_kinematics import FREE_JOINTS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import looking_at, quaternion_xyzw, transform
from remaster_ros.session.files import decode_text, read_limited, write_atomically
from remaster_ros.session.reader import URDF_LIMIT, write_session
from remaster_ros.session.workcell import CellRobot, Workcell, config_path, read_cell
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
from remaster_ros.types import FloatArray

TRUTH_FILE = 'truth.json'
# How far a sensor stands from where the cell has it: roughly known places are good to this.
PLACEMENT_STD_M = 0.05
ROLL_RAD = 0.2
SECONDS_PER_CONFIGURATION = 10.0
AMBIENT_C = 20.0
# The arm gets warmer while it works.
WARMING = Warming(kelvin=5.0, time_s=1200.0, start_s=0.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``remaster simulate``."""
    parser.add_argument('out', metavar='OUT', type=Path, help='new session folder')
    parser.add_argument('--cell', default='demo', help='cell file, or a shipped one (demo)')
    parser.add_argument(
        '--robot',
        metavar='NAME|URDF',
        help="lwr4plus, iiwa7, iiwa14, or any URDF file (default: the cell's robot)",
    )
    parser.add_argument('--base-link', metavar='LINK', help='frame R (default: the root link)')
    parser.add_argument('--tip-link', metavar='LINK', help='frame T (default: the only end)')
    parser.add_argument(
        '--poses',
        type=integer(1),
        default=60,
        metavar='N',
        help='candidate poses to fit (default 60; those that cannot be reached are dropped)',
    )
    parser.add_argument(
        '--validation',
        type=integer(0),
        default=60,
        metavar='N',
        help='candidate poses held out (default 60)',
    )
    parser.add_argument(
        '--sensors', type=names, metavar='NAME,…', help="of the cell's sensors (default: all)"
    )
    parser.add_argument(
        '--noise-mm',
        type=number(unit='mm'),
        default=0.1,
        metavar='S',
        help='noise of every point, std per axis (default 0.1)',
    )
    parser.add_argument(
        '--pose-noise-mm',
        type=number(unit='mm'),
        default=0.2,
        metavar='S',
        help='error common to all solutions of a pose, std per axis (default 0.2)',
    )
    parser.add_argument(
        '--outliers',
        type=number(high=1.0),
        default=0.0,
        metavar='SHARE',
        help='share of the observations that are 20 mm off (default 0)',
    )
    parser.add_argument(
        '--offset-std-deg',
        # A joint that is off by more has lost its mastering, or the URDF is another robot's.
        type=number(high=2.0, unit='deg'),
        default=0.3,
        metavar='S',
        help='the true zero-offsets are drawn with this std (default 0.3)',
    )
    parser.add_argument(
        '--effect',
        type=EffectSpec.parse,
        action='append',
        default=[],
        metavar='NAME[@JOINT][:MM]',
        help='hide something else in it, such as backlash@4:0.3, of that size in mm after '
        'offsets, registration and marker are fitted; may be repeated; `random` draws one',
    )


def run(args: argparse.Namespace) -> int:
    """Plan, draw a truth, write the session and the truth."""
    cell = read_cell(args.cell)
    chain = choose_robot(cell, args.robot, args.base_link, args.tip_link)
    choose_sensors(cell, args.sensors)
    # One stream each: less noise, say, leaves the poses and the offsets as they were.
    placement, planning, drawing, hiding = np.random.default_rng(args.seed).spawn(4)
    sensors = {
        name: SimulatedSensor(
            sensor.marker,
            place_sensor(cell, np.array(sensor.rough_position_m), placement),
            args.noise_mm * 1e-3,
            args.pose_noise_mm * 1e-3,
        )
        for name, sensor in cell.sensors.items()
    }
    with progress_bar(args.quiet) as progress:
        progress('planning', 0.0)
        counts = {'optimization': args.poses, 'validation': args.validation}
        places = {name: sensor.T_R_N for name, sensor in sensors.items()}
        tour = plan_tour(chain, cell, places, counts, planning)
        visits = visit(tour, chain)
        progress('measuring', 0.9)
        hidden = _Hidden(chain, sensors, visits, args.effect, hiding)
        session, truth = simulate_session(
            chain,
            cell.urdf_text,
            drawing,
            poses=visits['optimization'],
            validation_poses=visits['validation'],
            sensors=sensors,
            markers={name: np.array(position) for name, position in cell.markers.items()},
            joint_offset_std=np.deg2rad(args.offset_std_deg),
            marker_std_m=cell.marker_std_m,
            outlier_share=args.outliers,
            seconds_per_configuration=SECONDS_PER_CONFIGURATION,
            temperature_c=AMBIENT_C + hidden.round.warming_k,
            seen=hidden.seen if args.effect else None,
        )
        write_session(args.out, session)
        text = json.dumps(truth_to_dict(truth, chain, args.seed, hidden.found), indent=2)
        write_atomically(args.out / TRUTH_FILE, text + '\n')
    say(args.quiet, tour.describe())
    say(args.quiet, f'written: {args.out}, {len(session.measurements)} observations')
    return 0


class _Hidden:
    """What is hidden in a session; drawn when the truth is known, of the size it has there."""

    def __init__(
        self,
        chain: SerialChain,
        sensors: dict[str, SimulatedSensor],
        visits: dict[str, list[FloatArray]],
        requests: list[EffectSpec],
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
    cell: Workcell, robot: str | None, base_link: str | None, tip_link: str | None
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
    truth: SessionTruth, chain: SerialChain, seed: int, hidden: list[tuple[HiddenEffect, float]]
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
