"""session.yaml: what was measured, with what, on which robot (format ``remaster-session/1``)."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text
from remaster_ros.session.safe_yaml import YamlError, dump_yaml, load_yaml
from remaster_ros.types import BasePrior, Session

FORMAT = 'remaster-session/1'
YAML_LIMIT = 256 * 1024
LARGEST_MARKER_STD_M = 0.4
"""A session may say that the nominal places of its markers tell nothing, m."""

log = logging.getLogger('remaster_ros')

Triple = tuple[float, float, float]


class _Robot(msgspec.Struct):
    urdf: str
    base_link: str
    tip_link: str


class _Sensor(msgspec.Struct):
    marker: str


class _BasePrior(msgspec.Struct):
    translation_m: Triple
    rotation_xyzw: tuple[float, float, float, float]
    std_m: float
    std_rad: float


class SessionHeader(msgspec.Struct):
    """session.yaml as validated; the fields are the keys of the file.

    ``extra`` holds the keys this version does not know, nested as they were.
    """

    format: str
    robot: _Robot
    markers: dict[str, Triple]
    sensors: dict[str, _Sensor]
    settle_s: float
    marker_std_m: float = 0.5e-3
    base_prior: dict[str, _BasePrior] = {}
    exit_status: Literal['', 'complete', 'stopped', 'aborted'] = ''
    notes: str = ''
    created: str = ''
    extra: dict[str, Any] = {}

    def priors(self) -> dict[str, BasePrior]:
        """Return the known registrations, quaternions normalised."""
        priors = {}
        for sensor, prior in self.base_prior.items():
            rotation = np.array(prior.rotation_xyzw)
            priors[sensor] = BasePrior(
                translation_m=np.array(prior.translation_m),
                rotation_xyzw=rotation / np.linalg.norm(rotation),
                std_m=prior.std_m,
                std_rad=prior.std_rad,
            )
        return priors


def parse_header(data: bytes, path: Path) -> SessionHeader:
    """Check the content of session.yaml; `path` is for messages.

    Raises
    ------
    InputError
        One line naming file, line or key, and the remedy.
    """
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
    # Known to the struct, but no key of the file: a file's own `extra` is an unknown key.
    known = {key: value for key, value in content.items() if key != 'extra'}
    try:
        header = msgspec.convert(known, SessionHeader)
    except msgspec.ValidationError as error:
        raise InputError(f'{path}: {error}; see the session format') from None
    problem = _problem(header)
    if problem:
        raise InputError(f'{path}: {problem}')
    header.extra = _unknown_keys(content)
    for key in _paths(header.extra):
        log.warning('%s: unknown key %r is kept, and not used', path, key)
    return header


def write_header(session: Session, urdf_name: str, exit_status: str) -> str:
    """Return the text of session.yaml for a session.

    Raises
    ------
    InputError
        The session has names or numbers that the format does not allow.
    """
    content: dict[str, Any] = {
        'format': FORMAT,
        'robot': {
            'urdf': urdf_name,
            'base_link': session.base_link,
            'tip_link': session.tip_link,
        },
        'markers': {name: _floats(position) for name, position in session.markers.items()},
        'sensors': {name: {'marker': marker} for name, marker in session.sensors.items()},
        'settle_s': float(session.settle_s),
        'marker_std_m': float(session.marker_std_m),
    }
    if session.base_prior:
        content['base_prior'] = {
            sensor: {
                'translation_m': _floats(prior.translation_m),
                'rotation_xyzw': _floats(prior.rotation_xyzw),
                'std_m': float(prior.std_m),
                'std_rad': float(prior.std_rad),
            }
            for sensor, prior in session.base_prior.items()
        }
    for key, value in (
        ('exit_status', exit_status),
        ('created', session.created),
        ('notes', session.notes),
    ):
        if value:
            content[key] = value
    try:
        problem = _problem(msgspec.convert(content, SessionHeader))
    except msgspec.ValidationError as error:
        problem = str(error)
    if problem:
        raise InputError(f'session to be written: {problem}')
    return dump_yaml(_merge(content, session.extra))


def _problem(header: SessionHeader) -> str:
    """Return what is wrong with the values, in one line with the remedy; '' where nothing is."""
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
    for marker, position in header.markers.items():
        if not all(map(math.isfinite, position)):
            return f'markers.{marker}: {position} is not finite; give x, y, z in metres'
    for sensor, entry in header.sensors.items():
        if entry.marker not in header.markers:
            return (
                f'sensors.{sensor}.marker: {entry.marker!r} is not among the markers '
                f'({", ".join(header.markers)}); correct the name'
            )
    if header.marker_std_m > LARGEST_MARKER_STD_M:
        return (
            f'marker_std_m: {header.marker_std_m:g} m is no marker on a tool; if millimetres were '
            f'meant, write {header.marker_std_m:g}e-3; 0.3 says that nothing is known'
        )
    numbers = {'settle_s': header.settle_s, 'marker_std_m': header.marker_std_m}
    for sensor, prior in header.base_prior.items():
        where = f'base_prior.{sensor}'
        if sensor not in header.sensors:
            return f'{where}: no such sensor ({", ".join(header.sensors)}); correct the name'
        if not all(map(math.isfinite, prior.translation_m)):
            return f'{where}.translation_m: not finite; give x, y, z in metres'
        norm = math.hypot(*prior.rotation_xyzw)
        if not abs(norm - 1.0) < 1e-3:
            return f'{where}.rotation_xyzw: norm {norm:.6g}, not 1; give a unit quaternion'
        numbers |= {f'{where}.std_m': prior.std_m, f'{where}.std_rad': prior.std_rad}
    for key, number in numbers.items():
        if not (math.isfinite(number) and number >= 0):
            return f'{key}: {number} is not a finite number of at least 0; correct it'
    if header.created:
        try:
            datetime.fromisoformat(header.created)
        except ValueError:
            return f'created: {header.created[:60]!r} is not an ISO 8601 time; correct it'
    return ''


def _unknown_keys(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the format does not name, nested as in the file."""

    def unknown(value: Any, struct: type[msgspec.Struct]) -> dict[str, Any]:
        return {k: v for k, v in value.items() if k not in struct.__struct_fields__}

    extra = unknown(content, SessionHeader)
    if 'extra' in content:
        extra['extra'] = content['extra']
    if robot := unknown(content['robot'], _Robot):
        extra['robot'] = robot
    for key, struct in (('sensors', _Sensor), ('base_prior', _BasePrior)):
        for name, value in content.get(key, {}).items():
            if entry := unknown(value, struct):
                extra.setdefault(key, {})[name] = entry
    return extra


def _paths(extra: Mapping[str, Any], depth: int = 0, prefix: str = '') -> list[str]:
    """Return the dotted names of unknown keys; known parents are not themselves unknown."""
    nested = {'robot': 1, 'sensors': 2, 'base_prior': 2}
    paths = []
    for key, value in extra.items():
        levels = nested.get(key, 0) if not prefix else depth
        if levels:
            paths += _paths(value, levels - 1, f'{prefix}{key}.')
        else:
            paths.append(f'{prefix}{key}')
    return paths


def _merge(content: dict[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Put the unknown keys back where they came from; a known key always wins."""
    merged = dict(content)
    for key, value in extra.items():
        if key not in merged:
            merged[key] = value
        elif isinstance(merged[key], dict) and isinstance(value, Mapping):
            merged[key] = _merge(merged[key], value)
    return merged


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]
