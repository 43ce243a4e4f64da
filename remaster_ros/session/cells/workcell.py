# SPDX-License-Identifier: Apache-2.0
"""Workcell files (config/cells/*.yaml): the arm, the markers on its tool, the sensors."""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np

from remaster_ros.bounds import Bounds, Triple
from remaster_ros.collection.events import ArmModel
from remaster_ros.collection.plausibility import SMALLEST_M
from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.kinematics.bodies import Body, Shape, box, cylinder, obstacle, sphere
from remaster_ros.kinematics.collision import HALF_STEP_M, CollisionModel, arm_bodies
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_rpy, transform
from remaster_ros.kinematics.urdf_geometry import MeshReader, chain_bodies
from remaster_ros.planning.candidates import (
    LIMIT_MARGIN_RAD,
    LineOfSight,
    PlanningScene,
)
from remaster_ros.planning.expected_sensors import POSE_SIGMA_M, SIGMA_M, ExpectedSensor
from remaster_ros.planning.pose_settings import PoseSettings
from remaster_ros.session.cells.meshes import mesh_reader
from remaster_ros.session.files import URDF_LIMIT, decode_text, read_limited
from remaster_ros.session.yaml_records import YAML_LIMIT, read_yaml, with_line
from remaster_ros.types import FARTHEST_M, FloatArray, SensorKind

if TYPE_CHECKING:
    from remaster_ros.planning.planned_design import DesignSettings

POSE = 'geometry_msgs/msg/PoseStamped'
MESSAGE_TYPES = ('geometry_msgs/msg/PointStamped', POSE, 'mocap4r2_msgs/msg/Markers')
"""Message types of foreign nodes, which `sensors.topic.driver.READERS` reads."""

# Standard deviations: from the resolution of an interferometer to the noise of a depth camera.
NOISE = Bounds(1e-7, 0.05, 'm')
# Viewing angles: the smallest is less than that of any retroreflector or sphere.
VIEW = Bounds(3.5, 180.0, 'degrees')
# Least distance of two markers: twice the smallest error at which a reading counts as another's.
LEAST_APART_M = 2.0 * SMALLEST_M
LAST_MEMBER = 65535
"""Largest number of a marker in its rigid body, which has 16 bits in NatNet."""

ON_TOOL = Bounds(-3.0, 3.0, 'm')
# Prior of marker positions in cells; a session file may have a larger one.
MARKER_STD = Bounds(0.0, 0.02, 'm', above=True)
# Typical radius of the links of arms of 7 to 20 kg.
LINK_RADIUS_M = 0.075
NO_MOTION = (
    'urdf_text', 'file', 'mesh_path', 'confirm', 'poses', 'aim_at', 'held_joint',
    'held_values_deg', 'held_values_m', 'marker_std_m', 'sensors',
)  # fmt: skip
"""Keys that do not affect whether a motion is allowed."""
CLEARANCE = Bounds(HALF_STEP_M, 1.0, 'm', remedy='; half the step of a path check is the least')


KIND_OF_TOPIC: Mapping[str, SensorKind] = {'optitrack': 'camera', 'laser_tracker': 'tracker'}
"""Kinds of the instruments that have a driver of this package, by their first word."""


class CellSensor(msgspec.Struct, forbid_unknown_fields=True):
    """A sensor of a cell file: marker, topic, rough position, viewing angle, expected noise."""

    # Name of the marker that the sensor follows.
    marker: str
    # Topic of its readings (geometry_msgs/PointStamped, sensor frame); relative to the nodes'
    # namespace, unless it begins with ``/``. Further markers have topics ``TOPIC/NAME``; each has
    # a message for every frame in which any marker was seen, NaN if this one was not.
    topic: str
    # Rough position in base_link.
    rough_position_m: Annotated[Triple, Bounds(-FARTHEST_M, FARTHEST_M, 'm')]
    # True for an instrument that measures on request, by this service (std_srvs/Trigger).
    single_shot: bool = False
    measure_service: str = ''
    # Largest angle between the tool's z axis and the line to the sensor with a visible marker.
    max_angle_deg: Annotated[float, VIEW] = 60.0
    # Expected standard deviations per axis: of a reading, of the error common to all readings at a
    # pose, and of the error common to the markers of a frame. Only plans depend on them; a fit
    # estimates the noise.
    noise_m: Annotated[float, NOISE] = SIGMA_M
    pose_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = POSE_SIGMA_M
    frame_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = 0.0
    # Further markers: name -> number in the rigid body. They are measured in the same frame, or,
    # by a `single_shot` sensor, one after another while the arm stands.
    further_markers: dict[str, int] = {}
    # One of `MESSAGE_TYPES`, if `topic` is published by a foreign node.
    message_type: str = ''
    # ``tool`` for a camera on the tool, which measures poses of a fixed board: `marker` is then
    # the camera's origin on the tool, `rough_position_m` the position of the board.
    mounted_on: Literal['', 'tool'] = ''
    # What kind of instrument it is; '' where that is not known but by its topic.
    kind: Literal['', 'camera', 'tracker'] = ''
    # No key of the file: topic of the foreign node, whose readings are published again on `topic`.
    source: str = ''

    def publish_anew(self, name: str) -> None:
        """Set `topic` to NAME/marker, and `source` to the topic of the foreign node that it had.

        A node publishes the readings of `source` again on `topic`. ``name``: of the sensor.
        Nothing happens without a `message_type`.
        """
        if self.message_type:
            self.source, self.topic = self.topic, f'{name}/marker'

    @property
    def known_kind(self) -> SensorKind | None:
        """Kind of the instrument: as stated, else by the driver that publishes its topic.

        Else 'camera' for a sensor on the tool; None if unknown.
        """
        by_topic = KIND_OF_TOPIC.get(self.topic.lstrip('/').partition('/')[0])
        return self.kind or by_topic or ('camera' if self.mounted_on else None)

    @property
    def markers(self) -> tuple[str, ...]:
        """Names of all markers that the sensor measures, the one it follows first."""
        return (self.marker, *self.further_markers)

    @property
    def topics(self) -> dict[str, str]:
        """Topic of each marker's readings, by its name: TOPIC, and TOPIC/NAME for further ones."""
        of_further = {name: f'{self.topic}/{name}' for name in self.further_markers}
        return {self.marker: self.topic, **of_further}

    @property
    def pose_topic(self) -> str:
        """Topic of full poses; '' if the sensor has none.

        The recorder uses it instead of the topic of positions: one message has position and
        orientation.
        """
        return f'{self.topic}/pose' if self.message_type == POSE else ''

    def problem(self, where: str, markers: Mapping[str, Triple]) -> str:
        """First validation error of this sensor, prefixed by its YAML path; '' if valid.

        ``where``: that path; ``markers``: markers of the cell, name -> position in the tool
        frame, m.
        """
        if problem := self._marker_problem(where, markers):
            return problem
        if self.source and not self.message_type:
            return f'{where}.source is no key; write it as topic, and give its message_type'
        if self.message_type and self.message_type not in MESSAGE_TYPES:
            meant = did_you_mean(self.message_type, MESSAGE_TYPES)
            types = ', '.join(MESSAGE_TYPES)
            return f'{where}.message_type is {self.message_type!r}; it can be {types}{meant}'
        if self.message_type and self.single_shot:
            return (
                f'{where}.single_shot is for instruments that measure on request; a topic streams'
            )
        if self.mounted_on and self.message_type != POSE:
            return (
                f'{where}.mounted_on: a sensor on the tool measures how what stands is turned, '
                f'too; its message_type has to be {POSE}'
            )
        return ''

    def _marker_problem(self, where: str, markers: Mapping[str, Triple]) -> str:
        """First validation error of the sensor's markers, prefixed by its YAML path; '' if valid.

        Errors are unknown, repeated or malformed names, numbers within the tracked body that
        are repeated or not from 1 to 65535, and markers closer to each other than
        `LEAST_APART_M`. ``where``: YAML path of the sensor; ``markers``: as of `problem`.
        """
        names = ', '.join(markers)
        if self.marker not in markers:
            meant = did_you_mean(self.marker, markers)
            return f'{where}.marker is {self.marker!r}; markers has {names}{meant}'
        where += '.further_markers'
        for name, number in self.further_markers.items():
            if name not in markers:
                return f'{where} has {name!r}; markers has {names}{did_you_mean(name, markers)}'
            if name == self.marker:
                return f'{where} has {name!r}, which is its marker already; leave it out there'
            if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name):
                return (
                    f'{where}: {name!r} is the end of a topic; name the marker with letters, '
                    'digits and underscores'
                )
            if not 1 <= number <= LAST_MEMBER:
                return f'{where}.{name} is {number}; markers of a body have the numbers 1 to 65535'
            if list(self.further_markers.values()).count(number) > 1:
                return f'{where}: two markers have the number {number}; give each its own'
        for first, second in itertools.combinations(self.markers, 2):
            distance_m = float(np.linalg.norm(np.subtract(markers[first], markers[second])))
            if distance_m < LEAST_APART_M:
                return (
                    f'{where}: {first} and {second} are {1e3 * distance_m:.0f} mm apart; below '
                    f'{1e3 * LEAST_APART_M:.0f} mm one could be taken for the other'
                )
        return ''


class CellRobot(msgspec.Struct, forbid_unknown_fields=True):
    """The arm of a cell; `urdf` is relative to the cell file."""

    urdf: str
    base_link: str | None = None
    tip_link: str | None = None


class CellBox(msgspec.Struct, forbid_unknown_fields=True):
    """An obstacle: a box in base_link, turned by `yaw_deg` about its z axis."""

    center_m: Triple
    size_m: Triple
    yaw_deg: float = 0.0

    def body(self, name: str) -> Body:
        """Return the body for collision checks, in base_link; InputError for an invalid size.

        ``name``: in messages on collisions.
        """
        rotation = matrix_from_rpy(np.array([0.0, 0.0, radians(self.yaw_deg)]))
        return obstacle(name, self.center_m, self.size_m, rotation)


class CellToolBody(msgspec.Struct, forbid_unknown_fields=True):
    """A part of the tool, centred at `center_m` of the tool frame, rotated by `rpy_deg`.

    A box (`size_m`), a cylinder along its z (`radius_m`, `length_m`) or a sphere (`radius_m`).
    """

    center_m: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    size_m: Triple | None = None
    radius_m: float | None = None
    length_m: float | None = None

    def shape(self) -> Shape:
        """Return the shape about its centre: a box, a cylinder or a sphere.

        Raises InputError unless the given sizes are those of exactly one of these, and valid.
        """
        given = (self.size_m is not None, self.radius_m is not None, self.length_m is not None)
        if given == (True, False, False):
            return box(np.array(self.size_m))
        if given == (False, True, True):
            return cylinder(self.radius_m or 0.0, self.length_m or 0.0)
        if given == (False, True, False):
            return sphere(self.radius_m or 0.0)
        raise InputError(
            'give size_m (a box), radius_m and length_m (a cylinder), or radius_m alone (a sphere)'
        )

    def body(self, name: str, chain: SerialChain) -> Body:
        """Return the body for collision checks, fixed to the last joint; InputError as `shape`.

        ``name``: of the body, in messages; ``chain``: arm that carries the tool.
        """
        turn = matrix_from_rpy(np.deg2rad(self.rpy_deg))
        T = chain.T_fixed[-1] @ transform(turn, np.array(self.center_m))
        return Body(name, len(chain), self.shape(), T, 'tool')


class Workcell(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a cell file: arm, markers, sensors, poses and obstacles.

    config/cells/demo.yaml explains each key.
    """

    robot: CellRobot
    markers: Annotated[dict[str, Triple], ON_TOOL]
    sensors: dict[str, CellSensor]
    aim_at: str
    marker_std_m: Annotated[float, MARKER_STD] = 0.5e-3
    held_joint: str | None = ''
    held_values_deg: list[float] | None = []
    held_values_m: list[float] | None = []  # Instead, if the joint is prismatic
    poses: PoseSettings = msgspec.field(default_factory=PoseSettings)
    link_radius_m: Annotated[float, Bounds(0.0, 1.0, 'm', above=True)] = LINK_RADIUS_M
    obstacles: dict[str, CellBox] = {}
    floor_z_m: float | None = 0.0
    tool: dict[str, CellToolBody] = {}
    marker_radius_m: Annotated[float, Bounds(0.0, unit='m', above=True)] = 0.02
    clearance_m: Annotated[float, CLEARANCE] = 0.008
    unknown_offset_deg: Annotated[float, Bounds(0.0, 10.0, 'degrees')] = 1.0
    acceleration_limit_rad_s2: Annotated[float | list[float], Bounds(0.01, 1000.0, 'rad/s²')] = 5.0
    mesh_path: list[str] = []
    # Whether the planner shows its plan and waits for /remaster/confirm before the arm moves.
    confirm: bool = False
    urdf_text: str = ''
    # Path of the cell file; no plan depends on it.
    file: str = ''

    @property
    def sensor_kinds(self) -> dict[str, SensorKind]:
        """Kind ('camera' or 'tracker') of each sensor whose kind is known, by its name."""
        kinds = {name: sensor.known_kind for name, sensor in self.sensors.items()}
        return {name: kind for name, kind in kinds.items() if kind}

    def chain(self) -> SerialChain:
        """Return the arm's kinematic chain; raise InputError if the URDF has no such arm."""
        ends = self.robot.base_link, self.robot.tip_link
        return SerialChain.from_urdf(self.urdf_text, *ends)

    def fingerprint(self) -> str:
        """Return a SHA-256 of everything that a plan depends on, in hexadecimal.

        The path of the file, ``confirm`` and the kinds of sensors are left out.
        """
        plain = msgspec.to_builtins(msgspec.structs.replace(self, file=''))
        del plain['confirm']
        for sensor in plain['sensors'].values():
            del sensor['kind']
        return hashlib.sha256(msgspec.json.encode(plain)).hexdigest()

    def model(self) -> ArmModel:
        """Return checksums of the arm and of everything that a motion is checked against.

        They are equal for copies on two hosts that differ in folders, comments, white space, or
        the order of keys or attributes. Meshes are not part of them.
        """
        urdf = ElementTree.canonicalize(self.urdf_text, strip_text=True)
        plain = msgspec.to_builtins(self)
        for key in NO_MOTION:
            del plain[key]
        del plain['robot']['urdf']
        cell = msgspec.json.encode(plain, order='deterministic')
        return ArmModel(
            urdf=hashlib.sha256(urdf.encode()).hexdigest(),
            cell=hashlib.sha256(cell).hexdigest(),
            urdf_file=str(Path(self.file).parent / self.robot.urdf),
            cell_file=self.file,
        )

    def held(self, chain: SerialChain) -> dict[int, tuple[float, ...]] | None:
        """Return the joint that stays at given values in inverse kinematics: index -> values.

        A dictionary of one entry: index from 0 in ``chain``, and the values to choose from,
        rad or m. None if no joint is held. Raises ValueError if the chain has no such joint.
        """
        if not self.held_joint:
            return None
        index = chain.joint_names.index(self.held_joint)
        if chain.slides[index]:
            return {index: tuple(self.held_values_m or [])}
        return {index: tuple(np.deg2rad(self.held_values_deg or []))}

    def acceleration_limits(self, chain: SerialChain) -> FloatArray:
        """Return each joint's acceleration limit, rad/s² or m/s², (k,).

        A single number in the file is for revolute joints; prismatic ones have
        `SerialChain.per_radian` times as much.
        """
        given = self.acceleration_limit_rad_s2
        return np.array(given) if isinstance(given, list) else given * chain.per_radian

    def collision_model(
        self,
        chain: SerialChain,
        unknown_offset_rad: float | None = None,
        *,
        without_meshes: bool = False,
    ) -> CollisionModel:
        """Return the arm with tool, markers and obstacles, for collision checks.

        Parameters
        ----------
        chain
            The arm of this cell.
        unknown_offset_rad
            Bound of a joint's unknown zero-offset, rad; None for `unknown_offset_deg`.
        without_meshes
            Use capsules instead of meshes, which may then be missing: only for simulated arms.

        Raises
        ------
        InputError
            If a mesh of the URDF is missing or unreadable, or its geometry is invalid.
        """
        folder = Path(self.file).parent
        urdf = folder / self.robot.urdf
        read_mesh: MeshReader = mesh_reader(urdf, [folder / path for path in self.mesh_path])
        if without_meshes:
            read_mesh = _no_mesh
        last = len(chain)
        bodies = chain_bodies(self.urdf_text, chain, read_mesh)
        bodies += [part.body(f'tool {name}', chain) for name, part in self.tool.items()]
        bodies += [box.body(f'obstacle {name}') for name, box in self.obstacles.items()]
        for name, position in self.markers.items():
            T = chain.T_fixed[-1] @ transform(np.eye(3), np.array(position))
            bodies.append(Body(f'marker {name}', last, sphere(self.marker_radius_m), T, 'tool'))
        unknown = radians(self.unknown_offset_deg)
        return CollisionModel(
            chain,
            arm_bodies(chain, bodies, self.link_radius_m),
            floor_z=self.floor_z_m,
            margin=self.clearance_m,
            unknown_offset=unknown if unknown_offset_rad is None else unknown_offset_rad,
            link_radius=self.link_radius_m,
        )

    def planning_scene(
        self,
        chain: SerialChain,
        limit_margin_rad: float = LIMIT_MARGIN_RAD,
        *,
        without_meshes: bool = False,
    ) -> PlanningScene:
        """Return the planning scene of this cell, for poses and their joint solutions.

        ``limit_margin_rad``: distance that solutions keep from joint limits, rad;
        ``without_meshes``, and InputError, as of `collision_model`.
        """
        sights = [
            LineOfSight(
                name,
                np.array(sensor.rough_position_m),
                np.array(self.markers[sensor.marker]),
                radians(sensor.max_angle_deg),
                sensor.marker,
            )
            for name, sensor in self.sensors.items()
        ]
        return PlanningScene(
            InverseKinematics(chain, self.held(chain)),
            self.collision_model(chain, without_meshes=without_meshes),
            self.poses.ranges(),
            sights,
            self.aim_at,
            limit_margin_rad,
        )

    def design_settings(self) -> DesignSettings:
        """Return the settings for the choice of poses, with the expected noise of the sensors."""
        expected = [
            ExpectedSensor(
                name,
                np.array(sensor.rough_position_m),
                {marker: np.array(self.markers[marker]) for marker in sensor.markers},
                sensor.noise_m,
                sensor.pose_noise_m,
                sensor.frame_noise_m,
                sensor.single_shot,
            )
            for name, sensor in self.sensors.items()
        ]
        return self.poses.settings(tuple(expected), self.marker_std_m)


def _no_mesh(name: str) -> None:
    """Return None for any mesh name: the mesh is then left out of collision checks."""


def config_path(name: str) -> Path:
    """Return the path of a shipped configuration file, such as ``cells/demo.yaml``.

    In a source checkout config/ is beside the package; installed, it is package data.

    Raises InputError if the package was installed without it.
    """
    folder = Path(__file__).resolve().parents[3] / 'config'
    if (folder / 'cells').is_dir():
        return folder / name
    spec = importlib.util.find_spec('remaster_ros.config')
    if spec is None or not spec.submodule_search_locations:
        raise InputError('the shipped configuration is missing; install the package again')
    return Path(next(iter(spec.submodule_search_locations))) / name


def read_cell(path: str | Path) -> Workcell:
    """Read and check a cell file; a bare name such as ``demo`` is the shipped cells/demo.yaml.

    A path with an extension, or an existing file, is read itself. Raises InputError, which names
    the file, the key and the remedy.
    """
    path = Path(path)
    if not path.suffix and not path.is_file():
        shipped = config_path(f'cells/{path}.yaml')
        # A folder of that name, as made by `remaster demo --out demo`, is no cell file.
        if shipped.exists() or not path.exists():
            path = shipped
    return parse_cell(read_limited(path, YAML_LIMIT, 'name a cell file'), path)


def parse_cell(data: bytes, path: Path) -> Workcell:
    """Parse and validate the content of a cell file; the URDF that it names is read, too.

    ``path``: of the file, to which the URDF is relative. Raises InputError as `read_cell`.
    """
    cell = read_yaml(data, path, Workcell)
    urdf = path.parent / cell.robot.urdf
    cell.file = str(path)
    for name, sensor in cell.sensors.items():
        sensor.publish_anew(name)
    missing = (
        f'robot.urdf in {path} is {cell.robot.urdf!r}, which is relative to that file; copy the '
        'URDF there, or give its absolute path'
    )
    cell.urdf_text = decode_text(read_limited(urdf.resolve(), URDF_LIMIT, missing), urdf)
    _check(path, cell, decode_text(data, path))
    return cell


def _check(path: Path, cell: Workcell, text: str) -> None:
    """Raise InputError for unknown names and contradictory values, with the line in the file.

    ``text``: of the cell file.
    """
    try:
        chain = cell.chain()
    except InputError as error:
        raise InputError(f'{path.parent / cell.robot.urdf}: {error}') from None
    if problem := _problem(cell, chain):
        raise InputError(f'{path}: {with_line(text, problem)}')


def _problem(cell: Workcell, chain: SerialChain) -> str:
    """First contradiction between the keys of a cell file, with the key; '' if there is none."""
    if cell.held_joint and cell.held_joint not in chain.joint_names:
        names = ', '.join(chain.joint_names)
        meant = did_you_mean(cell.held_joint, chain.joint_names)
        return f'held_joint {cell.held_joint!r} is none of {names}{meant}'
    slides = bool(cell.held_joint) and chain.slides[chain.joint_names.index(cell.held_joint)]
    if cell.held_values_m and not slides:
        return 'held_values_m is for a held_joint that slides; write held_values_deg'
    if cell.held_values_deg and slides:
        return f'held_values_deg are angles, and {cell.held_joint} slides; write held_values_m'
    if slides and not cell.held_values_m:
        return 'held_values_m is empty; give at least one place, m'
    if cell.held_joint and not slides and not cell.held_values_deg:
        return 'held_values_deg is empty; give at least one angle'
    if not cell.sensors:
        return 'sensors is empty; name at least one'
    for name, sensor in cell.sensors.items():
        if problem := sensor.problem(f'sensors.{name}', cell.markers):
            return problem
        used = [other for other, its in cell.sensors.items() if sensor.marker in its.markers]
        if sensor.mounted_on and (used != [name] or sensor.further_markers):
            return (
                f'sensors.{name}.marker: of a sensor on the tool it is its own origin there; give '
                'it one of its own, which no other sensor has, and no further_markers'
            )
    if cell.aim_at not in cell.sensors:
        meant = did_you_mean(cell.aim_at, cell.sensors)
        return f'aim_at {cell.aim_at!r} is none of the sensors {", ".join(cell.sensors)}{meant}'
    if problem := cell.poses.problem():
        return problem
    limits = cell.acceleration_limit_rad_s2
    if isinstance(limits, list) and len(limits) != len(chain):
        return (
            f'acceleration_limit_rad_s2 has {len(limits)} values; give one number, or one for '
            f'each of the {len(chain)} joints'
        )
    # Meshes are checked when they are needed.
    for key, parts in (('obstacles', cell.obstacles), ('tool', cell.tool)):
        for name, part in parts.items():
            try:
                part.body(name) if isinstance(part, CellBox) else part.body(name, chain)
            except InputError as error:
                return f'{key}.{name}: {error}'
    return ''
