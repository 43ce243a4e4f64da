# SPDX-License-Identifier: Apache-2.0
"""Workcell files (config/cells/*.yaml): the arm, the markers on its tool, the sensors."""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from math import degrees, pi, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np

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
    PoseRanges,
)
from remaster_ros.planning.expected_sensors import POSE_SIGMA_M, SIGMA_M, ExpectedSensor, ToolBox
from remaster_ros.session.files import URDF_LIMIT, decode_text, read_limited
from remaster_ros.session.meshes import mesh_reader
from remaster_ros.session.yaml_records import YAML_LIMIT, Bounds, Triple, read_yaml, with_line
from remaster_ros.types import FARTHEST_M, FloatArray

if TYPE_CHECKING:
    from remaster_ros.collection.stopping_rule import StoppingGoal
    from remaster_ros.planning.planned_design import DesignSettings

POSE = 'geometry_msgs/msg/PoseStamped'
MESSAGE_TYPES = ('geometry_msgs/msg/PointStamped', POSE, 'mocap4r2_msgs/msg/Markers')
"""`sensors.topic.driver.READERS` reads them."""


# From the resolution of an interferometer to a depth camera's noise.
NOISE = Bounds(1e-7, 0.05, 'm')
# A retroreflector or sphere is seen from further round than this.
VIEW = Bounds(3.5, 180.0, 'degrees')
# Twice what a reading may at least be off before it counts as that of another marker.
LEAST_APART_M = 2.0 * SMALLEST_M
LAST_MEMBER = 65535
"""The wire has 16 bits for the number of a marker in its rigid body."""


class CellSensor(msgspec.Struct, forbid_unknown_fields=True):
    """A sensor of a cell."""

    # The marker it follows.
    marker: str
    # Where its readings are published (geometry_msgs/PointStamped, sensor frame); relative to the
    # nodes' namespace, unless it begins with ``/``. Further markers have topics of their own below
    # it, ``TOPIC/NAME``; each has a message for every frame in which one of them was seen, NaN
    # where this one was not.
    topic: str
    # Where it stands in the robot base, roughly.
    rough_position_m: Annotated[Triple, Bounds(-FARTHEST_M, FARTHEST_M, 'm')]
    # True for an instrument that measures on request, by this service (std_srvs/Trigger).
    single_shot: bool = False
    measure_service: str = ''
    # Between the tool's z axis and the line to the sensor, at most, where the marker is seen.
    max_angle_deg: Annotated[float, VIEW] = 60.0
    # Standard deviations per axis that are expected: of a reading, of the error that all readings
    # at one pose share, and of the one that the markers of one frame share. Only plans depend on
    # them; a fit estimates its own.
    noise_m: Annotated[float, NOISE] = SIGMA_M
    pose_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = POSE_SIGMA_M
    frame_noise_m: Annotated[float, Bounds(0.0, 0.05, 'm')] = 0.0
    # By name: in the same frame, each with its number in the rigid body; or, where it is
    # `single_shot`, one after another while the arm stands.
    further_markers: dict[str, int] = {}
    # One of `MESSAGE_TYPES`, where `topic` is of a node that is not of this package.
    message_type: str = ''
    # ``tool`` for a camera on the tool, whose poses are those of a board that stands: `marker` is
    # its own origin on the tool, `rough_position_m` where the board is.
    mounted_on: Literal['', 'tool'] = ''
    # No key of the file: the topic of such a node, whose readings are published on `topic` anew.
    source: str = ''

    def publish_anew(self, name: str) -> None:
        """Read the topic of a node that is not of this package; publish it as others are."""
        if self.message_type:
            self.source, self.topic = self.topic, f'{name}/marker'

    @property
    def markers(self) -> tuple[str, ...]:
        """Every marker that it measures, the one it follows first."""
        return (self.marker, *self.further_markers)

    @property
    def topics(self) -> dict[str, str]:
        """Marker -> where its readings are published."""
        further = {name: f'{self.topic}/{name}' for name in self.further_markers}
        return {self.marker: self.topic, **further}

    @property
    def pose_topic(self) -> str:
        """Where its full poses are published beside the positions; '' where it has none.

        The recorder takes these: position and orientation then come in one message.
        """
        return f'{self.topic}/pose' if self.message_type == POSE else ''

    def problem(self, where: str, markers: Mapping[str, Triple]) -> str:
        """Return what is wrong with it, being at `where` in the file; '' where nothing is."""
        if problem := self._marker_problem(where, markers):
            return problem
        if self.source and not self.message_type:
            return f'{where}.source is no key; write it as topic, and give its message_type'
        if self.message_type and self.message_type not in MESSAGE_TYPES:
            meant = did_you_mean(self.message_type, MESSAGE_TYPES)
            known = ', '.join(MESSAGE_TYPES)
            return f'{where}.message_type is {self.message_type!r}; it can be {known}{meant}'
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
        known = ', '.join(markers)
        if self.marker not in markers:
            meant = did_you_mean(self.marker, markers)
            return f'{where}.marker is {self.marker!r}; markers has {known}{meant}'
        where += '.further_markers'
        for name, number in self.further_markers.items():
            if name not in markers:
                return f'{where} has {name!r}; markers has {known}{did_you_mean(name, markers)}'
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
        for one, other in itertools.combinations(self.markers, 2):
            apart = float(np.linalg.norm(np.subtract(markers[one], markers[other])))
            if apart < LEAST_APART_M:
                return (
                    f'{where}: {one} and {other} are {1e3 * apart:.0f} mm apart; below '
                    f'{1e3 * LEAST_APART_M:.0f} mm one could be taken for the other'
                )
        return ''


Range = tuple[float, float]
# No arm or tool of those that this is for reaches so far.
REACH = Bounds(-10.0, 10.0, 'm')
LATIN_HYPERCUBE, OPTIMAL = 'latin_hypercube', 'optimal'
NEAREST, FASTEST = 'nearest', 'fastest'
ALL, CHOSEN = 'all', 'chosen'
RANGES = ('azimuth_deg', 'radius_m', 'height_m', 'roll_deg')


class CellToolBox(msgspec.Struct, forbid_unknown_fields=True):
    """Where the tool is to be accurate: a box in base_link."""

    center_m: Triple
    size_m: Annotated[Triple, Bounds(0.0, 20.0, 'm', above=True)]


class CellPoses(msgspec.Struct, forbid_unknown_fields=True):
    """Ranges of the Latin hypercube of poses, which of them are visited, and in which order."""

    azimuth_deg: Range = (0.0, 360.0)
    radius_m: Annotated[Range, Bounds(0.0, 10.0, 'm')] = (0.2, 0.5)
    height_m: Annotated[Range, REACH] = (0.4, 0.8)
    roll_deg: Range = (0.0, 360.0)
    # `OPTIMAL` for the poses that tell the most, `LATIN_HYPERCUBE` for all of its poses.
    design: str = OPTIMAL
    # `ALL` for each pose in all its free joint solutions, nearest first; `CHOSEN` for the
    # configurations that take the fewest minutes, a pose again where that is shorter.
    solutions: str = ALL
    # `NEAREST` for the nearest pose next, `FASTEST` for the least travel.
    order: str = NEAREST
    # 0 for the joint offsets alone, 1 for the tool's error alone, between them for a mixture.
    tool_share: Annotated[float, Bounds(0.0, 1.0)] = 0.0
    # What is to be reached: an optimal design is made for it (without, for what the Latin
    # hypercube reaches, of the joints no less than 0.005 degrees), and a collection ends where it
    # is known to be.
    joint_std_deg: Annotated[float | None, Bounds(0.0, 5.0, 'degrees', above=True)] = None
    tool_std_m: Annotated[float | None, Bounds(0.0, 0.1, 'm', above=True)] = None
    # Where the tool's error counts; without, at all candidate poses.
    tool_box: CellToolBox | None = None

    def ranges(self) -> PoseRanges:
        """Return the ranges in SI units."""
        return PoseRanges(
            azimuth_rad=(radians(self.azimuth_deg[0]), radians(self.azimuth_deg[1])),
            radius_m=self.radius_m,
            height_m=self.height_m,
            roll_rad=(radians(self.roll_deg[0]), radians(self.roll_deg[1])),
        )

    def settings(self, sensors: tuple[ExpectedSensor, ...], marker_std_m: float) -> DesignSettings:
        """Return what the design is chosen by, in SI units."""
        # Here and below: most nodes read a cell and plan nothing.
        from remaster_ros.planning.planned_design import DesignSettings

        box = self.tool_box
        return DesignSettings(
            optimal=self.design == OPTIMAL,
            whole_poses=self.solutions == ALL,
            fastest=self.order == FASTEST,
            sensors=sensors,
            marker_std_m=marker_std_m,
            tool_share=self.tool_share,
            joint_std_rad=None if self.joint_std_deg is None else radians(self.joint_std_deg),
            tool_std_m=self.tool_std_m,
            box=None if box is None else ToolBox(np.array(box.center_m), np.array(box.size_m)),
        )

    def stopping_goal(self) -> StoppingGoal:
        """Return what ends a collection, in SI units: all that counts, where it is stated."""
        from remaster_ros.collection.stopping_rule import StoppingGoal

        optimal, stated = self.design == OPTIMAL, (self.joint_std_deg, self.tool_std_m)
        counts = (self.tool_share < 1.0, self.tool_share > 0.0)
        if optimal and any(one and value is None for one, value in zip(counts, stated)):
            # The design is made for what the Latin hypercube reaches, which no one has stated.
            return StoppingGoal()
        settings = self.settings((), 0.0)
        return StoppingGoal(settings.joint_std_rad, settings.tool_std_m, settings.box)

    def given(self) -> Mapping[str, object]:
        """Return the keys beside the ranges that are not as by default."""
        plain = CellPoses()
        return {
            key: getattr(self, key)
            for key in self.__struct_fields__
            if key not in RANGES and getattr(self, key) != getattr(plain, key)
        }

    def problem(self) -> str:
        """Return what is wrong between the keys; '' where nothing is."""
        for key in RANGES:
            low, high = getattr(self, key)
            if low > high:
                return (
                    f'poses.{key} goes from {low:g} down to {high:g}; give the smaller one first'
                )
            if key.endswith('_deg') and low < high and max(abs(low), abs(high)) < 2.0 * pi + 0.01:
                return (
                    f'poses.{key} is {low:g} to {high:g}, a range of {high - low:.3g} degrees; if '
                    f'radians were meant, write {degrees(low):.4g}, {degrees(high):.4g}'
                )
        choices = {
            'design': (OPTIMAL, LATIN_HYPERCUBE),
            'solutions': (ALL, CHOSEN),
            'order': (NEAREST, FASTEST),
        }
        for key, words in choices.items():
            if getattr(self, key) not in words:
                return f'poses.{key} is {getattr(self, key)!r}; write {" or ".join(words)}'
        return self._without_effect()

    def _without_effect(self) -> str:
        """Return which key changes nothing beside the others; '' where each does."""
        given = self.given()
        if self.solutions == CHOSEN and (self.design, self.order) == (LATIN_HYPERCUBE, NEAREST):
            return (
                f'poses.solutions: {CHOSEN} has no effect with design: {LATIN_HYPERCUBE} and '
                f'order: {NEAREST}; leave it out'
            )
        if 'tool_share' in given and self.design != OPTIMAL:
            return (
                f'poses.tool_share has no effect with design: {self.design}; write design: '
                f'{OPTIMAL}, or leave it out'
            )
        if self.design != OPTIMAL:
            if 'tool_box' in given and 'tool_std_m' not in given:
                return (
                    'poses.tool_box has no effect without tool_std_m; write it, or leave both out'
                )
            return ''
        if 'joint_std_deg' in given and self.tool_share == 1.0:
            return 'poses.joint_std_deg has no effect with tool_share: 1; write less, such as 0.5'
        if 'tool_std_m' in given and self.tool_share == 0.0:
            return 'poses.tool_std_m has no effect with tool_share: 0; write more, such as 0.5'
        return ''


ON_TOOL = Bounds(-3.0, 3.0, 'm')
# A marker is placed better than this; a session file may give more, where nothing is known.
MARKER_STD = Bounds(0.0, 0.02, 'm', above=True)
# Of arms of some 7 to 20 kg.
LINK_RADIUS_M = 0.075
NO_MOTION = (
    'urdf_text', 'file', 'mesh_path', 'confirm', 'poses', 'aim_at', 'held_joint',
    'held_values_deg', 'held_values_m', 'marker_std_m', 'sensors',
)  # fmt: skip
"""What of a cell decides where an arm goes or where files lie, not whether it may go there."""
CLEARANCE = Bounds(HALF_STEP_M, 1.0, 'm', remedy='; half the step of a path check is the least')


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
        """Return it for the collision checks."""
        rotation = matrix_from_rpy(np.array([0.0, 0.0, radians(self.yaw_deg)]))
        return obstacle(name, self.center_m, self.size_m, rotation)


class CellToolBody(msgspec.Struct, forbid_unknown_fields=True):
    """A part of the tool, its middle at `center_m` of the tool frame, turned by `rpy_deg`.

    A box (`size_m`), a cylinder along its z (`radius_m`, `length_m`) or a sphere (`radius_m`).
    """

    center_m: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    size_m: Triple | None = None
    radius_m: float | None = None
    length_m: float | None = None

    def shape(self) -> Shape:
        """Return its shape, about its own middle."""
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
        """Return it for the collision checks, on the last joint of the arm."""
        turn = matrix_from_rpy(np.deg2rad(self.rpy_deg))
        T = chain.T_fixed[-1] @ transform(turn, np.array(self.center_m))
        return Body(name, len(chain), self.shape(), T, 'tool')


class Workcell(msgspec.Struct, forbid_unknown_fields=True):
    """A cell file; see config/cells/demo.yaml for what each key means."""

    robot: CellRobot
    markers: Annotated[dict[str, Triple], ON_TOOL]
    sensors: dict[str, CellSensor]
    aim_at: str
    marker_std_m: Annotated[float, MARKER_STD] = 0.5e-3
    held_joint: str | None = ''
    held_values_deg: list[float] | None = []
    held_values_m: list[float] | None = []  # In place of these where the joint slides
    poses: CellPoses = msgspec.field(default_factory=CellPoses)
    link_radius_m: Annotated[float, Bounds(0.0, 1.0, 'm', above=True)] = LINK_RADIUS_M
    obstacles: dict[str, CellBox] = {}
    floor_z_m: float | None = 0.0
    tool: dict[str, CellToolBody] = {}
    marker_radius_m: Annotated[float, Bounds(0.0, unit='m', above=True)] = 0.02
    clearance_m: Annotated[float, CLEARANCE] = 0.008
    unknown_offset_deg: Annotated[float, Bounds(0.0, 10.0, 'degrees')] = 1.0
    acceleration_limit_rad_s2: Annotated[float | list[float], Bounds(0.01, 1000.0, 'rad/s²')] = 5.0
    mesh_path: list[str] = []
    # Whether the nodes show their plan and wait for /remaster/confirm before the arm moves.
    confirm: bool = False
    urdf_text: str = ''
    # Where it was read from; nothing a plan depends on.
    file: str = ''

    def chain(self) -> SerialChain:
        """Build the arm's kinematic chain."""
        ends = self.robot.base_link, self.robot.tip_link
        return SerialChain.from_urdf(self.urdf_text, *ends)

    def fingerprint(self) -> str:
        """Return a checksum of all that a plan depends on."""
        plain = msgspec.to_builtins(msgspec.structs.replace(self, file=''))
        del plain['confirm']
        return hashlib.sha256(msgspec.json.encode(plain)).hexdigest()

    def model(self) -> ArmModel:
        """Return checksums of the arm and of all that a motion is checked against.

        Copies on two hosts are the same if they differ in their folders, in comments, in the
        order of keys or attributes or in white space alone. Meshes are not part of it.
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
        """Return the held joint's index and values (rad or m), or None."""
        if not self.held_joint:
            return None
        index = chain.joint_names.index(self.held_joint)
        if chain.slides[index]:
            return {index: tuple(self.held_values_m or [])}
        return {index: tuple(np.deg2rad(self.held_values_deg or []))}

    def acceleration_limits(self, chain: SerialChain) -> FloatArray:
        """Return each joint's acceleration limit, rad/s² or m/s², (k,).

        One number is for joints that turn; those that slide have `SerialChain.per_radian` times
        as much.
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
            What a joint's zero-offset may still be off by, rad; `unknown_offset_deg` where None.
        without_meshes
            Take capsules in place of meshes, which then need not be there: for simulated arms,
            never for one that moves.

        Raises
        ------
        InputError
            A mesh of the URDF that cannot be found or read, or geometry that cannot be.
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
        """Return what the poses of this cell are planned from; arguments and errors as above."""
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
        """Return which of the poses are to be visited, and in which order."""
        expected = [
            ExpectedSensor(
                name,
                np.array(sensor.rough_position_m),
                {marker: np.array(self.markers[marker]) for marker in sensor.markers},
                sensor.noise_m,
                sensor.pose_noise_m,
                sensor.frame_noise_m,
            )
            for name, sensor in self.sensors.items()
        ]
        return self.poses.settings(tuple(expected), self.marker_std_m)


def _no_mesh(name: str) -> None:
    """Leave a mesh out."""


def config_path(name: str) -> Path:
    """Path of a shipped configuration file, such as ``cells/demo.yaml``.

    In a source checkout config/ lies beside the package; installed, it is package data.
    """
    beside = Path(__file__).resolve().parents[2] / 'config'
    if (beside / 'cells').is_dir():
        return beside / name
    spec = importlib.util.find_spec('remaster_ros.config')
    if spec is None or not spec.submodule_search_locations:
        raise InputError('the shipped configuration is missing; install the package again')
    return Path(next(iter(spec.submodule_search_locations))) / name


def read_cell(path: str | Path) -> Workcell:
    """Read and check a cell file; a bare name such as ``demo`` is the shipped cells/demo.yaml.

    An `InputError` names the file, the key and the remedy.
    """
    path = Path(path)
    if not path.suffix and not path.is_file():
        shipped = config_path(f'cells/{path}.yaml')
        # A folder of that name, as `remaster demo --out demo` makes one, is no cell file.
        if shipped.exists() or not path.exists():
            path = shipped
    return parse_cell(read_limited(path, YAML_LIMIT, 'name a cell file'), path)


def parse_cell(data: bytes, path: Path) -> Workcell:
    """Check the content of a cell file, which need not be written yet; errors as `read_cell`."""
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
    """Refuse names that point nowhere and values that contradict each other."""
    try:
        chain = cell.chain()
    except InputError as error:
        raise InputError(f'{path.parent / cell.robot.urdf}: {error}') from None
    if problem := _problem(cell, chain):
        raise InputError(f'{path}: {with_line(text, problem)}')


def _problem(cell: Workcell, chain: SerialChain) -> str:
    """Return what is wrong between the keys of a cell file; '' where nothing is."""
    if cell.held_joint and cell.held_joint not in chain.joint_names:
        known = ', '.join(chain.joint_names)
        meant = did_you_mean(cell.held_joint, chain.joint_names)
        return f'held_joint {cell.held_joint!r} is none of {known}{meant}'
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
    # Meshes are read when they are needed.
    for key, parts in (('obstacles', cell.obstacles), ('tool', cell.tool)):
        for name, part in parts.items():
            try:
                part.body(name) if isinstance(part, CellBox) else part.body(name, chain)
            except InputError as error:
                return f'{key}.{name}: {error}'
    return ''
