# SPDX-License-Identifier: Apache-2.0
"""What a command to an arm means physically: speeds, accelerations, limits, the way of a stop.

Written from the physics of the arm alone: pinocchio's kinematics of the URDF, the controller's
interpolation of `hostile.arm`, and nothing of the code that makes the commands.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from hostile.arm import Command

from remaster_ros.types import FloatArray

PROBE_RAD = 1e-4
"""A command that moves no joint so far is a probe, or holds the arm where it is."""
SPEED_TOLERANCE = 0.02
"""Of the joint-speed limit: noise of the encoders in the state that a command begins from."""
ON_PATH_RAD = 3e-3
"""How far a stop may lead beside, beyond, or back along the admitted path, rad."""
STEP_S = 0.02
"""Places on an admitted way that are so far apart are joined by lines, s: the chords of a joint
that accelerates by 5 rad/s² are 0.25 mrad beside its way."""
SAME_S = 0.01
"""A piece that ends so much before the one before it is a stop, s."""
GRACE_S = 0.3
"""After an emergency stop a command may still be on its way so long, s."""


@dataclass(frozen=True)
class Rules:
    """What is never to be exceeded.

    Attributes
    ----------
    speed_share
        Share of the URDF's joint speeds.
    cartesian_m_s
        Speed of the fastest point of the arm and tool; infinite where none is set.
    acceleration
        Joint accelerations of moves, rad/s², (k,), or None where none is stated.
    """

    speed_share: float = 0.3
    cartesian_m_s: float = np.inf
    acceleration: FloatArray | None = None


class Body:
    """The arm's limits from its URDF, and the speeds of its points.

    Parameters
    ----------
    urdf
        Text.
    tool_points
        Points in the tip frame, m, (n, 3): markers, the tool's end.
    tip_link
        The tip frame.
    radius_m
        Radius of the links about the lines between the joints, for `surface_speed`.
    """

    def __init__(
        self,
        urdf: str,
        tool_points: FloatArray,
        tip_link: str = 'tool',
        radius_m: float = 0.075,
    ) -> None:
        self.model = pin.buildModelFromXML(urdf)
        self._data = self.model.createData()
        self._tip = self.model.getFrameId(tip_link)
        self.lower = self.model.lowerPositionLimit.copy()
        self.upper = self.model.upperPositionLimit.copy()
        self.velocity = self.model.velocityLimit.copy()
        self.names = [str(name) for name in list(self.model.names)[1:]]
        # (joint, point in its frame): what hangs on each joint, as far as the next one.
        last = self.model.nq
        tip = self.model.frames[self._tip].placement
        self._points = [(i, np.zeros(3)) for i in range(1, last + 1)]
        self._points += [
            (i, self.model.jointPlacements[i + 1].translation.copy()) for i in range(1, last)
        ]
        # Links have their radius about these; the tool's points are points.
        self._radii = [radius_m] * len(self._points) + [0.0] * (1 + len(tool_points))
        self._points += [(last, tip.act(np.asarray(p, float))) for p in [(0, 0, 0), *tool_points]]

    def points(self, q: FloatArray) -> FloatArray:
        """Where the points are, m, (n, 3)."""
        pin.forwardKinematics(self.model, self._data, q)
        return np.array([self._data.oMi[i].act(p) for i, p in self._points])

    def speeds(self, q: FloatArray, v: FloatArray) -> tuple[float, float]:
        """Speed of the fastest of the points, and of the surface of the links about them, m/s."""
        pin.forwardKinematics(self.model, self._data, q, v)
        fastest = surface = 0.0
        for (i, p), radius in zip(self._points, self._radii):
            twist = self._data.v[i]
            linear, angular = twist.linear + np.cross(twist.angular, p), twist.angular
            speed = float(np.linalg.norm(linear))
            fastest = max(fastest, speed)
            turning = float(np.linalg.norm(angular))
            if turning > 1e-9:
                # A sphere's points add any vector across the axis, up to radius times turning.
                along = float(linear @ angular) / turning
                across = np.sqrt(max(speed**2 - along**2, 0.0)) + turning * radius
                speed = float(np.hypot(across, along))
            surface = max(surface, speed)
        return fastest, surface

    def lowest(self, q: FloatArray) -> float:
        """Height of the lowest point that the arm can move down, m."""
        return float(np.min(self.points(q)[1:, 2]))

    def clear(self, q: FloatArray, gap_m: float = 0.2) -> bool:
        """Whether the arm is well away from the floor and from itself: crude, and cautious."""
        pin.forwardKinematics(self.model, self._data, q)
        joints = [self._data.oMi[i].translation.copy() for i in range(1, self.model.nq + 1)]
        tool = self.points(q)[-3:]
        way = np.linspace(0.0, 1.0, 5)[:, None]
        links = [np.zeros((1, 3)) + joints[0] * way]
        links += [a + (b - a) * way for a, b in pairwise(joints)]
        links += [joints[-1] + (p - joints[-1]) * way for p in tool]
        if min(link[:, 2].min() for link in links[3:]) < gap_m:
            return False
        far = range(len(links))
        return all(
            np.min(np.linalg.norm(links[i][:, None] - links[j][None], axis=-1)) > gap_m
            for i in far
            for j in far[min(i + 4, 6) :]
            if i < 4
        )


@dataclass(frozen=True)
class Judgement:
    """What one command asks of the arm.

    Attributes
    ----------
    kind
        ``move``, ``piece`` (the rest of a move), ``stop`` or ``probe``.
    at_s
        Monotonic time of arrival.
    way_rad
        Largest joint movement from the arm's state to the end.
    urdf_share
        Largest joint speed over the URDF's.
    speed_ratio
        The same over the share that is allowed.
    cartesian_m_s, surface_m_s
        Speed of the fastest point on the links' axes and the tool, and on the links' surfaces.
    acceleration
        Largest joint acceleration, rad/s².
    acceleration_ratio
        Over what is allowed; NaN where nothing is stated.
    outside_rad
        How far outside the joint limits; infinite for what is no number.
    off_path_rad, back_rad, beyond_rad
        Of a stop: distance from the admitted path, way back along it, way beyond its end; of a
        piece, the first two.
    jump_rad
        Of a piece: how far it begins from where the controller has led the arm, or from where the
        arm is: the nearer of the two.
    lowest_m
        Lowest point of the arm on the way, m.
    """

    kind: str
    at_s: float
    way_rad: float
    urdf_share: float
    speed_ratio: float
    cartesian_m_s: float
    surface_m_s: float
    acceleration: float
    acceleration_ratio: float
    outside_rad: float
    off_path_rad: float = 0.0
    back_rad: float = 0.0
    beyond_rad: float = 0.0
    lowest_m: float = np.inf
    jump_rad: float = 0.0

    def wrong(self, rules: Rules) -> list[str]:
        """Return what must not have been commanded, in words."""
        out = []
        if self.outside_rad > 1e-9:
            out.append(f'outside the limits by {np.rad2deg(self.outside_rad):.1f} deg')
        if self.speed_ratio > 1.0 + SPEED_TOLERANCE:
            out.append(f'joint speed {self.speed_ratio:.2f} of what is allowed')
        if self.cartesian_m_s > rules.cartesian_m_s * (1.0 + SPEED_TOLERANCE):
            out.append(f'{self.cartesian_m_s:.3f} m/s')
        if self.kind in ('move', 'piece') and self.acceleration_ratio > 1.0 + SPEED_TOLERANCE:
            out.append(f'acceleration {self.acceleration_ratio:.2f} of what is allowed')
        if self.lowest_m < 0.0:
            out.append(f'through the floor: {self.lowest_m:.3f} m')
        for what in ('off_path', 'back', 'beyond', 'jump'):
            value = getattr(self, f'{what}_rad')
            if value > ON_PATH_RAD:
                out.append(f'stop {what.replace("_", " ")} by {np.rad2deg(value):.2f} deg')
        return out


class Judge:
    """Judge the commands of a run in their order.

    Parameters
    ----------
    body
        The arm.
    rules
        What is allowed.
    """

    def __init__(self, body: Body, rules: Rules) -> None:
        self.body, self.rules = body, rules
        self._move: Command | None = None
        self._last: Command | None = None

    def forget(self) -> None:
        """The arm stands, and no move is under way: after an emergency stop, a new beginning."""
        self._move = self._last = None

    def judge(self, command: Command, running: bool = True) -> Judgement:
        """Judge the next command; `running`: whether the collection ran when it arrived."""
        if not np.all(np.isfinite(command.q)) or np.any(np.diff(command.times_s) <= 0.0):
            inf = np.inf
            return Judgement('stop', command.arrival_s, *([inf] * 7), outside_rad=inf)
        q, v, a = command.spline().sample()
        body, limit = self.body, self.rules.speed_share * self.body.velocity
        way = float(np.max(np.abs(q - command.start_q)))
        # A stop ends a move before its time; what follows the stop's own end is a move again.
        under_way = self._last is not None and command.arrival_s < self._last.end_s
        admitted = self._move
        further = {}
        if admitted is not None and under_way and len(command.times_s) > 1:
            kind = 'piece'
            assert self._last is not None
            here, _ = command.spline().at(command.arrival_s)
            led, _ = self._last.spline().at(command.arrival_s)
            off = (here - led, here - command.start_q)
            further = {'jump_rad': float(min(np.max(np.abs(difference)) for difference in off))}
            if command.end_s >= self._last.end_s - SAME_S:
                admitted = extended(admitted, command)
                further |= {k: v for k, v in along(admitted, q).items() if k != 'beyond_rad'}
            else:
                # A stop on a curve: nothing of its way is new.
                further |= along(admitted, q)
        elif admitted is not None and (under_way or not running):
            kind = 'stop'
        elif way < PROBE_RAD:
            kind = 'probe'
        else:
            kind = 'stop' if not running else 'move'
        speeds = np.array([body.speeds(*row) for row in zip(q, v)])
        moving = np.any(np.abs(v) > 1e-3, axis=1)
        outside = np.maximum(body.lower - q, q - body.upper)
        # An arm that stands outside may stay there; no point of a command lies further out.
        allowed = np.max(np.maximum(body.lower - command.start_q, command.start_q - body.upper))
        outside_rad = float(np.max(outside))
        bound = self.rules.acceleration
        judged = Judgement(
            kind,
            command.arrival_s,
            way,
            urdf_share=float(np.max(np.abs(v) / body.velocity)),
            speed_ratio=float(np.max(np.abs(v) / limit)),
            cartesian_m_s=float(speeds[:, 0].max()),
            surface_m_s=float(speeds[:, 1].max()),
            acceleration=float(np.max(np.abs(a))),
            acceleration_ratio=np.nan if bound is None else float(np.max(np.abs(a) / bound)),
            outside_rad=outside_rad if outside_rad > max(allowed, 0.0) + 1e-4 else 0.0,
            lowest_m=min((body.lowest(row) for row in q[moving]), default=np.inf),
            **(along(admitted, q) if kind == 'stop' and admitted is not None else further),
        )
        self._last = command
        if kind != 'stop':
            self._move = admitted if kind == 'piece' else extended(command, command)
        return judged


def extended(admitted: Command, piece: Command) -> Command:
    """Return a move with what a piece adds to it, from when that came."""
    times = admitted.zero_s + admitted.times_s
    passed = times <= piece.arrival_s
    # Between two points a controller may draw a curve.
    spline, end_s = piece.spline(), max(piece.end_s, piece.arrival_s + STEP_S)
    ahead = np.append(np.arange(piece.arrival_s + STEP_S, end_s, STEP_S), end_s)
    q = np.vstack([admitted.q[passed], *(spline.at(t)[0][None] for t in ahead)])
    times = np.concatenate([times[passed], ahead])
    return replace(admitted, q=q, v=None, a=None, times_s=times - admitted.zero_s)


def along(admitted: Command, q: FloatArray) -> dict[str, float]:
    """Compare a stop's way q, rad, (n, k), with the polyline of an admitted move."""
    corners = np.vstack([admitted.start_q, admitted.q])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    keep = lengths > 1e-9
    begins, ends, lengths = corners[:-1][keep], corners[1:][keep], lengths[keep]
    if not len(lengths):
        return {'off_path_rad': float(np.max(np.abs(q - corners[0])))}
    directions = (ends - begins) / lengths[:, None]
    before = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    local = np.einsum('npk,pk->np', q[:, None] - begins[None], directions)
    local = np.clip(local, 0.0, lengths)
    feet = begins + local[..., None] * directions
    distances = np.linalg.norm(q[:, None] - feet, axis=-1)
    nearest = np.argmin(distances, axis=1)
    rows = np.arange(len(q))
    progress = before[nearest] + local[rows, nearest]
    # What leads straight on beyond the end is told from what leads aside.
    at_end = progress >= float(np.sum(lengths)) - 1e-9
    beyond = float(np.max(((q - ends[-1]) @ directions[-1])[at_end], initial=0.0))
    deviation = np.where(at_end, 0.0, distances[rows, nearest])
    lateral_offset = q - ends[-1] - ((q - ends[-1]) @ directions[-1])[:, None] * directions[-1]
    deviation = np.where(at_end, np.linalg.norm(lateral_offset, axis=1), deviation)
    # The way back before the start counts too: the arm must not leave the path there.
    start = (q - begins[0]) @ directions[0]
    signed = np.where((progress <= 1e-9) & (start < 0.0), start, progress)
    back = float(np.max(np.maximum.accumulate(signed) - signed))
    return {
        'off_path_rad': float(np.max(deviation)),
        'back_rad': back,
        'beyond_rad': max(beyond, 0.0),
    }


def after(commands: Iterable[Command], since_s: float, until_s: float) -> list[Command]:
    """Return the commands that arrived between two times."""
    return [c for c in commands if since_s < c.arrival_s <= until_s]


def percentiles(values_s: Sequence[float]) -> str:
    """Return median, 95 % and largest of times, ms, in words."""
    if not values_s:
        return 'none'
    ms = 1e3 * np.asarray(values_s)
    return (
        f'median {np.median(ms):.1f} ms, 95 % {np.percentile(ms, 95):.1f} ms, '
        f'largest {ms.max():.1f} ms ({len(ms)})'
    )
