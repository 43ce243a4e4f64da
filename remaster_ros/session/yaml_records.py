"""Records of YAML files, each declared once: a msgspec struct with the bounds of its numbers.

Bounds stand in the annotation of a field and hold for every number in it::

    class Marker(msgspec.Struct, forbid_unknown_fields=True):
        position_m: Annotated[Triple, Bounds(-10.0, 10.0, 'm')]

They are not msgspec's own (`msgspec.Meta`), whose messages leave out the keys of dictionaries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec
import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.session.files import decode_text
from remaster_ros.session.safe_yaml import YamlError, load_yaml
from remaster_ros.session.yaml_places import explained, with_line
from remaster_ros.types import BasePrior

YAML_LIMIT = 256 * 1024

Triple = tuple[float, float, float]
Record = TypeVar('Record', bound=msgspec.Struct)


@dataclass(frozen=True)
class Bounds:
    """What a number of a file may be; in any case it is finite.

    Attributes
    ----------
    least, most
        Smallest and largest value.
    unit
        Of the number. Beyond `most` m, or below `least` degrees, the message gives the value as
        it is if it was written in millimetres or radians.
    above
        Whether `least` itself is refused.
    remedy
        Further text of the message.
    """

    least: float = -math.inf
    most: float = math.inf
    unit: str = ''
    above: bool = False
    remedy: str = ''

    def problem(self, key: str, value: float) -> str:
        """Return what is wrong with a value, in one line with the remedy; '' where nothing is."""
        if not math.isfinite(value):
            return f'{key}: {value} is not a finite number; correct it'
        if self.least < value <= self.most or (value == self.least and not self.above):
            return ''
        limits = [f'above {self.least:g}' if self.above else f'from {self.least:g}']
        if math.isfinite(self.most):
            limits.append(f'to {self.most:g}')
        text = f'{key} is {value:g}; it must be {" ".join((*limits, self.unit)).rstrip()}'
        if self.unit == 'm' and abs(value) > self.most:
            text += f'; if millimetres were meant, write {value / 1e3:g}'
        elif self.unit == 'degrees' and 0.0 < value < self.least:
            text += f'; if radians were meant, write {math.degrees(value):.4g}'
        return text + self.remedy


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


def read_yaml(data: bytes, path: Path, record: type[Record], remedy: str = '') -> Record:
    """Read a YAML file into a record, its numbers within their bounds.

    Parameters
    ----------
    data, path
        The file's bytes, and its name for messages.
    record
        The struct.
    remedy
        Appended to what msgspec reports of missing keys and wrong types.

    Raises
    ------
    InputError
        One line naming file, line or key, and the remedy.
    """
    text = decode_text(data, path)
    try:
        content = msgspec.convert(load_yaml(text), record)
    except YamlError as error:
        raise InputError(f'{path}: {error}{remedy}') from None
    except msgspec.ValidationError as error:
        raise InputError(f'{path}: {explained(text, record, str(error))}{remedy}') from None
    if problem := out_of_bounds(content):
        raise InputError(f'{path}: {with_line(text, problem)}')
    return content


def out_of_bounds(value: Any, key: str = '', bounds: Bounds = Bounds()) -> str:
    """Return what is wrong with the first number that its bounds refuse; '' where none is.

    Parameters
    ----------
    value
        A record or a part of one.
    key
        Where it stands, dotted.
    bounds
        Of the field that it is in.
    """
    if isinstance(value, float):
        return bounds.problem(key, value)
    parts: list[tuple[str, Any, Bounds]] = []
    if isinstance(value, msgspec.Struct):
        for name, hint in get_type_hints(type(value), include_extras=True).items():
            (declared,) = getattr(hint, '__metadata__', (Bounds(),))
            parts.append((name, getattr(value, name), declared))
    elif isinstance(value, dict):
        parts = [(str(name), inner, bounds) for name, inner in value.items()]
    elif isinstance(value, list | tuple):
        parts = [('', inner, bounds) for inner in value]
    problems = (out_of_bounds(inner, f'{key}.{name}'.strip('.'), at) for name, inner, at in parts)
    return next(filter(None, problems), '')
