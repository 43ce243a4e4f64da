"""Arms that nothing was tuned for: public measurements of four robots, read from clones.

    git clone https://github.com/dongjy-s/LM_PyTorch CLONES/LM_PyTorch
    git clone https://github.com/RABKKK/LaserTrackerPoseData4KinIdent CLONES/Fanuc
    git clone https://github.com/Zhangzhongqiu/new-calibration CLONES/iiwa
    OMP_NUM_THREADS=1 python benchmarks/bench_unseen_arms.py CLONES

The first has a six-axis arm of 1.5 m reach at 50 poses and another of 1.8 m at 30, a laser
tracker's target on the tool; the second a FANUC of 2.6 m at 36 poses, three reflectors, one joint
moved at a time; the third a KUKA LBR iiwa 7 with seven joints at 1,402 poses. Drawings are the
models; link masses are known, roughly, of the iiwa only. Each session is searched as a whole, a
fifth held out, and by poses drawn at random: some fitted, a fifth as many held out, the others a
third set that neither search nor guard sees.
"""

from __future__ import annotations

import argparse
import csv
import io
import re
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io
from bench_real_splits import HEADER, Part, one, row_of
from common import table

from remaster_ros.session.reader import read_session
from remaster_ros.types import FloatArray

SPLITS = 8
SECONDS_APART = 30.0


class Arm(NamedTuple):
    """A robot and where its measurements are.

    Attributes
    ----------
    poses
        Drawn to be fitted.
    links
        Modified Denavit-Hartenberg table (Craig): alpha, deg; a, d, mm; theta at zero, deg.
    markers
        On the last link, roughly, mm.
    read
        Returns joint angles (n, k), deg, and places of the markers (n, markers, 3), mm.
    masses
        Of each link, kg, and where its centre of mass lies in its frame, mm.
    """

    poses: int
    links: tuple[tuple[float, float, float, float], ...]
    markers: tuple[tuple[float, float, float], ...]
    read: Callable[[Path], tuple[FloatArray, FloatArray]]
    masses: tuple[tuple[float, tuple[float, float, float]], ...] = ()


def committed(clone: Path, commit: str, path: str) -> bytes:
    """Return a file of a clone as it was at a commit."""
    command = ('git', '-C', str(clone), 'show', f'{commit}:{path}')
    return subprocess.run(command, check=True, capture_output=True).stdout


def with_target(commit: str) -> Callable[[Path], tuple[FloatArray, FloatArray]]:
    """Return what reads one of the arms with a single target."""

    def read(clones: Path) -> tuple[FloatArray, FloatArray]:
        clone = clones / 'LM_PyTorch'
        targets = committed(clone, commit, 'data/joint_angle.csv').decode()
        angles = {
            int(number): [float(word) for word in text.split(',')[:6]]
            for number, text in re.findall(r'jointtarget\s+j(\d+) = j:\{([^}]*)\}', targets)
        }
        text = committed(clone, commit, 'data/laser_pos.csv').decode()
        lines = text.replace(',', ' ').splitlines()
        places = {
            int(words[0].removeprefix('Motion')): [float(word) for word in words[7:10]]
            for words in map(str.split, lines)
            if words and words[0].startswith('Motion')
        }
        both = sorted(angles.keys() & places.keys())
        return np.array([angles[i] for i in both]), np.array([[places[i]] for i in both])

    return read


def fanuc(clones: Path) -> tuple[FloatArray, FloatArray]:
    """Read the FANUC, whose angle of joint 3 is against the horizontal."""
    values = np.loadtxt(io.BytesIO(committed(clones / 'Fanuc', 'HEAD', 'N1N2N3Jval.csv')))
    angles = values[:, -6:]
    angles[:, 2] += angles[:, 1]
    return angles, values[:, :9].reshape(-1, 3, 3)


def iiwa(clones: Path) -> tuple[FloatArray, FloatArray]:
    """Read the iiwa: angles, torques, and the tool's pose as a matrix in every row."""
    path = 'configuration/exp1/data1402.mat'
    values = scipy.io.loadmat(io.BytesIO(committed(clones / 'iiwa', 'HEAD', path)))['data1402']
    return np.degrees(values[:, :7]), values[:, 14:].reshape(-1, 4, 4)[:, None, :3, 3]


ARMS = {
    'arm50': Arm(
        30,
        (
            (0, 0, 285, 0),
            (-90, 0, 0, -90),
            (180, 760, 0, -90),
            (-90, 0, 540, 0),
            (90, 0, 150, 0),
            (-90, 0, 128, 0),
        ),
        ((0, 0, 240),),
        with_target('3bb4ff3'),
    ),
    'arm30': Arm(
        18,
        (
            (0, 0, 487, 0),
            (-90, 85, 0, -90),
            (0, 640, 0, 0),
            (-90, 205, 720, 0),
            (90, 0, 0, 0),
            (-90, 0, 75, 180),
        ),
        ((0, 0, 240),),
        with_target('cd13547'),
    ),
    'fanuc': Arm(
        22,
        (
            (0, 0, 0, 0),
            (-90, 312, 0, -90),
            (180, 1075, 0, 0),
            (-90, 225, -1280, 0),
            (90, 0, 0, 0),
            (-90, 0, -215, 0),
        ),
        ((0, 0, -340), (200, 50, -200), (-140, 150, -200)),
        fanuc,
    ),
    'iiwa': Arm(
        60,
        (
            (0, 0, 340, 0),
            (-90, 0, 0, 0),
            (90, 0, 400, 0),
            (90, 0, 0, 0),
            (-90, 0, 400, 0),
            (-90, 0, 0, 0),
            (90, 0, 126, 0),
        ),
        ((0, 0, 50),),
        iiwa,
        (
            (2.7, (0, -30, -80)),
            (2.7, (0, -60, 0)),
            (2.7, (0, 20, -150)),
            (2.7, (0, 60, 0)),
            (1.7, (0, 20, -180)),
            (1.6, (0, -10, 0)),
            (1.4, (0, 0, -60)),
        ),
    ),
}


def urdf(arm: Arm) -> str:
    """Return the drawing as a URDF; where theta is zero is put into the angles."""
    parts = ['<robot name="arm"><link name="base"/>']
    for number, (alpha, a, d, _) in enumerate(arm.links, start=1):
        turn = np.radians(alpha)
        place = np.array([a, -d * np.sin(turn), d * np.cos(turn)]) / 1e3
        parent = 'base' if number == 1 else f'link_{number - 1}'
        parts.append(
            f'<joint name="joint_{number}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{number}"/><origin xyz="{" ".join(map(str, place))}" '
            f'rpy="{turn} 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-7" upper="7" effort="100" velocity="2"/></joint>'
        )
        inertia = ''
        if arm.masses:
            mass, centre = arm.masses[number - 1]
            at = ' '.join(str(value / 1e3) for value in centre)
            inertia = (
                f'<inertial><origin xyz="{at}"/><mass value="{mass}"/><inertia ixx="0.01" '
                'ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
            )
        parts.append(f'<link name="link_{number}">{inertia}</link>')
    return '\n'.join([*parts, '</robot>'])


def write_session(folder: Path, arm: Arm, clones: Path) -> None:
    """Write all poses as a session, every fifth held out."""
    folder.mkdir()
    (folder / 'robot.urdf').write_text(urdf(arm), encoding='utf-8')
    markers = [f'  m{i}: {[value / 1e3 for value in at]}' for i, at in enumerate(arm.markers)]
    lines = [
        'format: remaster-session/1',
        f'robot: {{urdf: robot.urdf, base_link: base, tip_link: link_{len(arm.links)}}}',
        'markers:',
        *markers,
        'marker_std_m: 0.1',
        'sensors: {tracker: {marker: m0}}',
        'settle_s: 3.0',
    ]
    (folder / 'session.yaml').write_text('\n'.join(lines), encoding='utf-8')
    degrees, places = arm.read(clones)
    q = np.radians(degrees + [link[3] for link in arm.links])
    columns = ['observation', 'pose', 'configuration', 'split', 'stamp_s', 'sensor', 'marker']
    for prefix in ('', 'from_'):
        columns += [f'{prefix}q{joint}_rad' for joint in range(1, len(arm.links) + 1)]
    columns += ['x_m', 'y_m', 'z_m', 'std_x_m', 'std_y_m', 'std_z_m', 'samples', 'temperature_c']
    with (folder / 'observations.csv').open('w', newline='', encoding='utf-8') as file:
        rows = csv.DictWriter(file, columns)
        rows.writeheader()
        count = len(arm.markers)
        for index in range(len(q) * count):
            pose, marker = divmod(index, count)
            row = {
                'observation': index,
                'pose': pose,
                'configuration': pose,
                'split': 'optimization' if pose % 5 else 'validation',
                'stamp_s': SECONDS_APART * (pose + marker / count),
                'sensor': 'tracker',
                'marker': f'm{marker}',
            }
            row |= {f'q{joint}_rad': value for joint, value in enumerate(q[pose], start=1)}
            row |= dict(zip(('x_m', 'y_m', 'z_m'), places[pose, marker] / 1e3, strict=True))
            rows.writerow(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('clones', type=Path, help='folder with the three clones')
    parser.add_argument('--only', nargs='*', default=list(ARMS), choices=list(ARMS))
    args = parser.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in args.only:
            folder = Path(scratch) / name
            write_session(folder, ARMS[name], args.clones)
            session = read_session(folder)
            every = [Part(name, 'random', ARMS[name].poses, seed) for seed in range(1, SPLITS + 1)]
            for part in (Part(name, 'whole', 0, 0), *every):
                lines.append(one(part, session, Path(scratch) / f'{name}.npz'))
                print(lines[-1]['name'], lines[-1]['headline'], flush=True)
    print(table(HEADER, [row_of(line) for line in lines]))


if __name__ == '__main__':
    main()
