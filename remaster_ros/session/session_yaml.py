# SPDX-License-Identifier: Apache-2.0
"""session.yaml: what was measured, with what, on which robot (format ``remaster-session/1``).

And the file of priors, which has the same base frames.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.pad_angles import coupled_in_circle
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.yaml_records import (
    YAML_LIMIT,
    Bounds,
    Triple,
    YamlError,
    dump_yaml,
    load_yaml,
    out_of_bounds,
    read_yaml,
    to_plain,
)
from remaster_ros.types import (
    AccuracyOption,
    BasePrior,
    Controller,
    Correction,
    Measurements,
    PadJoint,
    Priors,
    Session,
)

FORMAT = 'remaster-session/1'
ExitStatus = Literal['complete', 'stopped', 'aborted']
MARKER_STD = Bounds(0.0, 0.4, 'm', remedy='; 0.3 where nothing is known of their places')
ZERO = Bounds(-360.0, 360.0, 'degrees')
PRIORS_HELP = '; see "Priors" in docs/statistics.md'

log = logging.getLogger('remaster_ros')


class _Robot(msgspec.Struct):
    urdf: str
    base_link: str
    tip_link: str


class _Sensor(msgspec.Struct):
    marker: str
    further_markers: tuple[str, ...] = ()
    orientation: bool = False
    mounted_on: Literal['', 'tool'] = ''


class BaseFrame(msgspec.Struct):
    """A registration known beforehand, as files have it; see `BasePrior`."""

    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: float
    std_rad: float

    def problem(self, key: str) -> str:
        """Return what is wrong with the quaternion; '' where nothing is."""
        norm = math.hypot(*self.rotation_xyzw)
        if abs(norm - 1.0) < 1e-3:
            return ''
        return f'{key}.rotation_xyzw has norm {norm:.6g}, not 1; give a unit quaternion x, y, z, w'

    def prior(self) -> BasePrior:
        """Return it for the fit, the quaternion normalised."""
        rotation = np.array(self.rotation_xyzw) / np.linalg.norm(self.rotation_xyzw)
        return BasePrior(np.array(self.translation_m), rotation, self.std_m, self.std_rad)


class SessionHeader(msgspec.Struct):
    """session.yaml as validated; the fields are the keys of the file."""

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
    # The keys that this version does not use, nested as they were.
    extra: dict[str, Any] = {}

    @property
    def on_tool(self) -> frozenset[str]:
        """Sensors on the tool."""
        return frozenset(name for name, sensor in self.sensors.items() if sensor.mounted_on)

    def session(
        self, urdf: str, measurements: Measurements, references: Measurements | None = None
    ) -> Session:
        """Return the session with this header, the robot and the rows."""
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
        )


def parse_header(data: bytes, path: Path) -> SessionHeader:
    """Check the content of session.yaml; `path` is for messages."""
    try:
        content = load_yaml(decode_text(data, path))
    except YamlError as error:
        raise InputError(f'{path}: {error}') from None
    if not isinstance(content, dict) or content.get('format') != FORMAT:
        found = content.get('format') if isinstance(content, dict) else None
        raise InputError(
            f"{path}: key 'format' is {str(found)[:60]!r}, not {FORMAT!r}; "
            'this version reads no other format'
        )
    header = _checked(content, f'{path}: ')
    known = msgspec.to_builtins(header)
    # Known to the struct, but no key of the file: a file's own `extra` is an unknown key.
    del known['extra']
    header.extra = _unknown_keys(content, known, path)
    return header


def write_header(session: Session, urdf_name: str, exit_status: str) -> str:
    """Return the text of session.yaml; an `InputError` for what the format does not allow."""
    content: dict[str, Any] = {
        'format': FORMAT,
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
    }
    header = _checked(to_plain(content), 'session to be written: ')
    given = {key: value for key, value in to_plain(header).items() if value not in ('', {}, None)}
    for sensor in given['sensors'].values():
        for key in ('further_markers', 'orientation', 'mounted_on'):
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
    """Return the text of a session.yaml with another exit status."""
    return dump_yaml({**load_yaml(text), 'exit_status': exit_status})


def with_correction(text: str, correction: Correction) -> str:
    """Return the text of a session.yaml that states a correction."""
    return dump_yaml({**load_yaml(text), 'correction': to_plain(correction)})


def _checked(content: Mapping[str, Any], where: str) -> SessionHeader:
    """Return the header that `content` holds; an `InputError` begins with `where`."""
    known = {key: value for key, value in content.items() if key != 'extra'}
    try:
        header = msgspec.convert(known, SessionHeader)
    except msgspec.ValidationError as error:
        raise InputError(f'{where}{error}; see docs/session-format.md') from None
    if problem := out_of_bounds(header) or _problem(header):
        raise InputError(f'{where}{problem}')
    return header


def _problem(header: SessionHeader) -> str:
    """Return what is wrong with names and times, in one line with the remedy; '' if nothing is."""
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
        others = [
            other
            for other, its in header.sensors.items()
            if other != sensor and entry.marker in (its.marker, *its.further_markers)
        ]
        if entry.further_markers or others:
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
    if header.controller is not None and (problem := _controller_problem(header.controller)):
        return problem
    if header.created:
        try:
            datetime.fromisoformat(header.created)
        except ValueError:
            return f'created: {header.created[:60]!r} is not an ISO 8601 time; correct it'
    return ''


def _controller_problem(controller: Controller) -> str:
    """Return what is wrong with the pad's joints; '' where nothing is."""
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
    """Refuse pad's joints that the URDF has not; `path` is that of session.yaml."""
    for name in header.controller.joints if header.controller is not None else ():
        if name not in joint_names:
            raise InputError(
                f"{path}: controller.joints: {name!r} is not among the URDF's joints "
                f'({", ".join(joint_names)}); correct the name'
            )


def _unknown_keys(
    content: Mapping[str, Any], known: Mapping[str, Any], path: Path, prefix: str = ''
) -> dict[str, Any]:
    """Return what of nested dictionaries `known` has not, nested as it was, with a warning."""
    extra = {}
    for key, value in content.items():
        if key not in known:
            log.warning('%s: unknown key %r is kept, and not used', path, f'{prefix}{key}')
            extra[key] = value
        elif isinstance(value, dict):
            extra[key] = _unknown_keys(value, known[key], path, f'{prefix}{key}.')
    return {key: value for key, value in extra.items() if key not in known or value}


def _merge(content: dict[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Put the unknown keys back where they came from; a known key always wins."""
    merged = dict(content)
    for key, value in extra.items():
        if key not in merged:
            merged[key] = value
        elif isinstance(merged[key], dict) and isinstance(value, Mapping):
            merged[key] = _merge(merged[key], value)
    return merged


# What is known before a fit: offsets, markers, base frames, the drawing.


class _Strict(msgspec.Struct, forbid_unknown_fields=True):
    """A key that is misspelt must not be a prior that is silently missing."""


class _OffsetPrior(_Strict):
    """In degrees, or in mm of a joint that slides."""

    mean_deg: Annotated[float | None, Bounds(-180.0, 180.0, 'degrees')] = None
    std_deg: Annotated[float | None, Bounds(0.0, 180.0, 'degrees', above=True)] = None
    mean_mm: Annotated[float | None, Bounds(-1000.0, 1000.0, 'mm')] = None
    std_mm: Annotated[float | None, Bounds(0.0, 1000.0, 'mm', above=True)] = None

    def known(self, where: str) -> tuple[float, float, bool]:
        """Return mean and std, rad or m, and whether it is m; an `InputError` without a unit."""
        degrees, lengths = (self.mean_deg, self.std_deg), (self.mean_mm, self.std_mm)
        in_m = degrees == (None, None)
        mean, std = lengths if in_m else degrees
        if mean is None or std is None or not (in_m or lengths == (None, None)):
            raise InputError(
                f'{where} has not both of mean_deg and std_deg, or of mean_mm and std_mm where '
                'the joint slides, and nothing else'
            )
        scale = 1e-3 if in_m else float(np.radians(1.0))
        return scale * mean, scale * std, in_m


class _MarkerPrior(_Strict):
    position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1.0, 'm', above=True)]


class _StrictBase(BaseFrame, forbid_unknown_fields=True):
    translation_m: Annotated[Triple, Bounds(-1000.0, 1000.0, 'm')]
    std_m: Annotated[float, Bounds(0.0, 1000.0, 'm', above=True)]
    std_rad: Annotated[float, Bounds(0.0, np.pi, 'rad', above=True)]


class _Priors(_Strict):
    """A file of priors; all keys are optional.

    ::

        joint_offsets: {joint_2: {mean_deg: 0.1, std_deg: 0.05}, rail: {mean_mm: 1, std_mm: 0.5}}
        markers: {sir: {position_m: [0.1, 0.0, 0.02], std_m: 1.0e-4}}
        base: {mocap: {translation_m: [2.0, 0.0, 1.0], rotation_xyzw: [0, 0, 0, 1],
                       std_m: 1.0e-3, std_rad: 1.0e-3}}
        geometry_tolerance_mm: 0.1
    """

    joint_offsets: dict[str, _OffsetPrior] = {}
    markers: dict[str, _MarkerPrior] = {}
    base: dict[str, _StrictBase] = {}
    geometry_tolerance_mm: Annotated[float, Bounds(0.0, 100.0, 'mm', above=True)] = 0.1


def read_priors(path: str | os.PathLike[str]) -> Priors:
    """Read and check a file of priors; the fit checks that the session has these names.

    Raises
    ------
    InputError
        One line naming file, key and remedy.
    """
    path = Path(path)
    data = read_limited(path, YAML_LIMIT, 'give a YAML file of priors')
    content = read_yaml(data, path, _Priors, PRIORS_HELP)
    for sensor, base in content.base.items():
        if problem := base.problem(f'base.{sensor}'):
            raise InputError(f'{path}: {problem}')
    known = {
        joint: prior.known(f'{path}: joint_offsets.{joint}')
        for joint, prior in content.joint_offsets.items()
    }
    return Priors(
        joint_offsets={joint: (mean, std) for joint, (mean, std, _) in known.items()},
        in_m=frozenset(joint for joint, (_, _, in_m) in known.items() if in_m),
        markers={
            marker: (np.array(prior.position_m), prior.std_m)
            for marker, prior in content.markers.items()
        },
        base={sensor: base.prior() for sensor, base in content.base.items()},
        geometry_tolerance_m=1e-3 * content.geometry_tolerance_mm,
    )
