"""What fit.json holds, and discovery.json shares with it: each key once, to write and to read.

A key without a default is what other programs rely on, and a file without it is refused. One that
is `UNSET` by default is written where it has a value; the files of other programs may lack it.
Keys that are not here are kept as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from remaster_ros.reports.schema_parts import (
    Accuracy,
    GaugeCombination,
    JointOffset,
    LeftOut,
    Marker,
    MeasuredSession,
    Noise,
    NoiseCheck,
    Registration,
    Robot,
    SampledParameter,
    Sampler,
    StructureTest,
)

FIT_FORMAT = 'remaster-fit/1'
DISCOVERY_FORMAT = 'remaster-discovery/1'

Content = TypeVar('Content', bound=Struct)


class Fit(Struct):
    """fit.json.

    ``intervals`` is 'model' where those of the offsets are the posterior's, 'robust' where they
    are wider because errors are left that the model has not.
    """

    format: str
    joint_offsets: list[JointOffset]
    gauge: list[GaugeCombination]
    registration: dict[str, Registration]
    markers: dict[str, Marker]
    noise: dict[str, Noise]
    sampler: Sampler
    accuracy: Accuracy
    left_out: list[LeftOut]
    version: str | UnsetType = UNSET
    robot: Robot | UnsetType = UNSET
    session: MeasuredSession | UnsetType = UNSET
    parameters: list[SampledParameter] | UnsetType = UNSET
    explained_by_noise: dict[str, NoiseCheck] | UnsetType = UNSET
    residual_structure: list[StructureTest] | UnsetType = UNSET
    intervals: Literal['model', 'robust'] | UnsetType = UNSET


def checked(content: Mapping[str, Any], schema: type[Content]) -> Content:
    """Return a file's content by its schema: arrays as lists, NaN as None, other keys left out.

    Raises
    ------
    msgspec.ValidationError
        A key that other programs rely on is missing or of another type.
    """
    return msgspec.json.decode(msgspec.json.encode(content, enc_hook=_plain), type=schema)


def _plain(values: Any) -> Any:
    if isinstance(values, np.ndarray | np.generic):
        return values.tolist()
    if isinstance(values, Mapping):
        return dict(values)
    raise NotImplementedError(f'no JSON for {type(values)}')


def encode(content: Struct) -> bytes:
    """Return a file's bytes, indented."""
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b'\n'
