# SPDX-License-Identifier: Apache-2.0
"""Tables as programs of others write them: an arm measured by a tracker, for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from worlds.robot_descriptions import ROBOTS

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
)

MARKER = np.array([0.03, -0.02, 0.12])


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured: joints, rad, (n, k), points in the tracker's frame, m, (n, 3)."""

    urdf: str
    chain: SerialChain
    q: np.ndarray
    points: np.ndarray
    offsets: np.ndarray


def measured(
    robot: str = 'irb120', rows: int = 40, seed: int = 0, noise_m: float = 5e-5
) -> Measured:
    """Return an arm with zero-offsets of some tenths of a degree, measured by a tracker."""
    print(f'foreign table seed {seed}')
    rng = np.random.default_rng(seed)
    description = ROBOTS[robot]()
    chain = SerialChain.from_urdf(description.urdf, description.base_link, description.tip_link)
    low, high = np.maximum(chain.lower, -2.0), np.minimum(chain.upper, 2.0)
    # As pendants show them: to a thousandth of a degree.
    q = np.deg2rad(np.round(np.rad2deg(rng.uniform(low, high, (rows, len(chain)))), 3))
    offsets = rng.normal(0.0, np.deg2rad(0.3), len(chain))
    T_R_N = transform(rotation_vector_to_matrix(rng.standard_normal(3)), (2.5, -0.8, 0.4))
    points = apply(inverse(T_R_N), chain.positions(q, MARKER, offsets))
    points += rng.normal(0.0, noise_m, points.shape)
    return Measured(description.urdf, chain, q, points, offsets)


def text(
    header: Sequence[str],
    columns: Sequence[Sequence[object]],
    separator: str = ',',
    decimal: str = '.',
) -> str:
    """Return a table; numbers are written with the decimal sign."""

    def cell(value: object) -> str:
        if isinstance(value, float | np.floating):
            return f'{value:.6f}'.replace('.', decimal)
        return str(value)

    lines = [separator.join(header)] if header else []
    lines += [separator.join(map(cell, row)) for row in zip(*columns, strict=True)]
    return '\n'.join(lines) + '\n'


def write(folder: Path, name: str, content: str, encoding: str = 'utf-8') -> Path:
    path = folder / name
    path.write_bytes(content.encode(encoding))
    return path
