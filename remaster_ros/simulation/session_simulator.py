"""A session from a known truth: for users, for quick checks, for calibration studies.

Poses come in as joint solutions; nothing is planned here. The truth is returned in a record of its
own, which no estimator takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.effect_sampling import EffectSpec, with_effects
from remaster_ros.simulation.hidden_arm import SECONDS_PER_CONFIGURATION, model_of_tour
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor, Warming
from remaster_ros.types import FloatArray, Measurements, Session

DEFAULT_OFFSET_STD = np.radians(0.3)
AMBIENT_C = 20.0


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
    warming: Warming | None = None,
    effects: Sequence[EffectSpec] = (),
    effect_rng: np.random.Generator | None = None,
) -> tuple[Session, SessionTruth]:
    """Visit the poses with a robot whose truth is drawn, and measure with noise.

    Parameters
    ----------
    chain, urdf
        The nominal robot and the text it was read from; k joints.
    rng
        Source of all randomness but the effects'.
    poses, validation_poses
        For each pose its joint solutions in the order visited, rad, (m, k).
    sensors
        By name; at every configuration each gives an observation of each of its markers, from one
        frame.
    markers
        Nominal positions in the tool frame, m, (3,); the true ones lie ``marker_std_m`` away.
    joint_offsets
        The true zero-offsets, rad, (k,); where None drawn from N(0, ``joint_offset_std``²).
    outlier_share
        Share of the observations moved by ``outlier_m`` in a random direction.
    warming
        Of the arm, measured as well; None where no temperature is measured.
    effects, effect_rng
        What else is wrong with the arm or the sensors, and the source of its randomness.

    Returns
    -------
    session, truth
        The session has no more in it than a recorded one.

    Raises
    ------
    InputError
        Solutions of the wrong shape, no poses, a sensor that follows no known marker, or an
        effect that this arm cannot show.
    """
    for name, sensor in sensors.items():
        for marker in sensor.markers:
            if marker not in markers:
                raise InputError(f"sensor '{name}' follows marker '{marker}', which is none")
    solutions = [np.atleast_2d(np.asarray(q, dtype=float)) for q in (*poses, *validation_poses)]
    if not sensors or not solutions or any(q.shape[-1] != len(chain) for q in solutions):
        raise InputError(
            f'nothing to simulate: at least one sensor and one pose with {len(chain)} joints each'
        )
    if joint_offsets is None:
        joint_offsets = joint_offset_std * rng.standard_normal(len(chain))
    nominal = {name: np.asarray(position, dtype=float) for name, position in markers.items()}
    true_markers = {
        name: position + marker_std_m * rng.standard_normal(3)
        for name, position in nominal.items()
    }
    truth = SessionTruth(
        np.asarray(joint_offsets, dtype=float), true_markers, dict(sensors), warming or Warming()
    )
    q = np.concatenate(solutions)
    model = model_of_tour(chain, truth, q)
    truth = with_effects(truth, model, effects, effect_rng or rng)
    seen_by = [s for s, sensor in enumerate(sensors.values()) for _ in sensor.markers]
    points = model.seen(truth.effects).reshape(len(q), len(seen_by), 3)

    pose = np.repeat(np.arange(len(solutions)), [len(part) for part in solutions])
    for s, sensor in enumerate(sensors.values()):
        common = sensor.pose_sigma_m * rng.standard_normal((len(solutions), 3))
        for place in np.flatnonzero(np.equal(seen_by, s)):
            points[:, place] += common[pose] + sensor.sigma_m * rng.standard_normal((len(q), 3))
        if sensor.further and not sensor.single_shot:
            shared = sensor.frame_sigma_m * rng.standard_normal((len(q), 1, 3))
            points[:, np.equal(seen_by, s)] += shared
    # Row order as recorded: configuration by configuration, sensor by sensor, marker by marker.
    position = points.reshape(-1, 3)
    gross = np.flatnonzero(rng.random(len(position)) < outlier_share)
    direction = rng.standard_normal((len(gross), 3))
    position[gross] += outlier_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    n, names = len(position), list(markers)
    row = np.repeat(np.arange(len(q)), len(seen_by))
    several = len(seen_by) > len(sensors)
    one_by_one = [sensor.single_shot for sensor in sensors.values()]
    frame = np.where(np.tile(np.array(one_by_one)[seen_by], len(q)), -1, row)
    came_from = np.concatenate((np.full((1, len(chain)), np.nan), q[:-1]))
    measurements = Measurements(
        observation=np.arange(n),
        pose=pose[row],
        configuration=row,
        is_validation=pose[row] >= len(poses),
        stamp_s=np.asarray(SECONDS_PER_CONFIGURATION * (1.0 + row), dtype=float),
        sensor=np.tile(seen_by, len(q)),
        marker=np.tile(
            [names.index(marker) for sensor in sensors.values() for marker in sensor.markers],
            len(q),
        ),
        q=q[row],
        from_q=came_from[row],
        position=position,
        # Neither dwell statistics nor torques.
        std=np.full((n, 3), np.nan),
        samples=np.full(n, -1, dtype=np.int64),
        temperature_c=(
            np.full(n, np.nan) if warming is None else AMBIENT_C + model.visited.warming_k[row]
        ),
        frame=frame if several else None,
    )
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers=nominal,
        sensors={name: sensor.marker for name, sensor in sensors.items()},
        further_markers={
            name: tuple(sensor.further) for name, sensor in sensors.items() if sensor.further
        },
        measurements=measurements,
        marker_std_m=marker_std_m,
        exit_status='complete',
        notes='simulated',
    )
    return session, replace(truth, outliers=tuple(gross.tolist()))
