"""Cell files (config/cells/*.yaml): the arm, the markers on its tool, the sensors."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from math import isfinite, radians
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from remaster_ros.core.chain import SerialChain
from remaster_ros.core.errors import InputError
from remaster_ros.core.planning import LineOfSight, PoseRanges
from remaster_ros.core.types import FloatArray
from remaster_ros.storage.files import decode_text, read_limited
from remaster_ros.storage.safe_yaml import YamlError, load_yaml

YAML_LIMIT = 256 * 1024
URDF_LIMIT = 16 * 1024**2


class CellRobot(msgspec.Struct, forbid_unknown_fields=True):
    """The arm of a cell; `urdf` is relative to the cell file."""

    urdf: str
    base_link: str | None = None
    tip_link: str | None = None


class CellSensor(msgspec.Struct, forbid_unknown_fields=True):
    """A sensor of a cell.

    Attributes
    ----------
    marker
        The marker it follows.
    topic
        Where its readings are published (geometry_msgs/PointStamped, sensor frame); relative to
        the nodes' namespace, unless it begins with ``/``.
    rough_position_m
        Where it stands in the robot base, roughly.
    single_shot
        True for an instrument that measures on request.
    measure_service
        The service (std_srvs/Trigger) that makes it measure.
    max_angle_deg
        Largest angle between the tool's z axis and the line to the sensor at which the marker
        is seen.
    """

    marker: str
    topic: str
    rough_position_m: tuple[float, float, float]
    single_shot: bool = False
    measure_service: str = ''
    max_angle_deg: float = 60.0


class CellPoses(msgspec.Struct, forbid_unknown_fields=True):
    """Ranges of the Latin hypercube of poses."""

    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    radius_m: tuple[float, float] = (0.2, 0.5)
    height_m: tuple[float, float] = (0.4, 0.8)
    roll_deg: tuple[float, float] = (0.0, 360.0)

    def ranges(self) -> PoseRanges:
        """Return the ranges in SI units."""
        return PoseRanges(
            azimuth_rad=(radians(self.azimuth_deg[0]), radians(self.azimuth_deg[1])),
            radius_m=self.radius_m,
            height_m=self.height_m,
            roll_rad=(radians(self.roll_deg[0]), radians(self.roll_deg[1])),
        )


class Cell(msgspec.Struct, forbid_unknown_fields=True):
    """A cell file; see config/cells/demo.yaml for what each key means."""

    robot: CellRobot
    markers: dict[str, tuple[float, float, float]]
    sensors: dict[str, CellSensor]
    aim_at: str
    marker_std_m: float = 0.5e-3
    held_joint: str = ''
    held_values_deg: list[float] = []
    poses: CellPoses = msgspec.field(default_factory=CellPoses)
    link_radius_m: float = 0.075
    urdf_text: str = ''

    def chain(self) -> SerialChain:
        """Build the arm's kinematic chain."""
        return SerialChain.from_urdf(self.urdf_text, self.robot.base_link, self.robot.tip_link)

    def held(self, chain: SerialChain) -> dict[int, tuple[float, ...]] | None:
        """Return the held joint's index and values (rad), or None."""
        if not self.held_joint:
            return None
        index = chain.joint_names.index(self.held_joint)
        return {index: tuple(np.deg2rad(self.held_values_deg))}

    def lines_of_sight(self, sensors_R: Mapping[str, FloatArray]) -> list[LineOfSight]:
        """Return what every pose must keep free, for sensors at these origins in R, m, (3,)."""
        return [
            LineOfSight(
                name,
                sensors_R[name],
                np.array(self.markers[sensor.marker]),
                radians(sensor.max_angle_deg),
            )
            for name, sensor in self.sensors.items()
            if name in sensors_R
        ]


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


def read_cell(path: str | Path) -> Cell:
    """Read and check a cell file.

    Parameters
    ----------
    path
        The file; a bare name such as ``demo`` means the shipped config/cells/demo.yaml.

    Raises
    ------
    InputError
        Naming the file, the key and the remedy.
    """
    path = Path(path)
    if not path.suffix and not path.exists():
        path = config_path(f'cells/{path}.yaml')
    try:
        data = load_yaml(decode_text(read_limited(path, YAML_LIMIT, 'name a cell file'), path))
        cell = msgspec.convert(data, Cell)
    except (YamlError, msgspec.ValidationError) as error:
        raise InputError(f'{path}: {error}') from None
    urdf = path.parent / cell.robot.urdf
    cell.urdf_text = decode_text(
        read_limited(urdf, URDF_LIMIT, f'robot.urdf in {path} names it'), urdf
    )
    _check(path, cell)
    return cell


def _check(path: Path, cell: Cell) -> None:
    """Refuse names that point nowhere and values that cannot be."""
    _require_finite(path, '', msgspec.to_builtins(cell))
    names = cell.chain().joint_names
    if cell.held_joint and cell.held_joint not in names:
        raise InputError(f'{path}: held_joint {cell.held_joint!r} is none of {", ".join(names)}')
    if cell.held_joint and not cell.held_values_deg:
        raise InputError(f'{path}: held_values_deg is empty; give at least one angle')
    if not cell.sensors:
        raise InputError(f'{path}: sensors is empty; name at least one')
    for name, sensor in cell.sensors.items():
        if sensor.marker not in cell.markers:
            known = ', '.join(cell.markers)
            raise InputError(
                f'{path}: sensor {name} follows marker {sensor.marker!r}; markers has {known}'
            )
    if cell.aim_at not in cell.sensors:
        raise InputError(
            f'{path}: aim_at {cell.aim_at!r} is none of the sensors {", ".join(cell.sensors)}'
        )
    if not (cell.marker_std_m > 0 and cell.link_radius_m > 0):
        raise InputError(f'{path}: marker_std_m and link_radius_m must be positive')


def _require_finite(path: Path, key: str, value: Any) -> None:
    """Refuse a number that is none, wherever it stands."""
    if isinstance(value, dict):
        for name, inner in value.items():
            _require_finite(path, f'{key}.{name}'.lstrip('.'), inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            _require_finite(path, key, inner)
    elif isinstance(value, float) and not isfinite(value):
        raise InputError(f'{path}: {key}: {value} is not a finite number; correct it')
