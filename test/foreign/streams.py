# SPDX-License-Identifier: Apache-2.0
"""Takes and logs as programs write them: an arm that stops and goes, two clocks, for the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from foreign.tables import MARKER, Measured, measured, text
from scipy.spatial.transform import Rotation

from remaster_ros.kinematics.transforms import apply, transform


@dataclass(frozen=True, eq=False)
class Run:
    """An arm that visits the configurations of `arm`; begins and ends of its stops, s, (n,)."""

    arm: Measured
    begin: np.ndarray
    end: np.ndarray

    def joints(self, time_s: np.ndarray) -> np.ndarray:
        """Return the joints at each time, rad."""
        times = np.column_stack((self.begin, self.end)).ravel()
        q = np.repeat(self.arm.q, 2, axis=0)
        return np.column_stack([np.interp(time_s, times, column) for column in q.T])


def run_of(arm: Measured, seed: int = 0, alike: bool = False) -> Run:
    """Return a run of stops and moves; all equally long where they are to be alike."""
    rng = np.random.default_rng(seed)
    n = len(arm.q)
    stop = np.full(n, 1.5) if alike else rng.uniform(1.0, 2.0, n)
    move = np.full(n, 0.8) if alike else rng.uniform(0.5, 1.2, n)
    begin = np.concatenate(([0.0], np.cumsum(stop + move)[:-1]))
    return Run(arm, begin, begin + stop)


def sensor_of(arm: Measured) -> np.ndarray:
    """Return the frame that takes the arm's true points to those measured, (4, 4)."""
    true = arm.chain.positions(arm.q, MARKER, arm.offsets)
    a, b = true - true.mean(axis=0), arm.points - arm.points.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    R = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    return transform(R, arm.points.mean(axis=0) - R @ true.mean(axis=0))


def seen(run: Run, time_s: np.ndarray, seed: int, noise_m: float) -> np.ndarray:
    """Return where the marker of a run is seen, in the frame in which the arm's points are, m."""
    arm = run.arm
    points = arm.chain.positions(run.joints(time_s), MARKER, arm.offsets)
    points = apply(sensor_of(arm), points)
    return points + np.random.default_rng(seed).normal(0.0, noise_m, points.shape)


def turned(run: Run, time_s: np.ndarray) -> np.ndarray:
    """Return how the tool of a run is turned in that frame, quaternions x, y, z, w, (n, 4)."""
    arm = run.arm
    T = sensor_of(arm) @ arm.chain.forward(run.joints(time_s) + arm.offsets)
    return Rotation.from_matrix(T[:, :3, :3]).as_quat()


def log_of(run: Run, start_s: float = 0.0, rate_hz: float = 30.0, decimal: str = '.') -> str:
    """Return a log of joints by name; `start_s` is its clock at the beginning of the run."""
    time_s = np.arange(0.0, run.end[-1], 1.0 / rate_hz)
    header = ['__time', *[f'/joint_states/{name}/position' for name in run.arm.chain.joint_names]]
    separator = ',' if decimal == '.' else ';'
    return text(header, [time_s + start_s, *run.joints(time_s).T], separator, decimal)


def take_of(
    run: Run,
    version: str = '1.23',
    unit: str = 'Millimeters',
    separator: str = ',',
    begins_s: float = 0.0,
    ends_s: float = np.inf,
    rate_hz: float = 60.0,
    seed: int = 1,
    noise_m: float = 1e-4,
) -> str:
    """Return a take of Motive of a part of the run: the tool, its marker, and a body at rest.

    A tenth of the frames has lost the tool.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(begins_s, min(ends_s, run.end[-1]), 1.0 / rate_hz)
    scale = {'Millimeters': 1e3, 'Meters': 1.0}[unit]
    tool, quaternions = seen(run, time_s, seed, noise_m) * scale, turned(run, time_s)
    base = (np.array([0.5, 0.1, 1.0]) + rng.normal(0.0, noise_m, tool.shape)) * scale
    assets = [('Rigid Body', 'tool', tool), ('Rigid Body', 'base', base)]
    assets += [('Rigid Body Marker', 'tool:Marker1', tool + 1e-3 * scale)]
    assets += [('Marker', 'Unlabeled 1004', base)]
    head: list[list[str]] = [[], ['', 'Type'], ['', 'Name'], ['', 'ID'], ['', 'Parent'], ['', '']]
    axes = ['Frame', 'Time (Seconds)']
    columns: list[list[str]] = []
    lost = rng.uniform(size=len(time_s)) < 0.1
    for kind, name, points in assets:
        body = kind == 'Rigid Body'
        what = [('Rotation', 'XYZW')] * body + [('Position', 'XYZ')]
        what += [('Mean Marker Error' if body else 'Marker Quality', ' ')]
        for quantity, letters in what:
            for i, letter in enumerate(letters):
                for row, cell in zip(head[1:], (kind, name, '"1F"', '""', quantity)):
                    row.append(cell)
                axes.append(letter.strip())
                values = points[:, i] if quantity == 'Position' else np.full(len(points), 0.5)
                if quantity == 'Rotation' and name == 'tool':
                    values = quaternions[:, i]
                gone = lost if 'tool' in name else np.zeros(len(time_s), bool)
                columns.append(['' if g else f'{v:.6f}' for v, g in zip(values, gone)])
    if version < '1.24':
        del head[4]
    first = [
        'Format Version',
        version,
        'Take Name',
        'run 1',
        'Export Frame Rate',
        f'{rate_hz:.6f}',
    ]
    first += ['Rotation Type', 'Quaternion', 'Length Units', unit, 'Coordinate Space', 'Global']
    lines = [first, *head, axes]
    lines += [
        [str(i), f'{t - begins_s:.6f}', *cells]
        for i, (t, *cells) in enumerate(zip(time_s, *columns, strict=True))
    ]
    if separator != ',':
        lines = [[cell.replace('.', ',') for cell in line] for line in lines]
    return '\r\n'.join(separator.join(line) for line in lines) + '\r\n'


def arm_of(rows: int = 24, seed: int = 0) -> Measured:
    """Return a small arm that is measured at so many configurations."""
    return measured(rows=rows, seed=seed)


def capture_of(run: Run, rate_hz: float = 60.0, objects: bool = True) -> str:
    """Return a capture of Vicon: objects with quaternions (Tracker), or two markers (Nexus)."""
    time_s = np.arange(0.0, run.end[-1], 1.0 / rate_hz)
    tool = 1e3 * seen(run, time_s, 1, 1e-4)
    still = np.tile([500.0, 100.0, 1000.0], (len(tool), 1))
    if objects:
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(tool), 1))
        columns = [turned(run, time_s), tool, level, still]
        axes, units = 'RX,RY,RZ,RW,TX,TY,TZ', ',,,,mm,mm,mm'
        names = [f'Global Angle {name}:{name},,,,,,' for name in ('tool', 'base')]
    else:
        columns, axes, units = [tool, still], 'X,Y,Z', 'mm,mm,mm'
        names = [f'arm:{name},,' for name in ('tool', 'base')]
    head = ['Objects' if objects else 'Trajectories', f'{rate_hz:g}', f',,{",".join(names)}']
    head += [f'Frame,Sub Frame,{axes},{axes}', f',,{units},{units}']
    rows = [
        f'{i},0,{",".join(f"{v:.4f}" for v in row)}'
        for i, row in enumerate(np.column_stack(columns), 1)
    ]
    before = [] if objects else ['Model Outputs', '60', ',,arm:CoM,,', 'Frame,Sub Frame,X,Y,Z']
    before += [] if objects else [',,mm,mm,mm', '1,0,1,2,3', '']
    return '\n'.join([*before, *head, *rows, ''])
