# SPDX-License-Identifier: Apache-2.0
"""Write docs/examples: two arms and tables as others write them (made up: a simulated IRB 120).

Run it with test/ on the path: `PYTHONPATH=test python docs/make_examples.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from foreign.tables import measured, text, write
from worlds.robot_descriptions import ROBOTS

FOLDER = Path(__file__).parent / 'examples'
AXES = [f'A{i}' for i in range(1, 7)]
XYZ = ['X', 'Y', 'Z']


def main() -> None:
    """Write every file of the folder."""
    FOLDER.mkdir(exist_ok=True)
    for robot in ('irb120', 'panda', 'ur5e'):
        write(FOLDER, f'{robot}.urdf', ROBOTS[robot]().urdf)
    arm = measured('irb120', rows=40)
    names = [f'P{i:02d}' for i in range(len(arm.q))]
    degrees, mm = np.rad2deg(arm.q).T, 1e3 * arm.points.T
    header = ['Punkt', *(f'{axis} [°]' for axis in AXES), *(f'{axis} [mm]' for axis in XYZ)]
    pendant = text(header, [names, *degrees, *mm], ';', ',')
    write(FOLDER, 'pendant.csv', pendant, 'cp1252')
    times = [f'2026-03-04 09:{i:02d}:00' for i in range(len(names))]
    rows = text(['Point Name', *XYZ, 'Timestamp'], [names, *mm, times], '\t')
    write(FOLDER, 'tracker.txt', f'// Units: Millimeters\n{rows}')
    order = np.random.default_rng(1).permutation(len(names))
    joints = [[names[i] for i in order], *degrees[:, order]]
    write(FOLDER, 'joints.csv', text(['Name', *AXES], joints))
    named = ['name', *(f'joint_{i}' for i in range(1, 7)), 'x_mm', 'y_mm', 'z_mm']
    write(FOLDER, 'no_times.csv', text(named, [names, *degrees, *mm]))
    reverse = degrees * np.array([1, 1, -1, 1, 1, 1])[:, None]
    write(FOLDER, 'reversed.csv', text(['name', *AXES, *XYZ], [names, *reverse, *mm]))
    bumped()


def bumped() -> None:
    """Write 80 shots, one a minute; before the 51st one somebody pushed the tracker by 0.6 mm."""
    arm = measured('irb120', rows=80, seed=1)
    mm = 1e3 * arm.points
    mm[50:] += [0.5, -0.3, 0.15]
    names = [f'P{i:02d}' for i in range(len(mm))]
    times = [f'2026-03-05 {9 + i // 60:02d}:{i % 60:02d}:00' for i in range(len(mm))]
    columns = [names, times, *np.rad2deg(arm.q).T, *mm.T]
    write(FOLDER, 'bumped.csv', text(['name', 'time', *AXES, *XYZ], columns))


if __name__ == '__main__':
    main()
