# SPDX-License-Identifier: Apache-2.0
"""Do the intervals that a fit shows hold on arms whose elbow is off its drawing?

Of each hidden session the arm that was measured has the origin of one of joints 3 to 5 elsewhere
than its robot description has it, along a random axis, by 0.1 to 1 mm. How many of the offsets
lie in their 95 % intervals, as fit.json shows them and as they are if the arm is exactly its
drawing.

    OMP_NUM_THREADS=1 python benchmarks/bench_drawing.py --sessions 30
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from common import table

import remaster_ros
from remaster_ros.calibration.fit import fit_session
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.loadable import uncertainty
from remaster_ros.types import BoolArray, FloatArray, Priors, Session

FIRST_SEED = 500
ELBOW = (2, 3, 4)
OFF_M = (1e-4, 1e-3)


def off_its_drawing(session: Session, joint: str, shift_m: FloatArray) -> Session:
    """Return a session with a robot description whose joint is elsewhere than the arm's."""
    root = ElementTree.fromstring(session.urdf)
    origin = next(j for j in root.findall('joint') if j.get('name') == joint).find('origin')
    assert origin is not None
    xyz = np.array([float(value) for value in origin.attrib['xyz'].split()]) - shift_m
    origin.set('xyz', ' '.join(map(repr, xyz.tolist())))
    return replace(session, urdf=ElementTree.tostring(root, encoding='unicode'))


def inside(seed: int, tolerance_m: float) -> tuple[float, BoolArray, BoolArray]:
    """Return how far the joint is off, m, and which offsets lie in shown and narrow intervals."""
    rng = np.random.default_rng(seed)
    made = remaster_ros.simulate(poses=25, validation_poses=8, seed=seed)
    chain = SerialChain.from_urdf(made.session.urdf, made.session.base_link)
    shift = np.zeros(3)
    shift[rng.integers(3)] = off = rng.choice((-1.0, 1.0)) * rng.uniform(*OFF_M)
    session = off_its_drawing(made.session, chain.joint_names[rng.choice(ELBOW)], shift)
    priors = Priors(geometry_tolerance_m=tolerance_m)
    result = fit_session(session, rng=np.random.default_rng(seed), priors=priors)
    known = result.identifiable
    hits = [
        (
            (interval[:, 0] <= made.truth.joint_offsets)
            & (made.truth.joint_offsets <= interval[:, 1])
        )
        for interval in (uncertainty(result).interval95, result.joint_offsets_interval95)
    ]
    return off, hits[0][known], hits[1][known]


def main() -> None:
    """Print how many offsets of all sessions lie in their intervals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=30)
    parser.add_argument('--tolerance-mm', type=float, default=0.1, help='of the drawing')
    args = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + args.sessions)
    found = [inside(seed, 1e-3 * args.tolerance_mm) for seed in seeds]
    rows = []
    for low, high in ((0.1, 0.4), (0.4, 0.7), (0.7, 1.0), (0.1, 1.0)):
        mine = [entry for entry in found if low <= 1e3 * abs(entry[0]) <= high]
        if not mine:
            continue
        shown, narrow = (np.concatenate([entry[k] for entry in mine]) for k in (1, 2))
        rows.append(
            (f'{low} to {high}', len(mine), len(shown), f'{100 * shown.mean():.1f} %',
             f'{100 * narrow.mean():.1f} %')
        )  # fmt: skip
    head = ('off by, mm', 'sessions', 'offsets', 'inside as shown', 'if exactly drawn')
    print(table(head, rows))


if __name__ == '__main__':
    main()
