# SPDX-License-Identifier: Apache-2.0
"""compensation.json: the whole correction of an arm in one file (``remaster-compensation/1``)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType, structs

from remaster_ros.calibration.records import Marker, Registration, Robot, Triple
from remaster_ros.compensation.arm_model import (
    GRAVITY,
    ArmModel,
    BaseTerm,
    Driver,
    Form,
    Function,
    Geometry,
    JointTerm,
)
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.of_result import CorrectedArm, Mount, NotCorrected
from remaster_ros.compensation.trajectories import CorrectedTrajectory, corrected_trajectory
from remaster_ros.errors import InputError
from remaster_ros.kinematics.pad_angles import coupled_in_circle
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import quaternion_xyzw
from remaster_ros.session.files import read_limited
from remaster_ros.session.json_records import decoded, plain
from remaster_ros.types import Controller, FloatArray, Session
from remaster_ros.version import __version__

FORMAT = 'remaster-compensation/1'
COMPENSATION_FILE = 'compensation.json'
FILE_LIMIT = 256 * 1024**2
REMEDY = (
    f'this is no {COMPENSATION_FILE} of remaster: give the one in the folder apply that fit, '
    'discover or report has written'
)
# Digits of the covariance's root: the errors of a marker are a millionth of those of the
# parameters, which compensate each other.
DIGITS = 10
# Largest magnitude of a number in the file, in its unit: far beyond the widest prior (300 m for a
# sensor), and with a finite fourth power.
LARGEST = 1e9

Source = Literal['fit', 'discover']
_FRAMES = (
    'shift: m, in the frame of the link that the joint before moves (base_link for the first); '
    "turn: rotation vector, rad, in the joint's own frame at angle 0. "
    'Origin of a joint = T_nominal with shift added to its translation, times Rot(turn).'
)


class RobotPart(Robot):
    """The nominal robot, with the whole text of its URDF."""

    urdf: str


class SourcePart(Struct):
    """Command, version and hashes of the result from which the correction was made."""

    made_by: Source
    result_sha256: str
    observations_sha256: str
    version: str


class TermPart(Struct):
    """Term of a joint or of the base in the file: a function of one driver; see `Function`."""

    effect: str
    driver: Driver
    form: Form
    coefficients: list[float]
    driver_joint: str | UnsetType = UNSET
    driver_at: Literal['reported', 'with_offset'] | UnsetType = UNSET
    order: int | UnsetType = UNSET
    knots_rad: list[float] | UnsetType = UNSET
    knots_m: list[float] | UnsetType = UNSET
    knots: list[float] | UnsetType = UNSET
    degree: int | UnsetType = UNSET
    turn_start_rad: float | UnsetType = UNSET


class JointPart(Struct, kw_only=True):
    """Offset and terms of a joint, in rad, or in m for a prismatic joint."""

    joint: str
    offset_rad: float | UnsetType = UNSET
    offset_m: float | UnsetType = UNSET
    identifiable: bool
    why: str
    range_rad: tuple[float, float] | UnsetType = UNSET
    range_m: tuple[float, float] | UnsetType = UNSET
    terms: list[TermPart]


class OriginPart(Struct):
    """Change of the origin of a joint or the tool: shift, m, and rotation vector, rad."""

    at: str
    shift: Triple
    turn: Triple


class GeometryPart(Struct):
    """Constant changes of the joints' origins in the file.

    Shifts, m, are in the frame of the link before; turns, rad, in the joint's own frame.
    """

    frames: str
    origins: list[OriginPart]


class MassPart(Struct):
    """Mass of the link after a joint, in the frame after that joint."""

    joint: str
    mass_kg: float
    center_m: Triple
    lateral_compliance: float | UnsetType = UNSET


class TemperaturePart(Struct):
    """Growth with the temperature: changes of origins per kelvin above the reference."""

    reference_c: float
    measured_at_c: float
    origins: list[OriginPart]


class ErrorPart(Struct):
    """Second moments E' E of the true parameters about those of the file, by their root E."""

    names: list[str]
    root: list[list[float]]


class ParametersPart(Struct):
    """Means and covariance U' U of the parameters; each row of U begins at its diagonal."""

    names: list[str]
    units: list[str]
    mean: list[float]
    covariance_root: list[list[float]]
    widening: float
    error: ErrorPart | UnsetType = UNSET


class CompensationPart(Struct):
    """Whole content of compensation.json."""

    format: str
    robot: RobotPart
    source: SourcePart
    state: dict[str, Any]
    joints: list[JointPart]
    geometry: GeometryPart
    masses: list[MassPart]
    gravity_m_s2: Triple
    parameters: ParametersPart
    # Stds of registrations are of shifts at the origin of R, and of rotations
    base_frame: dict[str, Registration]
    tool: dict[str, Marker]
    not_corrected: list[NotCorrected]
    notes: list[str]
    base_terms: list[TermPart] = []
    temperature: TemperaturePart | None = None
    controller: Controller | None = None
    # Sensors on the tool, whose `base_frame` is the pose of the target that they see; unset in
    # files of earlier versions.
    on_tool: dict[str, Mount] | UnsetType = UNSET

    def per_joint(self, what: str, chain: SerialChain) -> FloatArray:
        """Offset, (k,), or range, (k, 2), of each joint in the file, rad, m for prismatic ones.

        ``what``: 'offset' or 'range'; ``chain``: the file's arm.
        """
        parts = zip(self.joints, chain.units, strict=True)
        return np.array([getattr(part, f'{what}_{unit}') for part, unit in parts])


@dataclass(frozen=True, eq=False)
class Compensation:
    """Correction of an arm that was read from compensation.json, ready to use."""

    path: Path
    compensator: Compensator  # The correction, ready to use
    content: CompensationPart  # Content of the file
    sha256: str  # Hash of the file

    @property
    def model(self) -> ArmModel:
        """The calibrated arm."""
        return self.compensator.model

    def command(self, q: Any, temperature_c: Any = None) -> FloatArray:
        """Joint angles to command so that the tool is where the nominal robot has it, (..., k).

        ``q``: wanted angles, rad or m, (..., k); ``temperature_c``: of the arm, °C, one or one for
        each row, None for that of the measurements. As `Compensator.command`.
        """
        return self.compensator.command(q, temperature_c)

    def true(self, q: Any, temperature_c: Any = None) -> FloatArray:
        """Joint angles at which the nominal robot has its tool where the arm has it, (..., k).

        The inverse of `command`. ``q``: reported angles, rad or m, (..., k);
        ``temperature_c``: as of `command`. Raises as `Compensator.true`.
        """
        return self.compensator.true(q, temperature_c)

    def uncertainty(self, q: Any) -> FloatArray:
        """Mean square error of the first marker's position in the first sensor, m², (..., 3, 3).

        After correction at wanted angles ``q``, rad or m, (..., k), along axes of the robot
        base frame R. As `Compensator.uncertainty`.
        """
        return self.compensator.uncertainty(q)

    def trajectory(
        self, times_s: Any, positions: Any, velocities: Any = None, **more: Any
    ) -> CorrectedTrajectory:
        """Trajectory to send to the controller for a wanted one of the nominal robot.

        ``times_s``: ascending, s, (n,), at least two; ``positions, velocities``: wanted, rad
        and rad/s, (n, k), velocities may be None. Further arguments and errors as of
        `corrected_trajectory`.
        """
        return corrected_trajectory(self.compensator, times_s, positions, velocities, **more)


def written(described: CorrectedArm, session: Session, made_by: Source, result_sha256: str) -> str:
    """Text of compensation.json; nothing is written to the disk.

    Parameters
    ----------
    described
        Model of the arm, and the effects that are not corrected.
    session
        Session that the result is of.
    made_by, result_sha256
        Command that made the result, and the hash of its file.
    """
    model, chain = described.model, described.model.chain
    joints = [term.joint for term in model.joint_terms]
    assert joints == sorted(joints), 'parameters of terms are counted as they stand in the file'
    names, std = chain.joint_names, np.linalg.norm(model.root, axis=0)
    kept, root = _triangle(model.root)
    parameters: dict[str, Any] = {
        'names': [model.parameter_names[i] for i in kept],
        'units': [model.parameter_units[i] for i in kept],
        'mean': model.parameter_means[kept],
        'covariance_root': root,
        'widening': model.widening,
    }
    if model.error_root is not None:
        kept, root = _triangle(model.error_root)
        parameters['error'] = {'names': [model.parameter_names[i] for i in kept], 'root': root}
    temperature = {
        'reference_c': model.reference_c,
        'measured_at_c': model.mean_c,
        'origins': _origins(model.growth, names),
    }
    content = {
        'format': FORMAT,
        'robot': {**structs.asdict(Robot.of(session, chain)), 'urdf': session.urdf},
        'source': SourcePart(made_by, result_sha256, session.observations_sha256, __version__),
        'state': {'correction': session.correction, 'accuracy_option': session.accuracy_option},
        'joints': [
            {
                'joint': name,
                f'offset_{unit}': model.joint_offsets[j],
                'identifiable': described.identifiable[j],
                'why': described.why[j],
                f'range_{unit}': described.ranges[j],
                'terms': [_term(term, chain) for term in model.joint_terms if term.joint == j],
            }
            for j, (name, unit) in enumerate(zip(names, chain.units, strict=True))
        ],
        'geometry': {'frames': _FRAMES, 'origins': _origins(model.geometry, names)},
        'masses': [
            {'joint': name, 'mass_kg': mass, 'center_m': center}
            | ({'lateral_compliance': compliance} if compliance else {})
            for name, mass, center, compliance in zip(
                names, chain.masses, chain.centers_of_mass, model.lateral_compliance, strict=True
            )
        ],
        'gravity_m_s2': GRAVITY,
        'parameters': parameters,
        'base_frame': {
            sensor: {
                'translation_m': T[:3, 3],
                'rotation_xyzw': quaternion_xyzw(T[:3, :3]),
                'std_m': std[model.registration(sensor)[0]],
                'std_rad': std[model.registration(sensor)[1]],
            }
            for sensor, T in model.T_R_N.items()
        },
        'tool': {
            marker: {'position_m': place, 'std_m': std[model.marker(marker)]}
            for marker, place in model.markers.items()
        },
        'not_corrected': described.not_corrected,
        'notes': described.notes,
        'base_terms': [_term(term, chain) for term in model.base_terms],
        'temperature': temperature if model.grows else None,
        'controller': session.controller,
        'on_tool': described.mounts
        or {sensor: Mount(session.sensors[sensor]) for sensor in sorted(session.on_tool)},
    }
    encode = msgspec.json.Encoder(enc_hook=plain).encode
    lines = [f'  "{key}": {encode(value).decode()}' for key, value in content.items()]
    return '{\n' + ',\n'.join(lines) + '\n}\n'


def _triangle(root: FloatArray) -> tuple[list[int], list[list[float]]]:
    """Columns (indices) of a root (r, p) that are not all zero, and its triangular factor there.

    Rows of the factor of their QR decomposition; each begins at its diagonal, and numbers have
    10 digits.
    """
    kept = np.flatnonzero(np.any(root != 0.0, axis=0))
    rows = np.asarray(np.linalg.qr(root[:, kept], 'r')).tolist()
    return kept.tolist(), [
        [float(f'{v:.{DIGITS}g}') for v in row[i:]] for i, row in enumerate(rows)
    ]


def _taken_at(driver: Driver) -> Literal['reported', 'with_offset']:
    """Angle at which a driver is evaluated: 'with_offset' for gravity's, else 'reported'."""
    return 'with_offset' if driver.startswith('gravity') else 'reported'


def _knots_key(driver: Driver, joint: int, chain: SerialChain) -> str:
    """Key of a spline's knots: 'knots_rad' or 'knots_m' for angles, else 'knots'.

    ``joint``: index from 0 of the joint that drives; ``chain``: gives its unit.
    """
    return f'knots_{chain.units[joint]}' if driver == 'angle' else 'knots'


def _term(term: JointTerm | BaseTerm, chain: SerialChain) -> dict[str, Any]:
    """Term of the file for a term of the model, as plain data.

    Fields that its driver and form do not need are absent.
    """
    function = term.function
    part: dict[str, Any] = {'effect': term.effect, 'coefficients': term.coefficients}
    part |= {'driver': function.driver, 'form': function.form}
    if function.driver != 'none':
        part['driver_at'] = _taken_at(function.driver)
    if function.joint >= 0:
        part['driver_joint'] = chain.joint_names[function.joint]
    if function.order:
        part['order'] = function.order
    if function.form == 'bspline':
        key = _knots_key(function.driver, function.joint, chain)
        part |= {key: function.knots, 'degree': function.degree}
        if not np.isnan(function.turn_start):
            part['turn_start_rad'] = function.turn_start
    return part


def _origins(geometry: Geometry, names: Sequence[str]) -> list[dict[str, Any]]:
    """Changed origins as plain data: name of the joint or 'tool', shift, m, and turn, rad.

    Origins without a change are left out. ``names``: of the k joints.
    """
    rows = zip((*names, 'tool'), geometry.shifts, geometry.turns, strict=True)
    return [
        {'at': name, 'shift': shift, 'turn': turn}
        for name, shift, turn in rows
        if np.any(shift) or np.any(turn)
    ]


def read_compensation(path: str | os.PathLike[str]) -> Compensation:
    """Read compensation.json, with all checks.

    Raises
    ------
    InputError
        One line naming the file, the place in it and the remedy.
    """
    path = Path(path)
    hint = 'give apply/compensation.json that fit or discover has written'
    return of_text(read_limited(path, FILE_LIMIT, hint), path)


def of_text(data: bytes, path: Path) -> Compensation:
    """Compensation from the content of a compensation.json; ``path`` is for messages only.

    Raises InputError as `read_compensation` does: one line with the place and the remedy.
    """
    content = decoded(data, path, CompensationPart, FORMAT, REMEDY)
    try:
        _refuse_huge(content)
        model = _model(content)
    except InputError as error:
        raise InputError(f'{path}: {error}') from None
    return Compensation(path, Compensator(model), content, hashlib.sha256(data).hexdigest())


def _refuse_huge(content: CompensationPart) -> None:
    """Raise InputError for a number above 1e9 (`LARGEST`) in size, whose products overflow.

    The part 'state' is not looked at.
    """
    for key, part in msgspec.to_builtins(content).items():
        # What the controller reported is shown, never computed with.
        for where, value in _numbers(part, key) if key != 'state' else ():
            if abs(value) > LARGEST:
                raise _broken(where, f'is {value:.3g}, beyond what any arm has')


def _numbers(value: Any, where: str) -> Iterator[tuple[str, float]]:
    """Yield the dotted place, as 'joints.0.offset_rad', and the value of all numbers of a part.

    ``value``: plain data, nested; ``where``: place of the part itself.
    """
    if isinstance(value, int | float):
        yield where, value
    elif not isinstance(value, str | None):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _numbers(item, f'{where}.{key}')


def _model(content: CompensationPart) -> ArmModel:
    """Model of the arm in the content of a file.

    Raises InputError for contents that contradict each other, or whose correction does not
    converge (`ArmModel.largest_slope` of 1 or more).
    """
    robot = content.robot
    if hashlib.sha256(robot.urdf.encode()).hexdigest() != robot.urdf_sha256:
        raise _broken('robot.urdf', 'is not the text whose hash is urdf_sha256')
    chain = SerialChain.from_urdf(robot.urdf, robot.base_link, robot.tip_link)
    names = chain.joint_names
    for where, given in (
        ('robot.joint_names', robot.joint_names),
        ('joints', [part.joint for part in content.joints]),
        ('masses', [part.joint for part in content.masses]),
    ):
        if tuple(given) != names:
            raise _broken(where, f'are not the joints of its URDF, {", ".join(names)}')
    for part in content.masses:
        index = names.index(part.joint)
        if (part.mass_kg, part.center_m) != (
            chain.masses[index],
            tuple(chain.centers_of_mass[index]),
        ):
            raise _broken(f'masses of {part.joint}', 'are not those of its URDF')
    for joint, unit in zip(content.joints, chain.units, strict=True):
        if UNSET in (getattr(joint, f'offset_{unit}'), getattr(joint, f'range_{unit}')):
            raise _broken(f'joints.{joint.joint}', f'has no offset_{unit} or no range_{unit}')
    pad = {} if content.controller is None else content.controller.joints
    pad_joints = [*pad, *(other for joint in pad.values() for other in joint.coupling)]
    if any(name not in names for name in pad_joints):
        raise _broken('controller', 'names joints that are none of the arm')
    if coupled_in_circle({name: joint.coupling for name, joint in pad.items()}):
        raise _broken('controller', 'couples a joint to itself')
    if content.gravity_m_s2 != GRAVITY:
        raise _broken('gravity_m_s2', f'is not {GRAVITY}')
    joint_terms = tuple(
        JointTerm(j, term.effect, *_function(term, f'joints.{part.joint}.terms.{i}', chain, 1))
        for j, part in enumerate(content.joints)
        for i, term in enumerate(part.terms)
    )
    base_terms = tuple(
        BaseTerm(term.effect, *_function(term, f'base_terms.{i}', chain, 3))
        for i, term in enumerate(content.base_terms)
    )
    for sensor, frame in content.base_frame.items():
        if abs(np.linalg.norm(frame.rotation_xyzw) - 1.0) > 1e-3:
            raise _broken(f'base_frame.{sensor}.rotation_xyzw', 'is no quaternion of length 1')
    for sensor, mount in ({} if content.on_tool is UNSET else content.on_tool).items():
        if sensor not in content.base_frame or mount.marker not in content.tool:
            raise _broken(f'on_tool.{sensor}', 'names no sensor of base_frame or marker of tool')
        turn = mount.rotation_xyzw
        if turn is not UNSET and abs(np.linalg.norm(turn) - 1.0) > 1e-3:
            raise _broken(f'on_tool.{sensor}.rotation_xyzw', 'is no quaternion of length 1')
    warm = content.temperature
    model = ArmModel(
        chain=chain,
        joint_offsets=content.per_joint('offset', chain),
        joint_terms=joint_terms,
        base_terms=base_terms,
        geometry=_geometry(content.geometry.origins, names),
        growth=_geometry(warm.origins if warm else [], names),
        lateral_compliance=np.array(
            [
                0.0 if part.lateral_compliance is UNSET else part.lateral_compliance
                for part in content.masses
            ]
        ),
        reference_c=warm.reference_c if warm else np.nan,
        mean_c=warm.measured_at_c if warm else np.nan,
        T_R_N={sensor: part.T_R_N for sensor, part in content.base_frame.items()},
        markers={name: np.array(part.position_m) for name, part in content.tool.items()},
        root=np.zeros((0, 0)),
        widening=content.parameters.widening,
    )
    if not model.T_R_N or not model.markers:
        raise _broken('base_frame and tool', 'are empty')
    if model.grows and warm is None:
        raise _broken('temperature', 'is missing, but something depends on it')
    largest_slope = model.largest_slope()
    if not largest_slope < 1.0:
        what = (
            f'change an angle by up to {largest_slope:.3g} rad per rad, which no command takes off'
        )
        raise _broken('joints', what)
    found = content.parameters
    root = _root(model, 'parameters', found.names, 'covariance_root', found.covariance_root)
    error = found.error
    if error is UNSET:
        return replace(model, root=root)
    error_root = _root(model, 'parameters.error', error.names, 'root', error.root)
    return replace(model, root=root, error_root=error_root)


def _root(
    model: ArmModel, part: str, names: Sequence[str], key: str, rows: Sequence[Sequence[float]]
) -> FloatArray:
    """Matrix over all p parameters, (r, p), from an upper triangle over the named ones.

    ``rows``: of the triangle, each from its diagonal on; parameters that are not named have 0.
    ``part``, ``key``: for messages. Raises InputError for unknown or repeated names, or rows
    of other lengths.
    """
    order = {name: i for i, name in enumerate(model.parameter_names)}
    strangers = [name for name in names if name not in order]
    count = len(names)
    if strangers or len(set(names)) < count:
        what = f'{strangers[0]!r} is no parameter of it' if strangers else 'a name stands twice'
        raise _broken(f'{part}.names', what)
    if len(rows) > count or any(len(row) != count - i for i, row in enumerate(rows)):
        raise _broken(f'{part}.{key}', 'is no upper triangle of its parameters')
    root = np.zeros((len(rows), len(order)))
    columns = np.array([order[name] for name in names], dtype=np.int64)
    for i, row in enumerate(rows):
        root[i, columns[i:]] = row
    return root


def _function(
    part: TermPart, where: str, chain: SerialChain, axes: int
) -> tuple[Function, FloatArray]:
    """Function of a term of the file, and its coefficients, (m times ``axes``,).

    ``where``: its place, for messages; ``axes``: number of coefficients for each of the m
    features, 1 of a joint, 3 of the base. Raises InputError for contents that contradict each
    other.
    """
    joint, names = -1, chain.joint_names
    if part.driver in ('angle', 'gravity_torque'):
        if part.driver_joint not in names:
            raise _broken(f'{where}.driver_joint', 'names no joint of the arm')
        joint = names.index(str(part.driver_joint))
    expected = _taken_at(part.driver)
    if part.driver != 'none' and part.driver_at != expected:
        raise _broken(f'{where}.driver_at', f'is not {expected!r}, as {part.driver} has it')
    if (part.driver == 'none') != (part.form == 'constant'):
        raise _broken(f'{where}.form', f'is {part.form!r} with the driver {part.driver!r}')
    if part.driver == 'gravity_moment' and (axes == 1 or part.form != 'linear'):
        raise _broken(f'{where}.driver', 'gravity_moment drives only the base, and linearly')
    knots, degree = np.zeros(0), 0
    if part.form == 'bspline':
        given = getattr(part, _knots_key(part.driver, joint, chain))
        if given is UNSET or part.degree is UNSET:
            raise _broken(where, 'is a bspline without knots or degree')
        assert not isinstance(given, UnsetType)
        assert not isinstance(part.degree, UnsetType)
        knots, degree = np.array(given), part.degree
        ascending = all(a <= b for a, b in pairwise(given))
        if not 0 <= degree <= 9 or len(given) < 2 * degree + 2 or not ascending:
            raise _broken(
                f'{where}.knots', f'are no ascending knots of splines of degree {degree}'
            )
    order = 0 if isinstance(part.order, UnsetType) else part.order
    if part.form in ('sin', 'cos') and order < 1:
        raise _broken(f'{where}.order', f'is {order}, but must be a whole number of at least 1')
    start = np.nan if isinstance(part.turn_start_rad, UnsetType) else part.turn_start_rad
    function = Function(part.driver, part.form, joint, order, knots, degree, start)
    if len(part.coefficients) != function.size * axes:
        raise _broken(
            f'{where}.coefficients',
            f'are {len(part.coefficients)}, but must be {function.size * axes}',
        )
    return function, np.array(part.coefficients)


def _geometry(origins: Sequence[OriginPart], names: Sequence[str]) -> Geometry:
    """Changes of the origins of all joints and of the tool, 0 for those that are not listed.

    Raises InputError for an unknown name.
    """
    found = Geometry.none(len(names))
    every = (*names, 'tool')
    for part in origins:
        if part.at not in every:
            raise _broken('geometry', f'has an origin {part.at!r}, which is no joint of the arm')
        found.shifts[every.index(part.at)] = part.shift
        found.turns[every.index(part.at)] = part.turn
    return found


def _broken(where: str, what: str) -> InputError:
    """Return an InputError on a part of the file: its place and what is wrong, with the remedy."""
    return InputError(f'{where} {what}; write the file again with fit or discover')
