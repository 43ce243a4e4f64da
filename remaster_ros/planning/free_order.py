"""Joint solutions in an order in which a free way leads from each to the next."""

from __future__ import annotations

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel
from remaster_ros.kinematics.free_paths import free_path, is_straight_free
from remaster_ros.planning.candidates import order_solutions
from remaster_ros.types import FloatArray


def free_order(
    model: CollisionModel | None,
    q: FloatArray,
    solutions: FloatArray,
    velocity_limits: FloatArray,
    rng: np.random.Generator,
    one: bool = False,
) -> tuple[list[int], list[FloatArray]]:
    """Order joint solutions so that each can be reached from the one before.

    The nearest to where the arm stands of those that a free straight way leads to is first, then
    the next from there, and so on. Where no straight way is free, one around is looked for, to the
    nearest first; a solution that cannot be reached is tried again from each that could be.

    ``model``: what must not be hit; with None every straight way is free; ``q``: where the arm
    stands, rad, (k,); ``solutions``: rad, (m, k); ``velocity_limits``: rad/s, (k,); ``one``: one
    solution is enough.
    Returns order, paths: indices into solutions, without those that could not be reached, and for
    each the configurations to go through before it, rad, (n, k).
    """
    left = [int(i) for i in order_solutions(solutions, q, velocity_limits)]
    straight = np.empty((0, solutions.shape[1]))
    if model is None:
        left = left[:1] if one else left
        return left, [straight] * len(left)
    order: list[int] = []
    paths: list[FloatArray] = []
    here = q
    while left:
        way = straight
        found = next((i for i in left if is_straight_free(model, here, solutions[i])), None)
        if found is None:
            for i in left:
                around = free_path(model, here, solutions[i], rng)
                if around is not None:
                    found, way = i, around[1:-1]
                    break
        if found is None:
            break
        order.append(found)
        paths.append(way)
        if one:
            break
        left.remove(found)
        here = solutions[found]
    return order, paths


def free_way(
    model: CollisionModel | None,
    q: FloatArray,
    goal: FloatArray,
    velocity_limits: FloatArray,
    seed: int,
) -> FloatArray | None:
    """Return what to go through from `q` to one configuration, rad, (n, k); None for no way.

    The same way each time, for the same ends and seed.
    """
    rng = np.random.default_rng([seed, *b'reference'])
    order, paths = free_order(model, q, goal[None], velocity_limits, rng)
    return paths[0] if order else None
