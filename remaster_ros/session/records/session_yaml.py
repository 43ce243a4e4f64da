# SPDX-License-Identifier: Apache-2.0
"""session.yaml: robot, markers, sensors and conditions of a session (``remaster-session/1``)."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from remaster_ros.bounds import Bounds, Triple
from remaster_ros.errors import InputError
from remaster_ros.kinematics.pad_angles import coupled_in_circle
from remaster_ros.session.files import decode_text
from remaster_ros.session.strict_yaml import YamlError, dump_yaml, load_yaml
from remaster_ros.session.yaml_records import out_of_bounds, to_plain
from remaster_ros.types import (
    AccuracyOption,
    BasePrior,
    Controller,
    Correction,
    Measurements,
    PadJoint,
    SensorKind,
    Session,
)

FORMAT = 'remaster-session/1'
# Of an arm that moved while it was measured. A program that knows no dynamics refuses it.
FORMAT_MOVING = 'remaster-session/1.1'
ExitStatus = Literal['complete', 'stopped', 'aborted']
MARKER_STD = Bounds(0.0, 0.4, 'm', remedy='; 0.3 where nothing is known of their places')
ZERO = Bounds(-360.0, 360.0, 'degrees')
PRIORS_HELP = '; see "Priors" in docs/statistics.md'

log = logging.getLogger('remaster_ros')


class _Robot(msgspec.Struct):
    """Key ``robot`` of session.yaml: URDF file, base link and tip link."""

    urdf: str
    base_link: str
    tip_link: str


class _Sensor(msgspec.Struct):
    """A sensor in session.yaml: markers, kind, whether it is on the tool or measures poses."""

    marker: str
    further_markers: tuple[str, ...] = ()
    orientation: bool = False
    mounted_on: Literal['', 'tool'] = ''
    kind: Literal['', SensorKind] = ''


class BaseFrame(msgspec.Struct):
    """Prior of a sensor's registration (its frame in the robot base), as written in files."""

    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: float
    std_rad: float

    def problem(self, key: str) -> str:
        """Return the error of a quaternion whose norm is off 1 by over 0.001; '' if it is valid.

        ``key``: path of this prior in the file, at the beginning of the message.
        """
        norm = math.hypot(*self.rotation_xyzw)
        if abs(norm - 1.0) < 1e-3:
            return ''
        return f'{key}.rotation_xyzw has norm {norm:.6g}, not 1; give a unit quaternion x, y, z, w'

    def prior(self) -> BasePrior:
        """Return the prior for the fit, its quaternion normalised."""
        rotation = np.array(self.rotation_xyzw) / np.linalg.norm(self.rotation_xyzw)
        return BasePrior(np.array(self.translation_m), rotation, self.std_m, self.std_rad)


class SessionHeader(msgspec.Struct):
    """Validated content of session.yaml; the fields are the keys of the file."""

    format: str
    robot: _Robot
    markers: dict[str, Triple]
    sensors: dict[str, _Sensor]
    settle_s: Annotated[float | None, Bounds(0.0, unit='s')] = None
    times: Literal['', 'none'] = ''
    marker_std_m: Annotated[float, MARKER_STD] = 0.5e-3
    base_prior: dict[str, BaseFrame] = {}
    exit_status: Literal['', ExitStatus] = ''
    created: str = ''
    operator: str = ''
    serial_number: str = ''
    notes: str = ''
    controller: Controller | None = None
    correction: Correction | None = None
    accuracy_option: AccuracyOption = ''
    clock_offset_s: dict[str, float] = {}
    # Keys unknown to this version, nested as in the file.
    extra: dict[str, Any] = {}

    @property
    def is_moving(self) -> bool:
        """Whether markers were measured while the arm moved."""
        return self.format == FORMAT_MOVING

    @property
    def on_tool(self) -> frozenset[str]:
        """Names of the sensors on the tool."""
        return frozenset(name for name, sensor in self.sensors.items() if sensor.mounted_on)

    def session(
        self, urdf: str, measurements: Measurements, references: Measurements | None = None
    ) -> Session:
        """Return a session of this header and the given rows.

        ``urdf``: text; ``references``: rows of the reference configurations, None for none.
        """
        return Session(
            urdf=urdf,
            base_link=self.robot.base_link,
            tip_link=self.robot.tip_link,
            markers={name: np.array(position) for name, position in self.markers.items()},
            sensors={name: sensor.marker for name, sensor in self.sensors.items()},
            further_markers={
                name: sensor.further_markers
                for name, sensor in self.sensors.items()
                if sensor.further_markers
            },
            oriented=frozenset(
                name
                for name, sensor in self.sensors.items()
                if sensor.orientation or sensor.mounted_on
            ),
            on_tool=self.on_tool,
            sensor_kinds={
                name: sensor.kind for name, sensor in self.sensors.items() if sensor.kind
            },
            measurements=measurements,
            marker_std_m=self.marker_std_m,
            settle_s=self.settle_s,
            timed=self.times != 'none',
            base_prior={sensor: base.prior() for sensor, base in self.base_prior.items()},
            exit_status=self.exit_status,
            notes=self.notes,
            created=self.created,
            operator=self.operator,
            serial_number=self.serial_number,
            extra=self.extra,
            controller=self.controller,
            correction=self.correction,
            accuracy_option=self.accuracy_option,
            references=references,
            clock_offset_s=self.clock_offset_s,
        )


def parse_header(data: bytes, path: Path) -> SessionHeader:
    """Parse session.yaml; unknown keys are kept in ``extra``, with a warning.

    ``path``: for messages. Raises InputError, naming the key, if the content is invalid or of
    another format.
    """
    try:
        content = load_yaml(decode_text(data, path))
    except YamlError as error:
        raise InputError(f'{path}: {error}') from None
    found = content.get('format') if isinstance(content, dict) else None
    if not isinstance(content, dict) or found not in (FORMAT, FORMAT_MOVING):
        raise InputError(
            f"{path}: key 'format' is {str(found)[:60]!r}, not {FORMAT!r}; "
            'this version reads no other format'
        )
    header = _checked(content, f'{path}: ')
    known = msgspec.to_builtins(header)
    # A field of the struct, but no key of the file: `extra` in a file is an unknown key.
    del known['extra']
    header.extra = _unknown_keys(content, known, path)
    return header


def write_header(session: Session, urdf_name: str, exit_status: str) -> str:
    """Return the text of session.yaml; keys without a value are left out.

    ``urdf_name``: file inside the session folder; ``exit_status``: in place of the session's.
    Raises InputError if the session breaks the format.
    """
    content: dict[str, Any] = {
        'format': FORMAT_MOVING if session.is_moving else FORMAT,
        'robot': {
            'urdf': urdf_name,
            'base_link': session.base_link,
            'tip_link': session.tip_link,
        },
        'markers': session.markers,
        'sensors': {
            name: {
                'marker': marker,
                'further_markers': session.further_markers.get(name, ()),
                'orientation': name in session.oriented,
                'mounted_on': 'tool' if name in session.on_tool else '',
                'kind': session.sensor_kinds.get(name, ''),
            }
            for name, marker in session.sensors.items()
        },
        'settle_s': session.settle_s,
        'times': '' if session.timed else 'none',
        'marker_std_m': session.marker_std_m,
        'base_prior': session.base_prior,
        'exit_status': exit_status,
        'created': session.created,
        'operator': session.operator,
        'serial_number': session.serial_number,
        'notes': session.notes,
        'controller': session.controller,
        'correction': session.correction,
        'accuracy_option': session.accuracy_option,
        'clock_offset_s': session.clock_offset_s,
    }
    header = _checked(to_plain(content), 'session to be written: ')
    given = {key: value for key, value in to_plain(header).items() if value not in ('', {}, None)}
    for sensor in given['sensors'].values():
        for key in ('further_markers', 'orientation', 'mounted_on', 'kind'):
            if not sensor[key]:
                del sensor[key]
    if controller := given.get('controller'):
        plain = msgspec.to_builtins(PadJoint(''))
        for name, joint in controller['joints'].items():
            controller['joints'][name] = {
                key: value for key, value in joint.items() if value != plain[key]
            }
        if not controller['maker']:
            del controller['maker']
    return dump_yaml(_merge(given, session.extra))


def with_exit_status(text: str, exit_status: str) -> str:
    """Return the text of a session.yaml with another exit status; comments are lost."""
    return dump_yaml({**load_yaml(text), 'exit_status': exit_status})


def with_correction(text: str, correction: Correction) -> str:
    """Return the text of a session.yaml with a correction added or replaced; comments are lost."""
    return dump_yaml({**load_yaml(text), 'correction': to_plain(correction)})


def _checked(content: Mapping[str, Any], where: str) -> SessionHeader:
    """Return the header in ``content``, checked; the key 'extra' is dropped.

    Raises InputError, which begins with ``where``, for an invalid key, number or name.
    """
    known = {key: value for key, value in content.items() if key != 'extra'}
    try:
        header = msgspec.convert(known, SessionHeader)
    except msgspec.ValidationError as error:
        raise InputError(f'{where}{error}; see docs/session-format.md') from None
    if problem := out_of_bounds(header) or _problem(header):
        raise InputError(f'{where}{problem}')
    return header


def _problem(header: SessionHeader) -> str:
    """First error in names of files, markers, sensors and joints or in times, with the remedy.

    '' if valid.
    """
    urdf = PurePosixPath(header.robot.urdf)
    if urdf.is_absolute() or '..' in urdf.parts or not urdf.name or '\0' in header.robot.urdf:
        return (
            f'robot.urdf: {header.robot.urdf!r} is not a file inside the session folder; '
            'copy the URDF there'
        )
    for kind, names in (('markers', list(header.markers)), ('sensors', list(header.sensors))):
        if not names:
            return f'{kind}: none given; name at least one'
        for name in names:
            if not name or name != name.strip() or any(c in name for c in ',"\r\n\0'):
                return f'{kind}: {name!r} is no usable name; leave out commas, quotes and blanks'
    for sensor, entry in header.sensors.items():
        named = [('marker', entry.marker)]
        named += [('further_markers', name) for name in entry.further_markers]
        for key, marker in named:
            if marker not in header.markers:
                return (
                    f'sensors.{sensor}.{key}: {marker!r} is not among the markers '
                    f'({", ".join(header.markers)}); correct the name'
                )
    for sensor in header.on_tool:
        entry = header.sensors[sensor]
        other_sensors = [
            other
            for other, its in header.sensors.items()
            if other != sensor and entry.marker in (its.marker, *its.further_markers)
        ]
        if entry.further_markers or other_sensors:
            return (
                f'sensors.{sensor}: of a sensor on the tool the marker is its own origin there; '
                f'give it one of its own, which no other sensor has'
            )
    for sensor, base in header.base_prior.items():
        if sensor not in header.sensors:
            known = ', '.join(header.sensors)
            return f'base_prior.{sensor}: no such sensor ({known}); correct the name'
        if problem := base.problem(f'base_prior.{sensor}'):
            return problem
    for sensor in header.clock_offset_s:
        if sensor not in header.sensors:
            known = ', '.join(header.sensors)
            return f'clock_offset_s.{sensor}: no such sensor ({known}); correct the name'
    if header.controller is not None and (problem := _controller_problem(header.controller)):
        return problem
    if header.created:
        try:
            datetime.fromisoformat(header.created)
        except ValueError:
            return f'created: {header.created[:60]!r} is not an ISO 8601 time; correct it'
    return ''


def _controller_problem(controller: Controller) -> str:
    """First error in the joints as the teach pendant counts them; '' if valid.

    Checked are their names, zeros and couplings.
    """
    if not controller.joints:
        return 'controller.joints: none given; name the joints of the URDF, or leave it out'
    names = [joint.name for joint in controller.joints.values()]
    for joint, pad in controller.joints.items():
        key = f'controller.joints.{joint}'
        if not pad.name.strip() or any(letter in pad.name for letter in '\r\n\0'):
            return f'{key}.name: {pad.name!r} is no usable name; give that on the pad'
        if names.count(pad.name) > 1:
            return f'{key}.name: {pad.name!r} is given to two joints; correct one'
        if problem := ZERO.problem(f'{key}.zero_deg', pad.zero_deg):
            return problem
        for other in pad.coupling:
            if other not in controller.joints:
                known = ', '.join(controller.joints)
                return f'{key}.coupling: {other!r} is not among the joints ({known}); correct it'
    if in_circle := coupled_in_circle({n: j.coupling for n, j in controller.joints.items()}):
        return (
            f'controller.joints.{in_circle}.coupling: the joint is coupled to itself, directly or '
            'by way of others; correct it'
        )
    return ''


def require_known_joints(header: SessionHeader, joint_names: Sequence[str], path: Path) -> None:
    """Raise InputError if the key ``controller`` has a joint that the URDF lacks.

    `joint_names`: of the URDF; `path`: of session.yaml, for the message.
    """
    for name in header.controller.joints if header.controller is not None else ():
        if name not in joint_names:
            raise InputError(
                f"{path}: controller.joints: {name!r} is not among the URDF's joints "
                f'({", ".join(joint_names)}); correct the name'
            )


def _unknown_keys(
    content: Mapping[str, Any], known: Mapping[str, Any], path: Path, prefix: str = ''
) -> dict[str, Any]:
    """Return the part of nested dictionaries whose keys ``known`` lacks, with a warning for each.

    ``known``: dictionaries with all known keys; ``prefix``: dotted path of ``content`` in the
    file, for the warning.
    """
    extra = {}
    for key, value in content.items():
        if key not in known:
            log.warning('%s: unknown key %r is kept, and not used', path, f'{prefix}{key}')
            extra[key] = value
        elif isinstance(value, dict):
            extra[key] = _unknown_keys(value, known[key], path, f'{prefix}{key}.')
    return {key: value for key, value in extra.items() if key not in known or value}


def _merge(content: dict[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of ``content`` with the keys of ``extra`` that it lacks.

    Keys that it has keep their values; if both values are mappings, they are merged in the
    same way, at every level.
    """
    merged = dict(content)
    for key, value in extra.items():
        if key not in merged:
            merged[key] = value
        elif isinstance(merged[key], dict) and isinstance(value, Mapping):
            merged[key] = _merge(merged[key], value)
    return merged
