# SPDX-License-Identifier: Apache-2.0
"""Arms and bodies for tests of collisions."""

from pathlib import Path

import numpy as np

from remaster_ros.kinematics.collision import CollisionModel, arm_bodies
from remaster_ros.kinematics.transforms import matrix_from_rpy, transform

ROBOTS = Path(__file__).parents[3] / 'config' / 'robots'
EXACT = {'margin': 0.005, 'unknown_offset': 0.0}


def capsules(chain, radius=0.075, *more, **rules):
    return CollisionModel(chain, [*arm_bodies(chain, [], radius), *more], **rules)


def at(x, y, z, rpy=(0, 0, 0)):
    return transform(matrix_from_rpy(np.array(rpy)), np.array([x, y, z]))


def distances(model, q):
    """Every pair's distance at a configuration, by its names."""
    pairs = np.arange(len(model._pairs.inner))
    found = model.pair_distances(np.asarray(q, float)[None], pairs)[0]
    return {model._pairs.names(pair): d for pair, d in zip(pairs, found)}
