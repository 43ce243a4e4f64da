# SPDX-License-Identifier: Apache-2.0
"""Proof of a fit of a moving arm by poses at standstill that it never fitted.

What the arm does in motion, and the model of motion lacks, is taken up by the zero-offsets and
seen at standstill: the error there is then larger than that of held-out motion, beyond chance. So
it is if the set-up was changed in between.
"""

from __future__ import annotations

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.types import FloatArray, IntArray, Measurements

LEVEL = 0.01
"""Probability by chance below which standstills and motion disagree: one fit in a hundred."""
FEWEST_POSES = 3
"""With fewer poses at standstill nothing is judged."""


class MotionProof(Struct, frozen=True):
    """Held-out errors after the fit at standstill and in motion, each of the markers' mean."""

    poses: int  # At standstill
    standstill_mm: float  # Mean 3-D error at these poses
    motion_mm: float  # And of held-out rows in motion
    fastest_mm_s: float  # Largest speed of a measured marker in motion
    chance: float  # Probability that the errors at standstill are so much larger by chance
    disagree: bool  # Whether it is below `LEVEL`

    @property
    def words(self) -> str:
        """Sentence with both errors, and what to do if they disagree."""
        errors = (
            f'On {self.poses} poses at standstill, which were never fitted, the mean of the '
            f'markers is off by {self.standstill_mm:.3f} mm; in motion that was not fitted, at up '
            f'to {self.fastest_mm_s:.0f} mm/s, by {self.motion_mm:.3f} mm'
        )
        if not self.disagree:
            return f'{errors}: the model of the motion holds.'
        return (
            f'{errors}. By chance it would be so much larger at standstill in '
            f'{100.0 * self.chance:.1g} '
            '% of fits. Either the sensor, a marker or the arm was changed between the motion and '
            'these poses (--proof takes a session of the same set-up), or the arm does something '
            'in motion that the model of the motion lacks, and the offsets contain it: measure '
            'with a lower speed_share, or by stop and go.'
        )


def motion_proof(
    m: Measurements, errors: FloatArray, speeds: FloatArray, friction: FloatArray
) -> MotionProof | None:
    """Compare held-out errors at standstill with those in motion; None if it cannot be done.

    None without velocities, or with fewer than 3 held-out poses at standstill, or held-out
    segments in motion (`FEWEST_POSES`).

    Parameters
    ----------
    m
        All rows, n.
    errors
        Measured less modelled positions, m, (n, 3).
    speeds
        Speeds of the markers, m/s, (n,); 0 at standstill.
    friction
        Variance of the marker's position (sum over three axes) by unknown friction at rest, m²,
        (n,).

    Notes
    -----
    The ratio of mean squares of frames' mean errors is compared with the F distribution, that of
    motion with the friction's variance added. Rows of one segment of motion count as one, since
    their errors are correlated. A frame at standstill has less white noise than one in motion, so
    that the test errs to the side of no claim.
    """
    if m.velocity is None:
        return None
    moves = np.any(np.nan_to_num(m.velocity) != 0.0, axis=1)
    still, in_motion = (np.flatnonzero(m.is_validation & rows) for rows in (~moves, moves))
    poses, segments = len(np.unique(m.pose[still])), len(np.unique(m.pose[in_motion]))
    if min(poses, segments) < FEWEST_POSES:
        return None
    at_rest, moving = (_of_frames(m, errors, rows) for rows in (still, in_motion))
    expected = float(np.mean(moving**2) + np.mean(friction[still]) / 3.0)
    chance = float(scipy.stats.f.sf(np.mean(at_rest**2) / expected, 3 * poses, 3 * segments))
    standstill_mm, motion_mm = (
        1e3 * float(np.mean(np.linalg.norm(means, axis=1))) for means in (at_rest, moving)
    )
    fastest_mm_s = 1e3 * float(speeds[moves].max())
    return MotionProof(poses, standstill_mm, motion_mm, fastest_mm_s, chance, chance < LEVEL)


def _of_frames(m: Measurements, errors: FloatArray, rows: IntArray) -> FloatArray:
    """Mean error of the markers in each frame of rows (indices), m, (frames, 3).

    A frame is one sensor at one configuration. ``errors``: of all rows of ``m``, m, (n, 3).
    """
    frame = np.stack((m.sensor[rows], m.configuration[rows]))
    of = np.unique(frame, axis=1, return_inverse=True)[1].reshape(-1)
    total = np.zeros((of.max() + 1, 3))
    np.add.at(total, of, errors[rows])
    return np.asarray(total / np.bincount(of)[:, None])
