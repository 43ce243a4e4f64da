# SPDX-License-Identifier: Apache-2.0
"""Frames of a marker at standstill: which of them are measurements of the marker.

NatNet has no checksum, a solver swaps markers for a frame, a driver hands on a wild detection: a
single frame may be anywhere. While the arm stands the marker cannot have moved, so that a frame
far from all others is none of it, whatever sent it. What is within is averaged: that has the
efficiency of the mean (a median has 64 % of it), and the standard deviation of the frames stays
what it is, as of normal noise next to no frame is left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from remaster_ros.types import FloatArray

RESOLUTION_M = 1e-6
"""Resolution of a 32-bit coordinate at 16 m, m: the smallest possible scatter."""
MOST_DROPPED = 0.1
"""Largest share of dropped frames. With one damaged frame in a hundred, more than a tenth of 30
are damaged in one reading of 4,000: a larger share is of another or a moving marker."""


def of_the_marker(positions: FloatArray) -> NDArray[np.bool_]:
    """Whether each frame is of the marker at standstill, (n,).

    Parameters
    ----------
    positions
        Positions in the frames, m, (n, 3).

    Notes
    -----
    A frame is dropped if its distance from the median point is more than c times the median
    distance. For normal noise c = 7.5 + 1000 / n² drops a frame in about one reading of 1,000 if
    the noise is along one axis only, and more rarely if it is along three (simulated, n from 5 to
    500; few frames have an uncertain median distance).
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    usual = max(float(np.median(distance)), RESOLUTION_M)
    kept: NDArray[np.bool_] = distance <= (7.5 + 1000.0 / len(positions) ** 2) * usual
    return kept


def are_too_many(dropped: int, frames: int) -> bool:
    """Whether so many frames are dropped that the remaining ones are in doubt.

    More than one and more than a share of `MOST_DROPPED`. ``frames``: dropped ones included.
    """
    return dropped > max(1.0, MOST_DROPPED * frames)
