# SPDX-License-Identifier: Apache-2.0
"""Position accuracy and repeatability of a session with the visits that ISO 9283 requires.

References
----------
ISO 9283:1998, 7.2.1 (position accuracy AP) and 7.2.2 (position repeatability RP): 30 cycles of
five poses, each reached from the same side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.registration import register_points
from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.checking import Measured, is_same_pose
from remaster_ros.kinematics.transforms import apply
from remaster_ros.types import FloatArray

POSES = 5
CYCLES = 30


@dataclass(frozen=True, eq=False)
class IsoFigures:
    """Position accuracy AP and repeatability RP of ISO 9283, by one sensor and marker."""

    # Visits of each configuration, most first, (p,). Consecutive readings are one visit.
    visits: tuple[int, ...]
    # AP and RP of each configuration with `CYCLES` visits, m; empty if fewer than `POSES` have so
    # many
    accuracy_m: FloatArray
    repeatability_m: FloatArray

    def text(self) -> str:
        """Sentence with AP and RP at the worst pose, mm, or with what is missing for them."""
        if len(self.accuracy_m):
            return (
                f'ISO 9283, {len(self.accuracy_m)} poses of {CYCLES} visits and more: accuracy '
                f'(AP) {1e3 * self.accuracy_m.max():.3f} mm, repeatability (RP) '
                f"{1e3 * self.repeatability_m.max():.3f} mm at the worst pose, the sensor's noise "
                "included; the sensor's frame is fitted to these poses, and load and speed are "
                'those that you measured with: the standard asks for the rated ones.'
            )
        return (
            f'No figures of ISO 9283: it asks for {CYCLES} visits of each of {POSES} poses, and '
            f'here {len(self.visits)} were visited, {self.visits[0]} '
            f'{"time" if self.visits[0] == 1 else "times"} at most, '
            f'{sum(count >= CYCLES for count in self.visits)} of them {CYCLES} times.'
        )


def iso_figures(model: ArmModel, measured: Measured, wanted: FloatArray | None) -> IsoFigures:
    """Position accuracy and repeatability of ISO 9283 from repeated visits.

    Empty arrays if fewer than 5 poses (`POSES`) have 30 visits (`CYCLES`).

    Parameters
    ----------
    model
        Gives the marker on the tool and the nominal arm: the error is that from the commanded
        pose.
    measured
        Readings in the order in which they were taken.
    wanted
        Joints before any correction, rad, (n, k), NaN if nothing was corrected; None for the
        reported joints.
    """
    pairs = list(zip(measured.sensor, measured.marker, strict=True))
    most = max(dict.fromkeys(pairs), key=pairs.count)
    selection = np.array([pair == most for pair in pairs])
    q, position = measured.q[selection], measured.position[selection]
    commanded = (
        q if wanted is None else np.where(np.isnan(wanted[selection]), q, wanted[selection])
    )
    places: list[FloatArray] = []
    visits: list[list[list[int]]] = []
    last = -1
    for row, angles in enumerate(q):
        known = np.array(places).reshape(-1, len(angles))
        matches = np.flatnonzero(is_same_pose(model.chain, known, angles))
        at = int(matches[0]) if len(matches) else len(places)
        if not len(matches):
            places.append(angles)
            visits.append([])
        if at == last:
            visits[at][-1].append(row)
        else:
            visits[at].append([row])
        last = at
    counts = tuple(sorted(map(len, visits), reverse=True))
    enough = [each for each in visits if len(each) >= CYCLES]
    if len(enough) < POSES:
        return IsoFigures(counts, np.empty(0), np.empty(0))
    attained = [np.array([position[rows].mean(axis=0) for rows in each]) for each in enough]
    centres = np.array([points.mean(axis=0) for points in attained])
    rows = [np.concatenate(each) for each in enough]
    tool = model.chain.forward(np.array([commanded[group].mean(axis=0) for group in rows]))
    points = apply(tool, model.markers[most[1]])
    T_R_N, _ = register_points(points, centres)
    distances = [
        np.linalg.norm(group - centre, axis=1)
        for group, centre in zip(attained, centres, strict=True)
    ]
    return IsoFigures(
        counts,
        np.linalg.norm(apply(T_R_N, centres) - points, axis=1),
        np.array([each.mean() + 3.0 * each.std(ddof=1) for each in distances]),
    )
