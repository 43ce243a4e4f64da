"""A session from a known truth: for users, for quick checks, for calibration studies.

Poses come in as joint solutions; nothing is planned here. The truth goes out in a record of its
own, which no estimator takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

DEFAULT_OFFSET_STD = np.radians(0.3)


@dataclass(frozen=True, eq=False)
class SimulatedSensor:
    """A sensor to simulate.

    Attributes
    ----------
    marker
        The marker it follows.
    T_R_N
        Its true frame in the robot base, (4, 4).
    sigma_m
        Error per point and axis, m.
    pose_sigma_m
        Error per axis that all its rows at one pose share, m.
    """

    marker: str
    T_R_N: FloatArray
    sigma_m: float = 0.1e-3
    pose_sigma_m: float = 0.2e-3


@dataclass(frozen=True, eq=False)
class SessionTruth:
    """What a simulated session was made from.

    Attributes
    ----------
    joint_offsets
        rad, (k,).
    markers
        True positions in the tool frame, m, name -> (3,).
    sensors
        As they were asked for: registrations and noise.
    outliers
        ``observation`` of every gross error.
    """

    joint_offsets: FloatArray
    markers: Mapping[str, FloatArray]
    sensors: Mapping[str, SimulatedSensor]
    outliers: tuple[int, ...] = field(default=())


def simulate_session(
    chain: SerialChain,
    urdf: str,
    rng: np.random.Generator,
    *,
    poses: Sequence[FloatArray],
    sensors: Mapping[str, SimulatedSensor],
    markers: Mapping[str, FloatArray],
    validation_poses: Sequence[FloatArray] = (),
    joint_offsets: FloatArray | None = None,
    joint_offset_std: float = DEFAULT_OFFSET_STD,
    marker_std_m: float = 0.5e-3,
    outlier_share: float = 0.0,
    outlier_m: float = 0.02,
    seconds_per_configuration: float = 10.0,
    temperature_c: FloatArray | None = None,
    seen: Callable[[FloatArray, dict[str, FloatArray]], FloatArray] | None = None,
) -> tuple[Session, SessionTruth]:
    """Visit the poses with a robot whose truth is drawn, and measure with noise.

    Parameters
    ----------
    chain, urdf
        The nominal robot and the text it was read from; k joints.
    rng
        Source of all randomness.
    poses, validation_poses
        For each pose its joint solutions in the order visited, rad, (m, k).
    sensors
        By name; at every configuration each gives one observation.
    markers
        Nominal positions in the tool frame, m, (3,); the true ones lie ``marker_std_m`` away.
    joint_offsets
        The true zero-offsets, rad, (k,); where None drawn from N(0, ``joint_offset_std``²).
    outlier_share
        Share of the observations moved by ``outlier_m`` in a random direction.
    temperature_c
        At each configuration, °C, (m,), m over all poses; None where it was not measured.
    seen
        What the sensors see without noise of an arm with these zero-offsets (rad, (k,)) and
        markers (m, name -> (3,)), each in its own frame N: m, (m, sensors, 3). None for an arm
        that has no other errors.

    Returns
    -------
    session, truth
        The session has no more in it than a recorded one.

    Raises
    ------
    InputError
        Solutions of the wrong shape, no poses, or a sensor that follows no known marker.
    """
    for name, sensor in sensors.items():
        if sensor.marker not in markers:
            raise InputError(f"sensor '{name}' follows marker '{sensor.marker}', which is none")
    solutions = [np.atleast_2d(np.asarray(q, dtype=float)) for q in (*poses, *validation_poses)]
    if not sensors or not solutions or any(q.shape[-1] != len(chain) for q in solutions):
        raise InputError(
            f'nothing to simulate: at least one sensor and one pose with {len(chain)} joints each'
        )
    if joint_offsets is None:
        joint_offsets = joint_offset_std * rng.standard_normal(len(chain))
    true_markers = {
        name: np.asarray(nominal, dtype=float) + marker_std_m * rng.standard_normal(3)
        for name, nominal in markers.items()
    }

    q = np.concatenate(solutions)
    pose = np.repeat(np.arange(len(solutions)), [len(part) for part in solutions])
    offsets = np.asarray(joint_offsets, dtype=float)
    clean = None if seen is None else seen(offsets, true_markers)
    columns = []
    for s, sensor in enumerate(sensors.values()):
        if clean is None:
            points = chain.positions(q, true_markers[sensor.marker], offsets)
            noiseless = apply(inverse(sensor.T_R_N), points)
        else:
            noiseless = clean[:, s]
        common = sensor.pose_sigma_m * rng.standard_normal((len(solutions), 3))
        noise = common[pose] + sensor.sigma_m * rng.standard_normal((len(q), 3))
        columns.append(noiseless + noise)
    # Row order as recorded: configuration by configuration, sensor by sensor.
    position = np.stack(columns, axis=1).reshape(-1, 3)
    gross = np.flatnonzero(rng.random(len(position)) < outlier_share)
    direction = rng.standard_normal((len(gross), 3))
    position[gross] += outlier_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    names = list(markers)
    configuration = np.repeat(np.arange(len(q)), len(sensors))
    measurements = _measurements(
        q,
        configuration,
        pose[configuration],
        pose[configuration] >= len(poses),
        np.tile(np.arange(len(sensors)), len(q)),
        np.tile([names.index(sensor.marker) for sensor in sensors.values()], len(q)),
        position,
        seconds_per_configuration,
        np.full(len(q), np.nan) if temperature_c is None else np.asarray(temperature_c),
    )
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers={name: np.asarray(nominal, dtype=float) for name, nominal in markers.items()},
        sensors={name: sensor.marker for name, sensor in sensors.items()},
        measurements=measurements,
        marker_std_m=marker_std_m,
        exit_status='complete',
        notes='simulated',
    )
    truth = SessionTruth(
        offsets,
        true_markers,
        dict(sensors),
        tuple(int(row) for row in gross),
    )
    return session, truth


def _measurements(
    q: FloatArray,
    configuration: IntArray,
    pose: IntArray,
    is_validation: BoolArray,
    sensor: IntArray,
    marker: IntArray,
    position: FloatArray,
    seconds_per_configuration: float,
    temperature_c: FloatArray,
) -> Measurements:
    """Fill the columns of a recording without dwell statistics or torques."""
    n = len(position)
    came_from = np.concatenate((np.full((1, q.shape[1]), np.nan), q[:-1]))
    return Measurements(
        observation=np.arange(n),
        pose=pose,
        configuration=configuration,
        is_validation=is_validation,
        stamp_s=np.asarray(seconds_per_configuration * (1.0 + configuration), dtype=float),
        sensor=sensor,
        marker=marker,
        q=q[configuration],
        from_q=came_from[configuration],
        position=position,
        std=np.full((n, 3), np.nan),
        samples=np.full(n, -1, dtype=np.int64),
        temperature_c=temperature_c[configuration],
    )
