# SPDX-License-Identifier: Apache-2.0
"""Session from a known truth: for users, for quick checks, for calibration studies.

Poses come in as joint solutions; nothing is planned here. The truth is returned in a record of
its own, which no estimator takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.chain_arm import SECONDS_PER_CONFIGURATION, model_of_tour
from remaster_ros.simulation.effect_sampling import EffectSpec, with_effects
from remaster_ros.simulation.truth import (
    SessionTruth,
    SimulatedSensor,
    Warming,
    mount_body,
)
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
    """Simulate a session, with noise, of a robot with random true errors that visits the poses.

    ``chain, urdf``: nominal robot with k joints, and its URDF text; ``poses,
    validation_poses``: for each pose its joint solutions in the order visited, rad, (m, k);
    ``sensors``: by name; at every configuration each gives an observation of each of its
    markers, from one frame; ``markers``: nominal positions in the tool frame, m, (3,); true
    positions have the standard deviation ``marker_std_m``; ``joint_offsets``: true
    zero-offsets, rad or m, (k,), or None for draws from N(0, ``joint_offset_std``²), times
    `SerialChain.per_radian` for a joint that slides; ``outlier_share``: share of the
    observations shifted by ``outlier_m`` in a random direction; ``warming``: of the arm,
    measured as well, or None if no temperature is measured; ``effects, effect_rng``: effects
    of the arm or the sensors, and their source of randomness.

    Returns the session, with no more in it than a recorded one, and its truth. Raises
    InputError if solutions have a wrong shape, there are no poses or sensors, a sensor follows
    an unknown marker, or the arm cannot show an effect.
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
        joint_offsets = joint_offset_std * chain.per_radian * rng.standard_normal(len(chain))
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
    # Drawn last, so that sessions of sensors without these errors do not change.
    bodies = {
        sensor.marker: mount_body(rng)
        for sensor in sensors.values()
        if sensor.turn_sigma_rad is not None
    }
    orientation = np.full((len(position), 4), np.nan)
    for s, sensor in enumerate(sensors.values()):
        if sensor.depth_sigma_m:
            selection = np.tile(np.equal(seen_by, s), len(q))
            distance = np.linalg.norm(position[selection], axis=1, keepdims=True)
            error = sensor.depth_sigma_m * rng.standard_normal((len(distance), 1))
            position[selection] += error * distance * position[selection]
        if sensor.turn_sigma_rad is not None:
            first = slice(seen_by.index(s), None, len(seen_by))
            common = sensor.pose_turn_sigma_rad * rng.standard_normal((len(solutions), 3))
            error = common[pose] + sensor.turn_sigma_rad * rng.standard_normal((len(q), 3))
            turn = Rotation.from_rotvec(error)
            true = model.tool_seen(truth.effects)[:, s] @ bodies[sensor.marker]
            orientation[first] = (turn * Rotation.from_matrix(true)).as_quat()
            if sensor.on_tool:
                # The sensor measures the position of its target in its own frame, which is turned.
                position[first] = turn.apply(position[first])

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
        # A simulated session has neither dwell statistics nor torques.
        std=np.full((n, 3), np.nan),
        samples=np.full(n, -1, dtype=np.int64),
        temperature_c=(
            np.full(n, np.nan) if warming is None else AMBIENT_C + model.visited.warming_k[row]
        ),
        frame=frame if several else None,
        orientation=orientation if bodies else None,
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
        oriented=frozenset(n for n, x in sensors.items() if x.turn_sigma_rad is not None),
        on_tool=frozenset(n for n, x in sensors.items() if x.on_tool),
        exit_status='complete',
        notes='simulated',
    )
    return session, replace(truth, outliers=tuple(gross.tolist()), bodies=bodies)
