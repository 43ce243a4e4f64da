# SPDX-License-Identifier: Apache-2.0
"""Hidden arms commanded by their compensation.json: what is left at poses measured and at random.

Four arms, each with zero-offsets of 0.3 degrees and one kind of error of 0.5 mm beside; measured
with 0.1 mm of noise, `discover`, the file read back, every pose commanded, none left out. The
judge is the hidden arm: pinocchio, and effects by their own equations.

- measured: the configurations of the session itself; random: all over 70 % of the joints' limits.
- command: what the commands leave of what the file knows (near singularities); by the file's arm.
- true: how far the hidden arm's marker is from where it is wanted, in the file's base frame.
- in 95 %: share of the poses that lie in the region that the file predicts for them.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import known, resumed, table
from judges.commanded_arms import ARM_KINDS, IN_95
from worlds.hidden_sessions import HiddenSession, Recipe, hidden_session
from worlds.hidden_world import Visits

import remaster_ros
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.reports.result_folder import save_discovery

ROBOTS = ('lwr4plus', 'iiwa7', 'panda', 'ur10')
# 'offsets' by themselves, and each kind beside them.
KINDS: Mapping[str, tuple[str, ...]] = {
    'offsets': (),
    'compliance': ('joint_compliance',),
    'eccentricity': ('encoder_eccentricity',),
    'curve': ('joint_error_curve',),
    'coupling': ('joint_coupling',),
    'length': ('link_length',),
    'tilt': ('joint_axis_tilt',),
}
SIZE_M = 0.5e-3
RANDOM = 1000
# Of the joints' limits, for random poses.
SHARE = 0.7


def run(item: tuple[str, tuple[str, str, int]]) -> dict[str, Any]:
    name, (robot, kind, seed) = item
    began = time.process_time()
    recipe = Recipe(
        zlib.crc32(f'commanded-{robot}-{kind}-{seed}'.encode()), KINDS[kind], size_m=SIZE_M,
        robot=robot, noise='plain',
    )  # fmt: skip
    hidden = hidden_session(recipe)
    found = remaster_ros.discover(hidden.session)
    with tempfile.TemporaryDirectory() as folder:
        save_discovery(found, folder, figures=False)
        file = remaster_ros.read_compensation(Path(folder) / 'apply' / 'compensation.json')
    rng = np.random.default_rng(recipe.seed)
    low, high = (SHARE * limit for limit in file.model.chain.usual_range)
    middle = 0.5 * sum(file.model.chain.usual_range) * (1.0 - SHARE)
    q = middle + rng.uniform(low, high, (RANDOM, file.model.joints))
    tours = {
        'measured': hidden.world.visits,
        'random': replace(
            hidden.world.visits,
            q=q,
            pose=np.arange(RANDOM),
            is_validation=np.zeros(RANDOM, dtype=bool),
        ),
    }
    seconds = time.process_time() - began
    return {
        'name': name,
        'verdict': found.verdict,
        'seconds': seconds,
        **{where: judge(hidden, file.compensator, tour) for where, tour in tours.items()},
    }


def judge(hidden: HiddenSession, compensator: Compensator, tour: Visits) -> dict[str, Any]:
    """Command the hidden arm along a tour, at every pose of it."""
    model, world = compensator.model, hidden.world.on(tour)
    (sensor, T), (marker, place) = (
        next(iter(model.T_R_N.items())),
        next(iter(model.markers.items())),
    )
    warm = model.reference_c + world.visited.warming_k
    wanted = apply(inverse(T), apply(model.chain.forward(tour.q), place))
    effects = [effect for effect in hidden.truth.effects if effect.kind in ARM_KINDS]
    command = compensator.command(tour.q, warm)
    seen = {
        key: hidden.world.on(replace(tour, q=at)).seen(effects)
        for key, at in (('before', tour.q), ('true', command))
    }
    errors = {key: np.linalg.norm(at - wanted, axis=1) for key, at in seen.items()}
    reached = apply(inverse(T), apply(model.state(command, warm).tool, place))
    errors['command'] = np.linalg.norm(reached - wanted, axis=1)
    covariance = T[:3, :3].T @ compensator.uncertainty(tour.q, sensor, marker) @ T[:3, :3]
    off = seen['true'] - wanted
    square = np.einsum('ni,ni->n', off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return {
        **{key: 1e3 * float(np.sqrt(np.mean(values**2))) for key, values in errors.items()},
        'median': 1e3 * float(np.median(errors['true'])),
        'predicted': 1e3 * float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
        'inside': float(np.mean(square < IN_95)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--results', type=Path, default=Path('bench_compensation.jsonl'))
    parser.add_argument('--robots', nargs='+', choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument('--kinds', nargs='+', choices=list(KINDS), default=list(KINDS))
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    wanted = {
        f'{robot}-{kind}-{seed}': (robot, kind, seed)
        for robot in args.robots
        for kind in args.kinds
        for seed in range(args.seeds)
    }
    done = known(args.results)
    todo = {name: entry for name, entry in wanted.items() if name not in done}
    for line in resumed(args.results, todo, run, args.jobs):
        done[line['name']] = line
        print(line['name'], line['verdict'], f'{line["seconds"]:.0f} s', flush=True)
    header = ('arm', 'hidden', *(
        f'{where}: {what}'
        for where in ('measured', 'random')
        for what in ('before', 'command', 'true', 'median', 'predicted', 'in 95 %')
    ))  # fmt: skip
    rows = []
    for robot in args.robots:
        for kind in args.kinds:
            lines = [done[f'{robot}-{kind}-{seed}'] for seed in range(args.seeds)]
            row: list[object] = [robot, kind]
            for where in ('measured', 'random'):
                mine = [line[where] for line in lines]
                for key in ('before', 'command', 'true', 'median', 'predicted'):
                    row.append(f'{np.sqrt(np.mean([entry[key] ** 2 for entry in mine])):.3f}')
                row.append(f'{np.mean([entry["inside"] for entry in mine]):.3f}')
            rows.append(row)
    print(table(header, rows))
    for where in ('measured', 'random'):
        every = [done[name][where] for name in wanted]
        true = np.array([entry['true'] for entry in every])
        inside = np.mean([entry['inside'] for entry in every])
        print(
            f'{where}: RMS {np.sqrt(np.mean(true**2)):.3f} mm, above 0.05 mm '
            f'{np.sum(true > 0.05)} of {len(true)}; in 95 % {inside:.3f}'
        )


if __name__ == '__main__':
    main()
