# SPDX-License-Identifier: Apache-2.0
"""Sessions of 30 s of motion: are offsets, clock and their intervals right?

Worlds of test/worlds/moving_world.py: pinocchio, with dynamics and an error field of its own. In
each a recording is imported as of a bag and fitted, with the dynamics and, beside it, without.
`--fakes` takes what the fakes of `remaster demo --dynamics` say in the place of these worlds.
`--planned` drives the curves of `remaster plan --moving` in them.

    python benchmarks/bench_moving.py --sessions 60 --fakes 40
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import common
import numpy as np
from worlds.dynamic_fakes import play
from worlds.moving_bags import imported, recorded, standing
from worlds.moving_world import Dynamics, Errors
from worlds.planned_motion import driven
from worlds.simple_cells import four_markers

from remaster_ros.calibration.dynamics import clocks_of, estimate_moving
from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.fit import fit_session
from remaster_ros.discovery.discover import discover_session
from remaster_ros.errors import InsufficientDataError
from remaster_ros.planning.moving_design import design_moving
from remaster_ros.planning.moving_information import expected_along
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import FloatArray, Session

COLOURS = {'good': 'green', 'caution': 'amber', 'bad': 'red'}
# Of an interval of 95 %, in standard deviations.
WITHIN = 1.96


@dataclass(frozen=True)
class World:
    """Worlds of one kind."""

    name: str
    scale: float  # Of the dynamics
    tool_speed: float | None  # m/s
    own_field_m: float = 0.0  # Error field of each marker by itself

    def session(self, seed: int) -> tuple[Session, FloatArray, float]:
        """Return a session, the true offsets, and the delay of the sensor's stamps, s."""
        world, recording = recorded(
            seed,
            tool_speed=self.tool_speed,
            dynamics=Dynamics(scale=self.scale),
            errors=Errors(own_field_m=self.own_field_m),
        )
        session, _ = imported(world, recording, seed)
        return session, world.joint_offsets, recording.delay_s


WORLDS = (
    World('0.25 m/s, dynamics × 1', 1.0, 0.25),
    World('0.25 m/s, dynamics × 3', 3.0, 0.25),
    World('no limit at the tool, × 1', 1.0, None),
    World('no limit at the tool, × 3', 3.0, None),
)
OF_EACH_MARKER = World('0.25 m/s, × 1, and 0.05 mm of each marker', 1.0, 0.25, 5e-5)


def inner(found: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return offsets and standard deviations of joints 2 to k - 1, rad."""
    model, free = found.model, found.posterior.free
    std = dict(zip(free.tolist(), np.sqrt(np.diag(found.mode.covariance)), strict=False))
    x = model.natural(found.mode.z)
    return model.offsets(x)[1:-1], np.array([std[j] for j in range(1, model.joints - 1)])


def row(world: World, seeds: range) -> Iterator[object]:
    """Give the cells of a line of the table."""
    errors, stds, clocks, clock_stds, cpu = [], [], [], [], []
    naive_errors, naive_stds = [], []
    for seed in seeds:
        session, truth, delay_s = world.session(seed)
        begun = time.process_time()
        problem = Problem.of(session)
        found = estimate_moving(problem)
        cpu.append(time.process_time() - begun)
        offsets, std = inner(found)
        errors.append(offsets - truth[1:-1])
        stds.append(std)
        late_s, late_std = clocks_of(found)['bar']
        clocks.append(-late_s - delay_s)
        clock_stds.append(late_std)
        offsets, std = inner(estimate(problem))
        naive_errors.append(offsets - truth[1:-1])
        naive_stds.append(std)
    e, s = np.array(errors), np.array(stds)
    z, naive = e / s, np.array(naive_errors) / np.array(naive_stds)
    yield from (world.name, len(seeds))
    yield from (f'{np.degrees(_rms(e)):.4f}', f'{np.degrees(_rms(s)):.4f}')
    yield from (f'{_rms(z):.2f}', f'{100.0 * np.mean(np.abs(z) < WITHIN):.0f} %')
    yield f'{1e3 * _rms(np.array(clocks)):.3f} ({1e3 * _rms(np.array(clock_stds)):.3f})'
    yield f'{_rms(np.array(clocks) / np.array(clock_stds)):.2f}'
    yield f'{np.degrees(_rms(np.array(naive_errors))):.4f}'
    yield f'{_rms(naive):.1f}'
    yield f'{np.mean(cpu):.2f}'


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def verdicts(count: int) -> str:
    """Return the colours of fits of sessions whose velocities were taken away, and CPU times."""
    colours: dict[str, int] = {}
    fits, discoveries = [], []
    for seed in range(count):
        world = WORLDS[seed % len(WORLDS)]
        session, _, _ = world.session(seed)
        begun = time.process_time()
        fit_session(session, rng=np.random.default_rng(0))
        fits.append(time.process_time() - begun)
        if seed < 2:
            begun = time.process_time()
            discover_session(session, rng=np.random.default_rng(0))
            discoveries.append(time.process_time() - begun)
        still = replace(session.measurements, velocity=None, acceleration=None)
        try:
            naive = fit_session(replace(session, measurements=still), rng=np.random.default_rng(0))
            colour = COLOURS[verdict(naive).mood]
        except InsufficientDataError:
            colour = 'refused'
        colours[colour] = colours.get(colour, 0) + 1
    listed = ', '.join(f'{name} {number}' for name, number in colours.items())
    return (
        f'Fits of {count} of these sessions without their velocities: {listed}. CPU of '
        f'`fit_session` {np.mean(fits):.1f} s (at most {max(fits):.1f}), of `discover_session` '
        f'{", ".join(f"{cpu_s:.1f}" for cpu_s in discoveries)} s.'
    )


def of_fakes(count: int, scale: float, first: int) -> str:
    """Return how offsets and clocks of 30 s of the fakes' motion agree with their truth."""
    z, stds, clocks = [], [], []
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder:
            played = play(Path(folder), seed, 30.0, scale=scale)
            truth, dynamics = played.world.truth.joint_offsets, played.world.dynamics
            played.world.close()
        assert dynamics is not None
        found = estimate_moving(Problem.of(played.session(seed)))
        offsets, std = inner(found)
        z.append((offsets - truth[1:-1]) / std)
        stds.append(std)
        # The clock found is that beside the mean lag of the joints' reports.
        clocks.append(dynamics.cameras['mocap'].late_s - clocks_of(found)['mocap'][0])
    off = np.array(z)
    return (
        f'Fakes of the demo, dynamics × {scale:g}, {count} sessions of 30 s, three markers, seeds '
        f'from {first}: std {np.degrees(_rms(np.array(stds))):.4f}°, RMS z {_rms(off):.2f}, '
        f'{100.0 * np.mean(np.abs(off) < WITHIN):.0f} % in 95 %; the camera is late by '
        f'{1e3 * np.mean(clocks):.2f} ms more than what is found (the reports of the joints are '
        f'late themselves), from {1e3 * min(clocks):.2f} to {1e3 * max(clocks):.2f}.'
    )


def stop_and_go(count: int) -> str:
    """Return how offsets by moving frames of stop-and-go recordings agree with those at rest."""
    scores = []
    for seed in range(5000, 5000 + count):
        world, recording = recorded(seed, seconds=18.0, stops=True)
        session, _ = imported(world, recording)
        moving, std = inner(estimate_moving(Problem.of(session)))
        still, still_std = inner(estimate(Problem.of(standing(world, recording))))
        scores.append((moving - still) / np.hypot(std, still_std))
    return (
        f'Moving frames of {count} stop-and-go recordings (some 22 stops, seeds from 5000) and '
        f'their standstills: RMS z of the differences of offsets {_rms(np.array(scores)):.2f}.'
    )


# Errors of the worlds of planned curves. A plan assumes the lengths of the first.
FIELDS = (
    Errors(),
    Errors(reach_m=0.05, reach_rad=0.25),
    Errors(reach_m=0.2, reach_rad=1.0),
    Errors(own_field_m=5e-5),
)


def planned(count: int, seconds: float, tool_speed: float) -> Iterator[str]:
    """Give how fits of planned curves agree with what the plan expects, and with the truth."""
    with tempfile.TemporaryDirectory() as folder:
        cell = read_cell(four_markers(Path(folder) / 'cell.yaml'))
    scene, settings = (
        cell.planning_scene(cell.chain(), without_meshes=True),
        cell.design_settings(),
    )
    limits = cell.acceleration_limits(scene.model.chain)
    travel = TravelTime.of(scene.model, 0.3, tool_speed, limits)
    begun = time.process_time()
    designs = [
        design_moving(scene, travel, settings, scene.rough_R, np.random.default_rng(seed), seconds)
        for seed in range(count)
    ]
    cpu = (time.process_time() - begun) / count
    yield f'{count} plans of {seconds:g} s, at most {tool_speed:g} m/s; CPU of a plan {cpu:.0f} s'
    for errors in FIELDS:
        stds, ratios, z = [], [], []
        for seed, design in enumerate(designs):
            expected = expected_along(
                scene.model.chain,
                design.rows,
                settings.sensors,
                settings.marker_std_m,
                settings.priors,
                errors.own_field_m,
            )
            promised = np.array(list(expected.joint_std.values())[1:-1], float)
            world, _, session = driven(cell, design.curves, seed, errors)
            offsets, std = inner(estimate_moving(Problem.of(session)))
            stds.append(promised)
            ratios.append(_rms(std) / _rms(promised))
            z.append((offsets - world.joint_offsets[1:-1]) / std)
        yield (
            f'  field of {1e3 * errors.field_m:g} mm over {errors.reach_m:g} m and '
            f'{errors.reach_rad:g} rad, of each marker {1e3 * errors.own_field_m:g} mm: expected '
            f'std {np.degrees(_rms(np.array(stds))):.4f}°, stated over expected '
            f'{np.mean(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}), RMS z '
            f'{_rms(np.array(z)):.2f}'
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sessions', type=int, default=12, help='of all worlds together')
    parser.add_argument('--verdicts', type=int, default=4, help='sessions whose fits are judged')
    parser.add_argument('--stops', type=int, default=0, help='stop-and-go recordings')
    parser.add_argument('--fakes', type=int, default=0, help='sessions of the fakes')
    parser.add_argument('--planned', type=int, default=0, help='sessions of planned curves')
    args = parser.parse_args()
    print(common.machine())
    each = args.sessions // len(WORLDS)
    header = (
        'world',
        'sessions',
        'RMS error, deg',
        'stated std',
        'RMS z',
        'in 95 %',
        'clock error (std), ms',
        'its z',
        'without dynamics, deg',
        'its z',
        'CPU, s',
    )
    seeds = [range(1000 * i, 1000 * i + each) for i in range(len(WORLDS))]
    rows = [[*row(world, numbers)] for world, numbers in zip(WORLDS, seeds, strict=True)]
    rows.append([*row(OF_EACH_MARKER, range(9000, 9000 + max(1, each // 3)))])
    print(common.table(header, rows))
    print(f'seeds {", ".join(f"{span.start} to {span.stop - 1}" for span in seeds)}')
    print(verdicts(args.verdicts))
    if args.stops:
        print(stop_and_go(args.stops))
    for scale in (1.0, 3.0):
        if args.fakes:
            print(of_fakes(args.fakes // 2, scale, 100))
    for seconds, tool_speed in ((30.0, 0.25), (40.0, 0.25), (60.0, 0.25), (40.0, np.inf)):
        if args.planned:
            for line in planned(args.planned, seconds, tool_speed):
                print(line)


if __name__ == '__main__':
    main()
