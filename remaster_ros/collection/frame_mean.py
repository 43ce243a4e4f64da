"""Which frames of a marker that stands still are measurements of it.

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
"""Of a 32-bit coordinate at 16 m, m: no scatter is smaller."""
MOST_DROPPED = 0.1
"""Share of the frames. Where one frame in a hundred is damaged, more than a tenth of 30 are in one
reading of 4,000: more frames than these are of another marker, or of one that moves."""


def of_the_marker(positions: FloatArray) -> NDArray[np.bool_]:
    """Return which frames are of a marker that stands still, (n,).

    Parameters
    ----------
    positions
        Of the frames, m, (n, 3).

    Notes
    -----
    Left out is what is further from the median point than c times the median distance from it. For
    normal noise c = 7.5 + 1000 / n² leaves out a frame in about one reading of 1,000 where the
    noise is along one axis alone, and more rarely where it is along three (simulated, n from 5 to
    500; few frames have an uncertain median distance).
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    usual = max(float(np.median(distance)), RESOLUTION_M)
    kept: NDArray[np.bool_] = distance <= (7.5 + 1000.0 / len(positions) ** 2) * usual
    return kept


def are_too_many(dropped: int, frames: int) -> bool:
    """Return whether so many of the frames are left out that the others are in doubt, too."""
    return dropped > max(1.0, MOST_DROPPED * frames)
