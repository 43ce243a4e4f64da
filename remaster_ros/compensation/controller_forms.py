# SPDX-License-Identifier: Apache-2.0
"""A correction in the forms of controllers and drivers, and the errors that each form leaves.

If a form cannot hold all of a correction, its content is fitted again to the whole correction,
with base and marker: offsets, lengths and tilts that were estimated together with causes that are
left out would be worse than none.

Tables of constant geometry are Denavit and Hartenberg's, Hayati's, and products of exponentials.
With q the reported angles of k joints::

    DH:   tool = base · S_1(q_1) · … · S_{k-1}(q_{k-1}) · Rz(q_k + theta_k) · end
          S = Rz(q + theta) · Tz(d) · Tx(a) · Rx(alpha)                   dh
          S = Rz(q + theta) · Tx(a) · Rx(alpha) · Ry(beta)                hayati
    POE:  tool = exp([s_1] q_1) · … · exp([s_k] q_k) · home,  s = (w, v), in the base frame

A prismatic joint adds q along z, Tz(q), in place of its rotation, and w of its screw is 0. A step
between joints whose nominal axes are parallel is Hayati's, since ``d`` has no bounds there. Base
and end are x y z in m and roll pitch yaw in rad, Rz(yaw) · Ry(pitch) · Rx(roll).
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from csv import writer as csv_writer
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args
from xml.etree import ElementTree

import msgspec
import numpy as np

from remaster_ros.compensation.arm_model import ArmModel, Geometry
from remaster_ros.compensation.export import (
    REMASTER_FILE,
    URDF_FILE,
    ZeroOffsets,
    calibrated_urdf,
    parsed_xml,
    remaster_text,
    rpy_of,
    written_notes,
    xml_text,
)
from remaster_ros.compensation.file import Compensation
from remaster_ros.compensation.of_result import NotCorrected
from remaster_ros.compensation.pad_pages import PAD_PAGES, MotorNumber, motor_text
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    matrix_from_rpy,
    rotation_vector_to_matrix,
    transform,
    with_z_along,
)
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.session.strict_yaml import YamlError, dump_yaml, load_yaml
from remaster_ros.types import FloatArray

Form = Literal['urdf', 'ur', 'ros2_control', 'rising', 'pad', 'json', 'csv']
FORMS: tuple[Form, ...] = get_args(Form)
WITH_GEOMETRY = frozenset({'urdf', 'ur', 'json', 'csv'})
KINEMATICS_FORMAT = 'remaster-kinematics/1'
# Configurations in the measured range over which a form is compared with the whole correction.
COMPARED = 400
# Gauss–Newton steps: the content left out is at most some millimetres, of which each step leaves a
# thousandth.
STEPS = 3
# Prior std of lengths (m) and tilts (rad) about those of the correction: typical error of a
# drawing a metre away. Parameters that the data hardly determine stay.
GEOMETRY_STD = 1e-3
NEARER = (
    'The compensation.json that "remaster fit" writes of the same session holds offsets, lengths '
    'and tilts alone, fitted to what was measured: export that one, it is nearer.'
)
# Least RMS size of a part that is listed by itself, mm: half of the last digit shown.
LEAST_PART_MM = 5e-3
# Links of a UR's kinematics file, by the ends of its joints' names.
UR_LINKS = {
    'shoulder_pan_joint': 'shoulder',
    'shoulder_lift_joint': 'upper_arm',
    'elbow_joint': 'forearm',
    'wrist_1_joint': 'wrist_1',
    'wrist_2_joint': 'wrist_2',
    'wrist_3_joint': 'wrist_3',
}
# Tolerance of numbers in files, m and rad: a micrometre, and a micrometre a metre away.
SAME = 1e-6
# Smallest angle between axes for a step with ``d``, rad: its error is that of the axes' positions
# divided by the sine of the angle.
PARALLEL_RAD = 0.1
X, Y, Z = np.eye(3)
TURNS = ('theta', 'alpha', 'beta', 'roll', 'pitch', 'yaw')


@dataclass(frozen=True)
class Part:
    """Part of a correction that an export form cannot hold, and its RMS size at the marker, mm."""

    what: str
    rms_mm: float


@dataclass(frozen=True, eq=False)
class HeldByForm:
    """Content of a correction that an export form can hold, and the error that remains."""

    model: ArmModel  # The nominal arm with this content
    parts: tuple[Part, ...]  # Parts that the form does not hold
    # Error at the marker with this content, over the measured range
    rms_mm: float
    max_mm: float
    uncorrectable: tuple[NotCorrected, ...] = ()  # Effects that no form corrects
    better_file: str = ''  # Advice to export a file that is nearer to the measurements; ''

    @property
    def words(self) -> list[str]:
        """Lines for the user on what is left out: total error, parts, uncorrectable effects.

        Parts of less than 0.005 mm RMS are only counted.
        """

        def of_joints(joints: Sequence[int]) -> str:
            several = 's' if len(joints) > 1 else ''
            return f' of joint{several} {", ".join(map(str, joints))}' if joints else ''

        lines_uncorrectable = [
            f'Corrected in no form: {error.effect.replace("_", " ")}'
            f'{of_joints(error.joints)}, {error.size_mm:.3f} mm RMS: {error.instead}'
            for error in self.uncorrectable
        ]
        if not self.parts:
            return ['Left out: nothing that can be corrected.', *lines_uncorrectable]
        shown = [part for part in self.parts if part.rms_mm >= LEAST_PART_MM]
        small_parts = len(self.parts) - len(shown)
        return [
            f'Left out: {self.rms_mm:.3f} mm RMS at the marker, {self.max_mm:.3f} mm at most, '
            'over the measured range, with what it holds fitted to the whole correction.',
            *(f'Left out: {part.what}, alone {part.rms_mm:.2f} mm RMS.' for part in shown),
            *([f'Left out: {small_parts} more below 0.01 mm each.'] if small_parts else []),
            *filter(None, [self.better_file]),
            *lines_uncorrectable,
        ]


def form_content(compensation: Compensation, form: Form, rng: np.random.Generator) -> HeldByForm:
    """Content of a correction that an export form can hold, fitted to the whole correction.

    Fitted are the positions of the first marker in the first sensor at 400 configurations of
    the measured range, drawn by ``rng``: the arm with this content to the arm with the whole
    correction. Sensor pose and marker are fitted with the content.
    """
    model, content = compensation.model, compensation.content
    # A UR's kinematics file has no place for what carries the arm.
    prismatic = model.chain.slides if form == 'ur' else np.zeros(model.joints, dtype=bool)
    known = np.array([part.identifiable for part in content.joints]) & ~prismatic
    k = model.joints
    geometry, with_geometry = Geometry.none(k), form in WITH_GEOMETRY and model.geometry.is_any
    if with_geometry:
        # A shift of the tool frame is one of the marker, which is fitted again.
        geometry.shifts[:k], geometry.turns[:k] = (
            model.geometry.shifts[:k],
            model.geometry.turns[:k],
        )
        geometry.shifts[:k][prismatic] = geometry.turns[:k][prismatic] = 0.0
    plain = replace(
        model,
        joint_offsets=np.where(known, model.joint_offsets, 0.0),
        joint_terms=(),
        base_terms=(),
        geometry=geometry,
        growth=Geometry.none(k),
        lateral_compliance=np.zeros(k),
    )
    low, high = content.per_joint('range', model.chain).T
    q = rng.uniform(low, high, (COMPARED, k))
    sensor, marker = next(iter(model.T_R_N)), next(iter(model.markers))

    def place(arm: ArmModel) -> FloatArray:
        return arm.in_sensor(arm.state(q), sensor, marker)

    wanted, turn = place(model), model.T_R_N[sensor][:3, :3]
    free = np.zeros(len(plain.parameter_names), dtype=bool)
    free[:k] = known
    for where in (*plain.registration(sensor), plain.marker(marker)):
        free[where] = True
    revolute_names = set(np.array(model.chain.joint_names)[~prismatic])
    of_geometry = np.array(
        [_of_geometry(name) in revolute_names for name in plain.parameter_names]
    )
    free |= of_geometry & with_geometry
    total = np.zeros(len(free))
    for _ in range(STEPS):
        columns = plain.derivative(plain.state(q), sensor, marker)[..., free]
        columns = columns.reshape(-1, columns.shape[-1])
        error = ((wanted - place(plain)) @ turn.T).ravel()
        held_back = np.eye(len(free))[of_geometry & with_geometry][:, free]
        held_back *= np.sqrt(np.mean(error**2)) / GEOMETRY_STD
        step = np.zeros(len(free))
        # Of what base and marker do as well as an offset, the smallest step.
        step[free] = np.linalg.lstsq(
            np.concatenate((columns, held_back)),
            np.concatenate((error, -held_back @ total[free])),
            rcond=1e-9,
        )[0]
        total += step
        plain = plain.with_step(step)
    displacement = np.linalg.norm(wanted - place(plain), axis=1)
    parts = tuple(
        Part(what, 1e3 * float(np.sqrt(np.mean(np.sum((wanted - place(arm)) ** 2, axis=1)))))
        for what, arm in _models_without_parts(model, form)
    )
    return HeldByForm(
        plain,
        parts,
        1e3 * float(np.sqrt(np.mean(displacement**2))),
        1e3 * float(displacement.max(initial=0.0)),
        tuple(content.not_corrected),
        NEARER if with_geometry and parts and content.source.made_by == 'discover' else '',
    )


def _of_geometry(name: str) -> str:
    """Name of the joint, or 'tool', in a parameter's name 'geometry.JOINT.AXIS'; else ''."""
    kind, _, axis_name = name.partition('.')
    return axis_name.rpartition('.')[0] if kind == 'geometry' else ''


def _models_without_parts(model: ArmModel, form: Form) -> list[tuple[str, ArmModel]]:
    """For each part that a form does not hold: its name, and the whole model without this part."""
    names, none = model.chain.joint_names, Geometry.none(model.joints)
    found = []
    for effect, joint in dict.fromkeys((term.effect, term.joint) for term in model.joint_terms):
        other_terms = tuple(t for t in model.joint_terms if (t.effect, t.joint) != (effect, joint))
        found.append(
            (
                f'{effect.replace("_", " ")} of {names[joint]}',
                replace(model, joint_terms=other_terms),
            )
        )
    for effect in dict.fromkeys(term.effect for term in model.base_terms):
        terms = tuple(term for term in model.base_terms if term.effect != effect)
        found.append((f'{effect} of the base', replace(model, base_terms=terms)))
    if model.growth.is_any:
        found.append(('growth with the temperature', replace(model, growth=none)))
    for joint in np.flatnonzero(model.lateral_compliance).tolist():
        rest_of = model.lateral_compliance.copy()
        rest_of[joint] = 0.0
        what = f'the soft bearing of {names[joint]}'
        found.append((what, replace(model, lateral_compliance=rest_of)))
    for joint in np.flatnonzero(model.chain.slides).tolist() if form == 'ur' else ():
        offsets = model.joint_offsets.copy()
        shifts, turns = model.geometry.shifts.copy(), model.geometry.turns.copy()
        if offsets[joint] or np.any(shifts[joint]) or np.any(turns[joint]):
            offsets[joint], shifts[joint], turns[joint] = 0.0, 0.0, 0.0
            remaining_model = replace(
                model, joint_offsets=offsets, geometry=Geometry(shifts, turns)
            )
            found.append((f'zero and place of {names[joint]}', remaining_model))
    if form not in WITH_GEOMETRY and model.geometry.is_any:
        found.append(('lengths and tilts', replace(model, geometry=none)))
    return found


def exported(
    compensation: Compensation,
    form: Form,
    held_content: HeldByForm,
    base: tuple[Path, str] | None = None,
    *,
    driver_param: bool = False,
    motors: Mapping[str, MotorNumber] | None = None,
) -> dict[str, str]:
    """Files of an export form, name -> text; nothing is written to the disk.

    Parameters
    ----------
    compensation, form
        Correction and form.
    held_content
        Content that the form can hold, of `form_content`.
    base
        For ``ur``, ``rising`` and ``ros2_control``: path and text of the file that is changed;
        None for the nominal URDF.
    driver_param
        For ``ros2_control``: ``<param name="offset">`` in place of transmissions.
    motors
        For ``pad``: numbers that the controller has stored, by joint.

    Raises
    ------
    InputError
        The file to be changed is not of this arm, cannot be read, or lacks the elements to be
        changed; or ``ur`` without ``base``.
    """
    offsets = _offsets(compensation, held_content)
    notes = written_notes(offsets, held_content.words)
    if form == 'urdf':
        return {URDF_FILE: _urdf(compensation, offsets, held_content, notes)}
    if form == 'ur':
        if base is None:
            raise InputError("--to ur changes the arm's own kinematics file: name it with --base")
        return {base[0].name: _ur_yaml(compensation, offsets, held_content, *base, notes)}
    if form == 'json':
        return {'kinematics.json': _json(compensation, held_content)}
    if form == 'csv':
        return {'kinematics.csv': _csv(held_content)}
    if form == 'pad':
        files = {
            REMASTER_FILE: remaster_text(offsets, held_content.words, is_single_file=True),
            **PAD_PAGES,
        }
        if motors:
            files['motor_numbers.txt'] = motor_text(offsets, motors)
        return files
    path, text = base or (Path('robot.urdf'), compensation.content.robot.urdf)
    try:
        root = parsed_xml(text)
    except ElementTree.ParseError as error:
        raise InputError(f'{path}: not well-formed XML ({error}); give a URDF') from None
    by_joint = {
        name: float(value)
        for name, value in zip(offsets.chain.joint_names, offsets.applied, strict=True)
        if value != 0.0
    }
    if form == 'rising':
        _rising(root, by_joint, path)
        how = 'angle = position read + rising; many drivers ignore <calibration>: look into yours'
    elif driver_param:
        _driver_params(root, by_joint, path)
        how = (
            'for a driver that reports raw angle - offset, as some do: look into yours for a '
            'parameter of this name and its sign'
        )
    else:
        _transmissions(root, by_joint, path)
        how = (
            'joint = actuator / reduction + offset; acts only where the hardware component loads '
            'transmissions, which no controller manager does for it: look into yours'
        )
    limits = 'the limits of the joints stay as they are: keep away from them by the offsets'
    return {path.name: xml_text(text, root, [how, limits, *notes])}


def _offsets(compensation: Compensation, held_content: HeldByForm) -> ZeroOffsets:
    """Zero-offsets of a form's content, with the standard deviations of the whole correction.

    If the file has the expected error of lengths and tilts, the standard deviations contain
    it. The warnings of the result are the notes 'CHECK FIRST' of the correction, and a
    sentence if the maker's accuracy option was on.
    """
    content, model = compensation.content, compensation.model
    was = content.state.get('accuracy_option', '')
    option = [f"Measured with the maker's accuracy option {was}: right in that state alone."]
    option = option if was else []
    # With what links off their drawing do to the offsets, where the file has it.
    root = model.widening * model.root if model.error_root is None else model.error_root
    std = np.linalg.norm(root[:, : model.joints], axis=0)
    return ZeroOffsets(
        content.robot.urdf,
        model.chain,
        held_content.model.joint_offsets,
        std,
        np.array([part.identifiable for part in content.joints]),
        [part.why for part in content.joints],
        content.controller,
        [*(note for note in content.notes if note.startswith('CHECK FIRST')), *option],
    )


def _urdf(
    compensation: Compensation,
    offsets: ZeroOffsets,
    held_content: HeldByForm,
    notes: Sequence[str],
) -> str:
    """Text of the nominal URDF with the offsets and geometry of a form's content.

    ``offsets``: those that are applied; ``held_content``: has the geometry; ``notes``:
    comments in the file, a line each.
    """
    return calibrated_urdf(
        compensation.content.robot.urdf,
        offsets.chain,
        offsets.applied,
        notes,
        held_content.model.geometry,
    )


def _ur_yaml(
    compensation: Compensation,
    offsets: ZeroOffsets,
    held_content: HeldByForm,
    path: Path,
    text: str,
    notes: Sequence[str],
) -> str:
    """Text of a UR's kinematics file with the origins of the corrected robot model.

    Joints that slide are left out. ``path``, ``text``: the arm's own file, which is not
    changed; ``notes``: comments in the new text, a line each; other arguments as of `_urdf`.
    Raises InputError if it is no such file, or its origins are off those of the measured robot
    by over 1e-6 m or rad.
    """
    try:
        content = load_yaml(text)
    except YamlError as error:
        raise InputError(f'{path}: {error}') from None
    links = content.get('kinematics') if isinstance(content, dict) else None
    if not isinstance(links, dict):
        raise InputError(
            f"{path}: no key 'kinematics'; give the arm's own kinematics file of a UR"
        )
    nominal = {joint.name: joint for joint in _joints(compensation.content.robot.urdf)}
    changed = parsed_xml(_urdf(compensation, offsets, held_content, ()))
    origins = {joint.get('name'): joint.find('origin') for joint in changed.findall('joint')}
    for name, slides in zip(offsets.chain.joint_names, offsets.chain.slides, strict=True):
        if slides:
            continue
        link = next((link for end, link in UR_LINKS.items() if name.endswith(end)), '')
        numbers = links.get(link)
        keys = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
        if not isinstance(numbers, dict) or not all(
            isinstance(numbers.get(key), int | float) for key in keys
        ):
            raise InputError(
                f'{path}: no numbers {" ".join(keys)} in kinematics.{link or "?"} for {name}; '
                "give the arm's own kinematics file of a UR"
            )
        given = np.array([float(numbers[key]) for key in keys])
        drawn = transform(matrix_from_rpy(given[3:]), given[:3])
        off = np.abs(drawn - nominal[name].origin).max()
        if off > SAME:
            raise InputError(
                f'{path}: kinematics.{link} is not that of the robot that was measured (off by '
                f'{off:.2g}); give the file that its description was made with, or measure again '
                'with kinematics_params:=FILE'
            )
        origin = origins[name]
        if origin is None:
            continue
        words = [*origin.get('xyz', '0 0 0').split(), *origin.get('rpy', '0 0 0').split()]
        found = np.array([float(word) for word in words])
        if np.any(transform(matrix_from_rpy(found[3:]), found[:3]) != nominal[name].origin):
            numbers.update(zip(keys, found.tolist(), strict=True))
    head = [
        "The arm's own kinematics, corrected: give it to ur.urdf.xacro as kinematics_params, to "
        'planner and driver alike, and beside it no other form of this correction.',
        'The hash is that of the arm, which the driver compares: leave it. What the arm itself '
        'computes (moves in its base frame, the pose on its pad) stays as it was.',
        'Joint limits stay as they are: keep away from them by the offsets.',
        *notes,
    ]
    return ''.join(f'# {line}\n' for line in head) + dump_yaml(content)


def _joints(urdf: str) -> list[Any]:
    """Joints of a URDF's text that have a child link."""
    return list(parse_urdf(urdf).parent_joint.values())


def _rising(root: ElementTree.Element, by_joint: Mapping[str, float], path: Path) -> None:
    """Add offsets, rad or m, to <calibration rising> of a URDF's joints, in place.

    Raises InputError, with ``path``, if a joint is missing or its value is no number.
    """
    joints = {joint.get('name'): joint for joint in root.findall('joint')}
    for name, offset in by_joint.items():
        joint = joints.get(name)
        if joint is None:
            raise InputError(f'{path}: no joint {name!r}; give a URDF of this arm')
        element = joint.find('calibration')
        if element is None:
            element = ElementTree.SubElement(joint, 'calibration')
        element.set('rising', repr(_number(element.get('rising', '0'), path, name) + offset))


def _transmissions(root: ElementTree.Element, by_joint: Mapping[str, float], path: Path) -> None:
    """Add offsets, rad or m, to <offset> of transmissions in <ros2_control>, in place.

    joint = actuator / reduction + offset: a mechanical reduction does not matter. Raises
    InputError, with ``path``, if a joint has no transmission or its value is no number.
    """
    found = {
        joint.get('name'): joint for joint in root.findall('.//ros2_control/transmission/joint')
    }
    missing = [name for name in by_joint if name not in found]
    if missing:
        raise InputError(
            f'{path}: no <transmission> in <ros2_control> has joint {", ".join(missing)}; where '
            'the hardware component loads none there is nothing to correct: take another form, '
            '--driver-param perhaps'
        )
    for name, offset in by_joint.items():
        element = found[name].find('offset')
        if element is None:
            element = ElementTree.SubElement(found[name], 'offset')
        element.text = repr(_number(element.text or '0', path, name) + offset)


def _driver_params(root: ElementTree.Element, by_joint: Mapping[str, float], path: Path) -> None:
    """Subtract offsets, rad or m, from <param name="offset"> of joints, in place.

    For drivers that report raw angle - offset. A missing param is added with 0. Raises InputError,
    with ``path``, if a joint is missing or its value is no number.
    """
    found = {joint.get('name'): joint for joint in root.findall('.//ros2_control/joint')}
    missing = [name for name in by_joint if name not in found]
    if missing:
        raise InputError(
            f'{path}: no joint {", ".join(missing)} in <ros2_control>; give the URDF of the driver'
        )
    for name, offset in by_joint.items():
        params = [p for p in found[name].findall('param') if p.get('name') == 'offset']
        element = params[0] if params else ElementTree.SubElement(found[name], 'param')
        element.set('name', 'offset')
        element.text = repr(_number(element.text or '0', path, name) - offset)


def _number(text: str, path: Path, joint: str) -> float:
    """Finite number in the text of an element. Raises InputError for any other text."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            f'{path}: the offset of {joint} is {text.strip()[:40]!r}, no number; expand the xacro'
        )
    return value


def _json(compensation: Compensation, held_content: HeldByForm) -> str:
    """Text of kinematics.json: robot, conventions, error left out, and rows of `tables`."""
    robot = compensation.content.robot
    content = {
        'format': KINEMATICS_FORMAT,
        'compensation_sha256': compensation.sha256,
        'robot': {
            key: getattr(robot, key)
            for key in ('name', 'urdf_sha256', 'base_link', 'tip_link', 'joint_names')
        },
        'steps': {
            'dh': 'Rz(q + theta) Tz(d) Tx(a) Rx(alpha)',
            'hayati': 'Rz(q + theta) Tx(a) Rx(alpha) Ry(beta)',
            'tool': 'base, the steps, Rz(q + theta) of the last joint, end',
            'slides': 'Rz(theta) Tz(q) in place of Rz(q + theta); of the last joint Tz(q + d)',
            'poe': 'exp of each screw (w, v) times its q, base to tip, then home',
            'base, end, home': 'x y z in m, roll pitch yaw in rad: Rz(yaw) Ry(pitch) Rx(roll)',
        },
        'left_out': {
            'rms_mm': held_content.rms_mm,
            'max_mm': held_content.max_mm,
            'parts': list(held_content.parts),
        },
        'rows': tables(held_content.model),
    }
    return msgspec.json.format(msgspec.json.encode(content)).decode() + '\n'


def _csv(held_content: HeldByForm) -> str:
    """Text of kinematics.csv: a header line, and a line for each `Row` of `tables`.

    Columns are the fields of a row: table, part, parameter, unit, nominal value and correction
    of one Denavit-Hartenberg or screw parameter. ``held_content``: has the corrected arm.
    """
    text = io.StringIO()
    writer = csv_writer(text, lineterminator='\n')
    rows = [asdict(row) for row in tables(held_content.model)]
    writer.writerow(rows[0])
    writer.writerows(row.values() for row in rows)
    return text.getvalue()


@dataclass(frozen=True)
class Row:
    """One number of a table of constant geometry: its nominal value and its change."""

    table: str  # ``dh``, ``hayati`` or ``poe``
    part: str  # A joint, ``base``, ``end`` or ``home``
    parameter: str
    unit: str
    nominal: float  # Value of the nominal robot
    delta: float  # Correction to be added


def tables(model: ArmModel) -> list[Row]:
    """Denavit-Hartenberg and screw parameters of an arm without terms: nominal values and changes.

    First DH (Hayati's for parallel axes), base to end, then the screws and the home pose;
    changes of angles are within ±π.
    """
    names = model.chain.joint_names
    nominal = ArmModel.nominal(model.chain)
    before, after = _Axes(nominal), _Axes(model)
    parallel = np.linalg.norm(np.cross(before.along[:-1], before.along[1:]), axis=1) < np.sin(
        PARALLEL_RAD
    )
    rows = []
    for (table, part, values), (_, _, found) in zip(
        [*_dh(before, parallel, names), *_poe(before, names)],
        [*_dh(after, parallel, names), *_poe(after, names)],
        strict=True,
    ):
        for parameter, value in values.items():
            turn = parameter in TURNS
            delta = found[parameter] - value
            if turn:
                delta = float(np.angle(np.exp(1j * delta)))
            slides = part in names and model.chain.slides[names.index(part)]
            unit = 'rad' if turn else 'm'
            if parameter.startswith('w') or (parameter.startswith('v') and slides):
                unit = ''
            rows.append(Row(table, part, parameter, unit, value, delta))
    return rows


class _Axes:
    """Axes of an arm's joints in the base frame R at reported joints 0; poses of base and tool."""

    def __init__(self, model: ArmModel) -> None:
        state = model.state(np.zeros((1, model.joints)))
        before = state.before[0]
        self.along = np.einsum('kij,kj->ki', before[:, :3, :3], model.chain.axes)
        self.points = before[:, :3, 3]
        first = with_z_along(model.chain.axes[0])
        self.base = transform(before[0, :3, :3] @ first, before[0, :3, 3])
        self.tool = state.tool[0]
        self.last = float(model.joint_offsets[-1])
        self.slides = model.chain.slides


def _dh(
    axes: _Axes, parallel: Sequence[bool], names: Sequence[str]
) -> list[tuple[str, str, dict[str, float]]]:
    """Denavit-Hartenberg parameters, base to end: rows of table, part (joint or frame), values.

    ``parallel``: whether the axes of each joint and the next are parallel, (k - 1,); such a
    joint has Hayati's parameters, and the table 'hayati'.
    """
    frame = axes.base
    rows = [('dh', 'base', _placed(frame))]
    for i, name in enumerate(names[:-1]):
        x, y, z = frame[:3, :3].T @ axes.along[i + 1]
        origin = apply(inverse(frame), axes.points[i + 1])
        if parallel[i]:
            met = origin - origin[2] / z * np.array([x, y, z])
            a, theta = float(np.hypot(met[0], met[1])), float(np.arctan2(met[1], met[0]))
            across = rotation_vector_to_matrix(-theta * Z) @ (x, y, z)
            alpha, beta = np.arctan2(-across[1], across[2]), np.arcsin(across[0])
            step = transform(np.eye(3), a * X)
            step[:3, :3] = rotation_vector_to_matrix(alpha * X) @ rotation_vector_to_matrix(
                beta * Y
            )
            values = {'theta': theta, 'a': a, 'alpha': float(alpha), 'beta': float(beta)}
        else:
            # The common normal is that of z and the next axis, whichever way they pass.
            sine = np.hypot(x, y)
            normal = np.array([-y, x, 0.0]) / sine
            t = float(origin @ np.cross(Z, normal)) / sine
            a, d = float(origin @ normal), float(origin[2] + t * z)
            theta, alpha = float(np.arctan2(x, -y)), float(np.arctan2(sine, z))
            step = transform(rotation_vector_to_matrix(alpha * X), (a, 0.0, d))
            values = {'theta': theta, 'd': d, 'a': a, 'alpha': alpha}
        rows.append(('hayati' if parallel[i] else 'dh', name, values))
        frame = frame @ transform(rotation_vector_to_matrix(theta * Z), np.zeros(3)) @ step
    moved = transform(rotation_vector_to_matrix(axes.last * Z), np.zeros(3))
    if axes.slides[-1]:
        moved = transform(np.eye(3), axes.last * Z)
    rows.append(('dh', names[-1], {'d' if axes.slides[-1] else 'theta': axes.last}))
    return [*rows, ('dh', 'end', _placed(inverse(frame @ moved) @ axes.tool))]


def _poe(axes: _Axes, names: Sequence[str]) -> list[tuple[str, str, dict[str, float]]]:
    """Product of exponentials: rows of the joints' screws and of the tool's home pose.

    A row: table 'poe', the joint's name or 'home', values. A screw is wx wy wz, vx vy vz in
    the base frame R: rotation axis, and velocity of the point at R's origin, m/rad; of a joint
    that slides w is 0 and v its axis. Home: x y z, m, and roll pitch yaw, rad.
    """
    rows = []
    for name, w, point, slides in zip(names, axes.along, axes.points, axes.slides, strict=True):
        turns = [*w.tolist(), *np.cross(point, w).tolist()]
        screw = [0.0, 0.0, 0.0, *w.tolist()] if slides else turns
        keys = ('wx', 'wy', 'wz', 'vx', 'vy', 'vz')
        rows.append(('poe', name, dict(zip(keys, screw, strict=True))))
    return [*rows, ('poe', 'home', _placed(axes.tool))]


def _placed(T: FloatArray) -> dict[str, float]:
    """Position, m, and roll, pitch, yaw, rad, of a pose (4, 4), by 'x', 'y', 'z', 'roll', …."""
    values = (*T[:3, 3].tolist(), *rpy_of(T[:3, :3]))
    return dict(zip(('x', 'y', 'z', 'roll', 'pitch', 'yaw'), values, strict=True))
