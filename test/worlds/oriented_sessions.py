# SPDX-License-Identifier: Apache-2.0
"""Sessions of full poses of a hidden world: by a tracker, a standing camera, one on the tool.

The arm is pinocchio's. A camera sees the corners of a board through a lens with distortion, to
some hundredths of a pixel; the board's pose is what fits those pixels best, so that its noise is
that of a camera: large along the line of sight, small about it, larger from afar.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from worlds.hidden_arm import PinocchioArm
from worlds.measured_rows import measured_rows

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, looking_at, transform
from remaster_ros.types import FloatArray, Session

KINDS = ('tracker', 'camera_stands', 'camera_on_tool')
ROBOTS = Path(__file__).parents[2] / 'config' / 'robots'
ARMS = ('iiwa7', 'iiwa14', 'lwr4plus')
# Of a machine-vision camera with a lens of 8 mm on pixels of 5 µm, calibrated; corners are found
# to a tenth of a pixel.
FOCAL_PX, RADIAL, TANGENTIAL, PIXEL = 1600.0, (-0.12, 0.05), (4e-4, -3e-4), 0.1
CORNERS = np.stack((*np.meshgrid(np.linspace(-0.1, 0.1, 7), np.linspace(-0.08, 0.08, 6)),), -1)
CORNERS = np.concatenate((CORNERS.reshape(-1, 2), np.zeros((42, 1))), axis=1)
VIEW, NEAR_M, FAR_M = np.radians(20.0), 0.4, 1.1
# A board seen square on has a poorly measured tilt: docs/camera.md asks for these.
TILT = np.radians((20.0, 60.0))
# Of the arm, from visit to visit: of the tool's place, m, and, at a reach of 0.8 m, turn, rad.
REPEATABILITY = 0.03e-3, 0.03e-3 / 0.8


class Made(NamedTuple):
    """A session with the true zero-offsets, rad, (k,), and how the body stands on the tool."""

    session: Session
    joint_offsets: FloatArray
    R_T_B: FloatArray


def make_session(
    kind: str,
    rng: np.random.Generator,
    *,
    poses: int = 30,
    solutions: int = 3,
    sigma_m: float = 0.1e-3,
    sigma_rad: float = np.radians(0.05),
    common: float = 1.0,
    arm: str | None = None,
    marker_std_m: float = 0.3,
) -> Made:
    """Draw an arm's truth and measure it.

    ``common`` is the error that the rows of a pose share over the one of each, of a tracker.
    Neither the place of the body on the tool nor how it stands there is known. ``arm`` is the name
    of a shipped one, or a URDF.
    """
    urdf = arm or str(rng.choice(ARMS))
    urdf = urdf if urdf.startswith('<') else (ROBOTS / f'{urdf}.urdf').read_text()
    chain = SerialChain.from_urdf(urdf, *_ends(urdf))
    k, n = len(chain), poses * solutions
    offsets = np.radians(0.3) * rng.standard_normal(k) * chain.per_radian
    tool = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    direction = rng.uniform(-np.pi, np.pi)
    place = np.array([0.6 * np.cos(direction), 0.6 * np.sin(direction), 0.4])
    if kind == 'tracker':
        place *= 4.0
    elif kind == 'camera_stands':
        place *= 1.2
    turn = Rotation.random(rng=rng).as_matrix()
    if kind == 'camera_stands':
        turn = looking_at(place, np.array([0.0, 0.0, 0.4]), rng.uniform(-np.pi, np.pi))
    other = transform(turn, place)
    q = np.zeros((0, k))
    for _ in range(400):
        if len(q) >= n:
            break
        tried = rng.uniform(0.9 * chain.lower, 0.9 * chain.upper, (4000, k))
        seen = inverse(other) @ chain.forward(tried) @ tool
        if kind != 'tracker':
            tried = tried[_in_view(inverse(seen) if kind == 'camera_on_tool' else seen)]
        q = np.concatenate((q, tried))
    assert len(q) >= n, 'the camera hardly sees the board'
    q = q[:n]
    state = PinocchioArm(urdf, chain.tip_link).state(q + offsets)
    pose = inverse(other) @ transform(state.tool, state.tool_origin) @ tool
    number = np.repeat(np.arange(poses), solutions)
    if kind == 'tracker':

        def noise(sigma: float) -> FloatArray:
            shared = common * rng.standard_normal((poses, 3))[number]
            return np.asarray(sigma * (shared + rng.standard_normal((n, 3))))

        position = pose[:, :3, 3] + noise(sigma_m)
        turned = Rotation.from_rotvec(noise(sigma_rad)) * Rotation.from_matrix(pose[:, :3, :3])
    else:
        # Each pose of a camera is a configuration.
        number = np.arange(n)
        jitter = transform(
            Rotation.from_rotvec(REPEATABILITY[1] * rng.standard_normal((n, 3))).as_matrix(),
            REPEATABILITY[0] * rng.standard_normal((n, 3)),
        )
        pose = inverse(other) @ transform(state.tool, state.tool_origin) @ jitter @ tool
        board = inverse(pose) if kind == 'camera_on_tool' else pose
        board = np.array([_by_camera(board_pose, rng) for board_pose in board])
        pose = inverse(board) if kind == 'camera_on_tool' else board
        position, turned = pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3])
    measurements = measured_rows(
        q, position, pose=number, stamp_s=10.0 * np.arange(n), orientation=turned.as_quat()
    )
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers={'body': np.zeros(3)},
        sensors={'sensor': 'body'},
        measurements=measurements,
        marker_std_m=marker_std_m,
        oriented=frozenset({'sensor'}),
        on_tool=frozenset({'sensor'} if kind == 'camera_on_tool' else ()),
    )
    return Made(session, offsets, tool[:3, :3])


def _ends(urdf: str) -> tuple[str, str]:
    arm = PinocchioArm(urdf)
    frames = [frame.name for frame in arm.model.frames if frame.type.name == 'BODY']
    return frames[0], frames[-1]


def _in_view(T_C_B: FloatArray) -> FloatArray:
    """Return whether a camera sees a board well, (n,), at T_C_B (n, 4, 4)."""
    place = T_C_B[:, :3, 3]
    distance = np.linalg.norm(place, axis=1)
    axis = np.arccos(np.clip(place[:, 2] / distance, -1.0, 1.0))
    tilt = np.arccos(np.clip(np.abs(np.sum(T_C_B[:, :3, 2] * place, axis=1)) / distance, 0, 1))
    return (
        (axis < VIEW)
        & (tilt > TILT[0])
        & (tilt < TILT[1])
        & (distance > NEAR_M)
        & (distance < FAR_M)
    )


def pixels(points: FloatArray) -> FloatArray:
    """Return where a camera sees points (..., 3) of its frame, px, (..., 2).

    Brown's model (1966) as OpenCV has it: two radial terms, two tangential ones.
    """
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r = x**2 + y**2
    radial = 1.0 + RADIAL[0] * r + RADIAL[1] * r**2
    p1, p2 = TANGENTIAL
    u = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x**2)
    v = y * radial + p1 * (r + 2.0 * y**2) + 2.0 * p2 * x * y
    return FOCAL_PX * np.stack((u, v), axis=-1)


def _by_camera(T_C_B: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the pose (4, 4) that fits best where noise has moved the corners of a board."""

    def corners(step: FloatArray) -> FloatArray:
        turn = Rotation.from_rotvec(step[3:]).as_matrix() @ T_C_B[:3, :3]
        return pixels(CORNERS @ turn.T + T_C_B[:3, 3] + step[:3]).ravel()

    seen = corners(np.zeros(6)) + PIXEL * rng.standard_normal(2 * len(CORNERS))
    step = np.zeros(6)
    for _ in range(3):
        around = 1e-6 * np.eye(6)
        J = np.stack([(corners(step + e) - corners(step - e)) / 2e-6 for e in around], axis=1)
        step = step + np.linalg.lstsq(J, seen - corners(step), rcond=None)[0]
    turn = Rotation.from_rotvec(step[3:]).as_matrix() @ T_C_B[:3, :3]
    return transform(turn, T_C_B[:3, 3] + step[:3])


class FittedSession(NamedTuple):
    """Of one session: which 95 % intervals of determined offsets hold the truth, and its errors.

    Attributes
    ----------
    inside
        (m,).
    scaled
        (mean - truth) / std, (m,).
    std_deg, without_deg
        Of these offsets, and by the positions alone, degrees, (m,).
    p_value
        That positions and orientations agree.
    gross
        How many readings were left out; none is gross.
    """

    inside: list[bool]
    scaled: list[float]
    std_deg: list[float]
    without_deg: list[float]
    p_value: float
    gross: int


def one_session(seed: int, kind: str, poses: int = 30, arm: str | None = None) -> FittedSession:
    """Make a session with this seed, fit it, and look which intervals hold."""
    rng = np.random.default_rng(seed)
    common = rng.choice((0.0, 1.0, 3.0))
    made = make_session(
        kind, rng, poses=poses, solutions=3 if kind == 'tracker' else 2, common=common, arm=arm
    )
    fit = fit_session(made.session, rng=rng, draws=1000)
    assert fit.orientations is not None
    assert not fit.orientations.why_not, fit.orientations
    information = fit.orientations.information
    assert information is not None
    known = fit.identifiable
    low, high = fit.joint_offsets_interval95[known].T
    truth = made.joint_offsets[known]
    return FittedSession(
        ((low < truth) & (truth < high)).tolist(),
        ((fit.joint_offsets[known] - truth) / fit.joint_offsets_std[known]).tolist(),
        np.degrees(fit.joint_offsets_std[known]).tolist(),
        np.degrees(information.std_without[known]).tolist(),
        information.p_value,
        len(fit.left_out),
    )


__all__ = [
    'KINDS',
    'FittedSession',
    'Made',
    'Problem',
    'estimate',
    'make_session',
    'one_session',
    'pixels',
]
