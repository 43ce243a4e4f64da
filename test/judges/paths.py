# SPDX-License-Identifier: Apache-2.0
"""Judges of paths that share nothing with the collision checks under test.

Kinematics by pinocchio (by PyBullet for the iiwa), bodies as triangles (`trimesh`), distances by
FCL on triangle trees (by PyBullet for the iiwa); the model under test has its own kinematics,
convex hulls and coal. Paths are sampled so that no point of the arm moves by more than 1 mm from
one sample to the next, and bodies are grown by half of that. Samples are skipped only where the
distance at the last one leaves no room for a collision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from remaster_ros.types import FloatArray, IntArray

SAMPLE_M = 1e-3
LOOK_M = 0.15
"""Distances above this are as good as this, m."""
_SAMPLED = 300
_CHORDS = 32


class Judge(Protocol):
    """Measures how far apart the bodies are that may not touch."""

    def vertices(self, q: FloatArray) -> FloatArray:
        """Return points of the arm whose motion is that of all of it, m, (n, v, 3)."""

    def distance(self, q: FloatArray) -> float:
        """Return the smallest distance at a configuration, at most `LOOK_M`; m, (k,)."""


def collides(judge: Judge, path: FloatArray) -> tuple[bool, int, int]:
    """Tell whether an arm collides on a path (n, k); also how many samples and distances."""
    samples = looked = 0
    for start, end in pairwise(path):
        # Between 1/32 of a way the arcs are a hair longer than the chords; 5 % are added.
        share = np.linspace(0.0, 1.0, _CHORDS + 1)
        points = judge.vertices(start + share[:, None] * (end - start))
        chords = 1.05 * np.linalg.norm(np.diff(points, axis=0), axis=-1).max(axis=1)
        count = _CHORDS * max(1, int(np.ceil(chords.max() / SAMPLE_M)))
        fine = np.linspace(0.0, 1.0, count + 1)
        q = start + fine[:, None] * (end - start)
        way = np.interp(fine, share, np.concatenate(([0.0], np.cumsum(chords))))
        samples += len(q)
        i = 0
        while i < len(q):
            looked += 1
            room = judge.distance(q[i]) - SAMPLE_M / 2
            if room <= 0.0:
                return True, samples, looked
            # Both bodies of a pair move.
            i = max(i + 1, int(np.searchsorted(way, way[i] + room / 2)))
    return False, samples, looked


@dataclass(frozen=True)
class Part:
    """Triangles of a body: vertices (v, 3) in its link's frame, m, and faces (f, 3).

    `link` is the name of the link, '' for what stands still in the base frame.
    """

    name: str
    link: str
    vertices: FloatArray
    faces: IntArray


class FclJudge:
    """Pinocchio for the kinematics, FCL for the distances.

    Parameters
    ----------
    urdf
        Text of the URDF.
    joint_names
        The order of joints.
    parts
        All bodies.
    floor_z
        m; None for none.
    """

    def __init__(
        self,
        urdf: str,
        joint_names: Sequence[str],
        parts: Sequence[Part],
        floor_z: float | None = 0.0,
    ) -> None:
        import fcl
        import pinocchio

        self._fcl, self._pin = fcl, pinocchio
        self._model = pinocchio.buildModelFromXML(urdf)
        self._data = self._model.createData()
        self._columns = [self._model.joints[self._model.getJointId(n)].idx_q for n in joint_names]
        self._floor = floor_z
        self._parts = [p for p in parts if p.link] + [p for p in parts if not p.link]
        self._moving = sum(bool(part.link) for part in parts)
        self._frames = [self._model.getFrameId(p.link) for p in self._parts if p.link]
        # Which joint carries a part: 0 for those that stand still.
        self._carrier = np.array(
            [self._model.frames[f].parentJoint for f in self._frames]
            + [0] * (len(parts) - self._moving)
        )
        self._objects = [self._object(part) for part in self._parts]
        self._centers = np.array(
            [(p.vertices.min(0) + p.vertices.max(0)) / 2 for p in self._parts]
        )
        self._radii = np.array(
            [
                np.linalg.norm(p.vertices - c, axis=1).max()
                for p, c in zip(self._parts, self._centers)
            ]
        )
        self._pairs = self._pairs_to_watch()

    def _object(self, part: Part) -> Any:
        tree = self._fcl.BVHModel()
        tree.beginModel(len(part.vertices), len(part.faces))
        tree.addSubModel(np.asarray(part.vertices), np.asarray(part.faces))
        tree.endModel()
        return self._fcl.CollisionObject(tree, self._fcl.Transform())

    def _place(self, q: FloatArray) -> FloatArray:
        """Return where each part's frame is, (p, 4, 4)."""
        full = self._pin.neutral(self._model)
        full[self._columns] = q
        self._pin.framesForwardKinematics(self._model, self._data, full)
        poses = np.broadcast_to(np.eye(4), (len(self._parts), 4, 4)).copy()
        for i, frame in enumerate(self._frames):
            poses[i] = self._data.oMf[frame].homogeneous
        return poses

    def _pairs_to_watch(self) -> list[tuple[int, int]]:
        """Pairs of links that are not neighbours and do not always touch, and obstacles."""
        parents = self._model.parents
        carriers = self._carrier
        pairs = []
        for i in range(self._moving):
            for j in range(i + 1, len(self._parts)):
                a, b = int(carriers[i]), int(carriers[j])
                is_adjacent = parents[a] == b or parents[b] == a if self._parts[j].link else a == 0
                if a != b and not is_adjacent:
                    pairs.append((i, j))
        rng = np.random.default_rng(1)
        low = np.maximum(self._model.lowerPositionLimit, -np.pi)[self._columns]
        high = np.minimum(self._model.upperPositionLimit, np.pi)[self._columns]
        touching = np.zeros(len(pairs))
        for _ in range(_SAMPLED):
            poses = self._place(low + rng.random(len(low)) * (high - low))
            self._move(poses)
            touching += [self._body_distance(i, j) <= 0.0 for i, j in pairs]
        return [pair for pair, n in zip(pairs, touching) if n < _SAMPLED]

    def _move(self, poses: FloatArray) -> None:
        for thing, T in zip(self._objects, poses):
            thing.setTransform(self._fcl.Transform(T[:3, :3], T[:3, 3]))

    def _body_distance(self, i: int, j: int) -> float:
        return float(
            self._fcl.distance(
                self._objects[i],
                self._objects[j],
                self._fcl.DistanceRequest(),
                self._fcl.DistanceResult(),
            )
        )

    def vertices(self, q: FloatArray) -> FloatArray:
        """See `Judge`."""
        found = []
        for row in q:
            poses = self._place(row)[: self._moving]
            found.append(
                np.concatenate(
                    [p.vertices @ T[:3, :3].T + T[:3, 3] for p, T in zip(self._parts, poses)]
                )
            )
        return np.array(found)

    def distance(self, q: FloatArray) -> float:
        """See `Judge`."""
        poses = self._place(q)
        least = LOOK_M
        if self._floor is not None:
            for part, T, carrier in zip(self._parts, poses, self._carrier):
                if carrier > 0:
                    lowest = float((part.vertices @ T[2, :3]).min() + T[2, 3])
                    least = min(least, lowest - self._floor)
        centers = np.einsum('pij,pj->pi', poses[:, :3, :3], self._centers) + poses[:, :3, 3]
        i, j = np.transpose(self._pairs)
        bounds = np.linalg.norm(centers[i] - centers[j], axis=1) - self._radii[i] - self._radii[j]
        self._move(poses)
        for n in np.argsort(bounds):
            if bounds[n] >= least:
                break
            least = min(least, self._body_distance(*self._pairs[n]))
        return least


class BulletJudge:
    """PyBullet, with its own meshes of a KUKA iiwa, its own kinematics and its own distances.

    Parameters
    ----------
    urdf
        The URDF file, with the tool's bodies as collision geometry.
    joint_names
        The order of joints.
    boxes
        Obstacles: middle, edge lengths (m, (3,)) and yaw (rad).
    floor_z
        m; None for none.
    """

    def __init__(
        self,
        urdf: Path,
        joint_names: Sequence[str],
        boxes: Sequence[tuple[Sequence[float], Sequence[float], float]] = (),
        floor_z: float | None = 0.0,
    ) -> None:
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        self._b = BulletClient(pybullet.DIRECT)
        self._arm = self._b.loadURDF(str(urdf), useFixedBase=True)
        info = [self._b.getJointInfo(self._arm, i) for i in range(self._b.getNumJoints(self._arm))]
        names = [row[1].decode() for row in info]
        self._joints = [names.index(name) for name in joint_names]
        self._limits = np.array([[info[j][8], info[j][9]] for j in self._joints])
        self._links = [-1, *range(len(info))]
        parent = {i: info[i][16] for i in range(len(info))}
        fixed = {i for i in range(len(info)) if info[i][2] == pybullet.JOINT_FIXED}
        # Which joint of the arm carries each link; -1 the base.
        self._carrier = {-1: -1}
        for i in range(len(info)):
            self._carrier[i] = self._carrier[parent[i]] if i in fixed else i
        self._things = []
        for center, size, yaw in boxes:
            shape = self._b.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=[s / 2 for s in size]
            )
            turn = pybullet.getQuaternionFromEuler([0, 0, yaw])
            self._things.append(self._b.createMultiBody(0, shape, -1, list(center), turn))
        if floor_z is not None:
            shape = self._b.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[5, 5, 0.5])
            place = [0, 0, floor_z - 0.5]
            self._things.append(self._b.createMultiBody(0, shape, -1, place))
        moving = [i for i in self._links if self._carrier[i] >= 0 and self._has_shape(i)]
        still = [i for i in self._links if self._carrier[i] < 0 and self._has_shape(i)]
        order = sorted({-1, *self._carrier.values()})
        rank = {carrier: n for n, carrier in enumerate(order)}
        self._moving = moving
        self._pairs = [
            (i, j)
            for n, i in enumerate([*still, *moving])
            for j in [*still, *moving][n + 1 :]
            if rank[self._carrier[j]] - rank[self._carrier[i]] > 1
        ]
        rng = np.random.default_rng(1)
        touching = np.zeros(len(self._pairs))
        for _ in range(_SAMPLED):
            self._set(rng.uniform(*self._limits.T))
            touching += [self._self_distance(i, j, 0.0) <= 0.0 for i, j in self._pairs]
        self._pairs = [pair for pair, n in zip(self._pairs, touching) if n < _SAMPLED]

    def _has_shape(self, link: int) -> bool:
        return bool(self._b.getCollisionShapeData(self._arm, link))

    def _set(self, q: FloatArray) -> None:
        for joint, value in zip(self._joints, q):
            self._b.resetJointState(self._arm, joint, float(value))

    def _self_distance(self, i: int, j: int, within: float) -> float:
        found = self._b.getClosestPoints(self._arm, self._arm, within, i, j)
        return min((point[8] for point in found), default=LOOK_M)

    def vertices(self, q: FloatArray) -> FloatArray:
        """See `Judge`; the corners of each link's box, which encloses it."""
        found = []
        for row in q:
            self._set(row)
            points = []
            for link in self._moving:
                state = self._b.getLinkState(self._arm, link, computeForwardKinematics=True)
                turn = np.reshape(self._b.getMatrixFromQuaternion(state[5]), (3, 3))
                # Every link of an iiwa with its tool fits in 0.35 m about its frame.
                corners = 0.2 * np.array(
                    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
                )
                points.append(corners @ turn.T + state[4])
            found.append(np.concatenate(points))
        return np.array(found)

    def distance(self, q: FloatArray) -> float:
        """See `Judge`."""
        self._set(q)
        least = LOOK_M
        for i, j in self._pairs:
            least = min(least, self._self_distance(i, j, least))
        for thing in self._things:
            for link in self._moving:
                if self._carrier[link] == self._first and thing == self._things[-1]:
                    continue
                found = self._b.getClosestPoints(self._arm, thing, least, linkIndexA=link)
                least = min([least, *(point[8] for point in found)])
        return least

    @property
    def _first(self) -> int:
        """The first joint: its link turns on the base and stays as high above the floor."""
        return self._joints[0]

    def close(self) -> None:
        """Let go of the simulation."""
        self._b.disconnect()
