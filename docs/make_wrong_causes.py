# SPDX-License-Identifier: Apache-2.0
"""Where obvious methods name the wrong cause: three kinds of session of the hidden world.

    python docs/make_wrong_causes.py [--seeds 10] [--figure docs/figures/wrong_causes.svg]

*Greedy*: of all causes the one whose effect correlates best with the residuals, all rows alike.
*Full DH*: every link offset and axis tilt by least squares; the most significant is to blame.
Both name what is significant at 1 % by the textbook's F and t tests, corrected for how many causes
were tried (Bonferroni). Neither looks at noise that a pose shares, at groups, at other causes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.stats import f as f_test
from scipy.stats import t as t_test

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / 'test'))

from worlds.hidden_tours import world  # noqa: E402
from worlds.hidden_world import Noise  # noqa: E402

from remaster_ros.discovery.discover import Discovery, discover_session  # noqa: E402
from remaster_ros.discovery.effects.base import Candidate  # noqa: E402
from remaster_ros.discovery.effects.registry import EFFECTS  # noqa: E402
from remaster_ros.discovery.residuals import Residuals  # noqa: E402
from remaster_ros.simulation.hidden_effect import HiddenEffect  # noqa: E402

NOISE = Noise(0.08e-3, 0.1e-3)
SHARED_NOISE = Noise(0.05e-3, 0.25e-3)
HIDDEN = {
    'sag': [HiddenEffect('joint_compliance', (2, 4), np.array([3e-5, 5e-5]))],
    'shared noise': [],
    'depth': [
        HiddenEffect('sensor_scale', (), np.array([2e-3]), {'form': 'depth', 'sensor': 'mocap'})
    ],
}
TRUTH = {'sag': 'joint_compliance [2, 4]', 'shared noise': 'nothing', 'depth': 'sensor_scale'}
SIGNIFICANCE = 0.01


def searched(kind: str, seed: int) -> Discovery:
    """Make a session with one thing hidden, and search it."""
    rng = np.random.default_rng([seed, 5])
    noise = NOISE if HIDDEN[kind] else SHARED_NOISE
    session, _ = world('iiwa7', rng).measure(HIDDEN[kind], noise, rng)
    return discover_session(session, rng=rng)


def ours(found: Discovery) -> str:
    """Return the causes that the product names."""
    return ' + '.join(_named(e.name, e.joints) for e in found.effects) or 'nothing'


def greedy(data: Residuals) -> str:
    """Name the candidate with the largest correlation, sine and cosine counting as one."""
    base, errors = _flat(data)
    left = errors - base @ (base.T @ errors)
    best, name, tried, freedom = 0.0, '', 0, len(left) - base.shape[1]
    for effect in EFFECTS.values():
        if effect.name in ('marker_offset', 'joint_error_curve') or effect.needs(data.context):
            continue
        for candidate in effect.candidates(data.context):
            if candidate.size > 2:
                continue
            columns = _columns(data, candidate, base)
            explained = np.linalg.norm(np.linalg.qr(columns)[0].T @ left)
            tried += 1
            if explained > best:
                p_value = _p_value(explained**2, left @ left, candidate.size, freedom)
                best, name = float(explained), _named(candidate.name, candidate.joints)
                if candidate.name == 'unnamed':
                    name += f' ({candidate.place} by {candidate.driver})'
    return name if p_value * tried < SIGNIFICANCE else 'nothing'


def _p_value(explained: float, total: float, size: int, freedom: int) -> float:
    """Return the F test's, of a share of a sum of squares: rows taken as independent."""
    freedom -= size
    return float(f_test.sf(explained / size / ((total - explained) / freedom), size, freedom))


def full_dh(data: Residuals) -> str:
    """Fit all of the geometry; name the link parameter with the largest t."""
    base, errors = _flat(data)
    candidates = [
        candidate
        for name in ('link_length', 'joint_axis_tilt')
        for candidate in EFFECTS[name].candidates(data.context)
        if candidate.size == 1
    ]
    kept: list[Candidate] = []
    columns = np.zeros((len(base), 0))
    for candidate in candidates:
        new = _columns(data, candidate, base)
        rest = new - columns @ np.linalg.lstsq(columns, new, rcond=None)[0] if kept else new
        if np.linalg.norm(rest) > 1e-2:
            kept.append(candidate)
            columns = np.concatenate((columns, new), axis=1)
    left = errors - base @ (base.T @ errors)
    inverse = np.linalg.inv(columns.T @ columns)
    parameters = inverse @ columns.T @ left
    freedom = len(left) - base.shape[1] - columns.shape[1]
    spread = np.sum((left - columns @ parameters) ** 2) / freedom
    t = np.abs(parameters) / np.sqrt(spread * np.diag(inverse))
    worst = kept[int(np.argmax(t))]
    p_value = 2.0 * t_test.sf(t.max(), freedom)
    return _named(worst.name, worst.joints) if p_value * len(t) < SIGNIFICANCE else 'nothing'


def _flat(data: Residuals) -> tuple[np.ndarray, np.ndarray]:
    base = np.linalg.qr(data.base.reshape(3 * len(data), -1))[0]
    return base, data.errors.ravel()


def _columns(data: Residuals, candidate: Candidate, base: np.ndarray) -> np.ndarray:
    columns = data.columns([candidate]).reshape(3 * len(data), -1)
    left = columns - base @ (base.T @ columns)
    norm, before = np.linalg.norm(left, axis=0), np.linalg.norm(columns, axis=0)
    # What is absorbed is rounding: it explains nothing.
    return left * np.where(norm > 1e-4 * before, 1.0 / np.maximum(norm, 1e-30), 0.0)


def _named(name: str, joints: tuple[int, ...]) -> str:
    return f'{name} {list(joints)}' if joints else name


def draw(kind: str, found: Discovery, path: Path) -> None:
    """Draw what the two causes leave, against the torque, or the depth, that separates them."""
    from matplotlib.figure import Figure

    data = found.residuals
    scene, rows = data.context, data.rows.source
    figure = Figure(figsize=(8.4, 2.6), layout='constrained')
    axes = figure.subplots(1, 2, sharey=True)
    left = data.unexplained(found.empty)[rows]
    after = data.unexplained(found.solution)[rows]
    if kind == 'sag':
        motion = scene.jacobian[rows]
        length = np.linalg.norm(motion, axis=1)
        parts = [
            (scene.gravity_torque[rows, j], j, f'gravity torque on joint {j + 1} (N m)')
            for j in (1, 3)
        ]
        for ax, (x, j, label) in zip(axes, parts, strict=True):
            for errors, color, name in ((left, '#e07b39', 'before'), (after, '#3b82c4', 'after')):
                along = 1e3 * np.sum(motion[:, :, j] * errors, axis=1) / length[:, j]
                ax.plot(x, along, '.', color=color, markersize=3, label=name)
            ax.set_xlabel(label)
        axes[0].set_ylabel('error along the joint (mm)')
    else:
        depth = np.einsum('nji,nj->ni', scene.sensor_turn[rows], left)
        gone = np.einsum('nji,nj->ni', scene.sensor_turn[rows], after)
        places = (scene.in_sensor[rows, 2], scene.range_m[rows])
        labels = ('depth in the sensor frame (m)', 'distance from the sensor (m)')
        for ax, x, label in zip(axes, places, labels, strict=True):
            ax.plot(x, 1e3 * depth[:, 2], '.', color='#e07b39', markersize=3, label='before')
            ax.plot(x, 1e3 * gone[:, 2], '.', color='#3b82c4', markersize=3, label='after')
            ax.set_xlabel(label)
        axes[0].set_ylabel('error in depth (mm)')
    axes[0].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path.with_name(f'{path.stem}_{kind}.svg'), metadata={'Date': None})


def main() -> None:
    """Print the answers; draw on request."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--figure', type=Path, help='write two figures, of the first seed each')
    args = parser.parse_args()
    for kind, truth in TRUTH.items():
        right = {'greedy': 0, 'full DH': 0, 'remaster discover': 0}
        for seed in range(args.seeds):
            found = searched(kind, seed)
            data = found.residuals
            answers = dict(zip(right, (greedy(data), full_dh(data), ours(found)), strict=True))
            for method, answer in answers.items():
                right[method] += answer == truth
            print(f'{kind} {seed}: truth {truth}: {answers}', flush=True)
            if seed == 0 and args.figure and HIDDEN[kind]:
                draw(kind, found, args.figure)
        print(f'{kind}: named right in {right} of {args.seeds}', flush=True)


if __name__ == '__main__':
    main()
