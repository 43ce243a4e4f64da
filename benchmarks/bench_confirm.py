"""Do causes hold in another session of the arm? Pairs of sessions, the words counted.

The two sessions of a UR10 beside this repository, each confirmed by the other; then twenty pairs
of sessions of hidden arms. Two causes of four times the size that the best test finds are hidden
in the first. In the second, on another tour with sensors set up anew, they are the same, or one of
two and a half times the size, or one is gone; or nothing is hidden in either. An answer is right
if it is what was done to that cause; open answers are counted apart.

    OMP_NUM_THREADS=1 PYTHONPATH=test python benchmarks/bench_confirm.py [PAIRS]    (default: 20)
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import table
from hidden_sessions import HiddenSession, Recipe, another_session, hidden_session

from remaster_ros.discovery.confirmation import Confirmation, confirm
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.session.reader import read_session

KINDS = (
    'joint_compliance',
    'encoder_eccentricity',
    'encoder_scale',
    'backlash',
    'link_length',
    'joint_axis_tilt',
    'joint_coupling',
    'gear_periodic',
)
CASES = ('same', 'another size', 'one gone', 'nothing hidden')
WAVES = ('encoder_eccentricity', 'encoder_scale')
TIMES = 2.5
EXPECTED = {'same': 'confirmed', 'another size': 'changed', 'one gone': 'absent'}


def hidden_pairs(count: int) -> Iterator[tuple[str, HiddenSession, HiddenSession]]:
    """Give pairs of sessions, the first cause being the one that is changed or gone."""
    for seed in range(count):
        case = CASES[seed % len(CASES)]
        rng = np.random.default_rng([seed, 35])
        kinds = () if case == CASES[-1] else tuple(rng.choice(KINDS, 2, replace=False))
        first = hidden_session(Recipe(3500 + seed, kinds))
        effects = list(first.truth.effects)
        if case == 'another size':
            world = first.world
            effects[0] = world.of_size(effects[0], TIMES * world.size_m(effects[0]))
        if case == 'one gone':
            del effects[0]
        yield case, first, another_session(first, Recipe(7500 + seed), effects)


def expected(case: str, first: HiddenSession, name: str, joints: tuple[int, ...]) -> str:
    """Return the right answer for a cause that was found; '' for one that is not there."""
    for index, effect in enumerate(first.truth.effects):
        # A curve can have the shape of a wave of the same joint.
        alike = name == 'joint_error_curve' and effect.kind in WAVES
        if (effect.kind == name or alike) and set(effect.joints) <= set(joints):
            return EXPECTED[case] if index == 0 else 'confirmed'
    return ''


def answers(
    case: str, first: HiddenSession, found: Discovery, other: Confirmation
) -> Iterator[tuple[str, str]]:
    """Give what was to be answered, and what was, of every cause."""
    for effect, cause in zip(found.effects, other.effects, strict=False):
        yield expected(case, first, effect.name, effect.joints), cause.answer


def real() -> None:
    """Confirm both sessions of the UR10 by each other."""
    data = Path(__file__).resolve().parents[2] / 'shared' / 'data'
    sessions = {n: read_session(data / n) for n in ('ur10_two_solutions', 'ur10_iso_cubes')}
    rows = []
    for (name, session), other in zip(
        sessions.items(), reversed(list(sessions.values())), strict=True
    ):
        found = discover_session(session, rng=np.random.default_rng(0))
        started = time.process_time()
        there = confirm(found, other, np.random.default_rng(0))
        seconds = time.process_time() - started
        said = Counter(cause.answer for cause in there.effects)
        rows.append(
            (
                name,
                f'{100 * there.carried_over:.0f} %',
                ' '.join(
                    f'{1e3 * v:.3f}'
                    for v in (there.rms_before_m, there.rms_after_m, there.rms_own_m)
                ),
                f'{there.parameters_rms_sigmas:.2f}, {there.offsets_rms_sigmas:.2f}',
                ', '.join(f'{n} {word}' for word, n in said.items()),
                f'{seconds:.1f}',
            )
        )
    heads = (
        'causes of',
        'carried over',
        'mm RMS: without, as found, fitted there',
        'sigmas: causes, offsets',
        'answers',
        'CPU s',
    )
    print(table(heads, rows))


def main() -> None:
    real()
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    tally: Counter[tuple[str, str, str]] = Counter()
    for case, first, second in hidden_pairs(count):
        found = discover_session(first.session, rng=np.random.default_rng(0))
        other = confirm(found, second.session, np.random.default_rng(0))
        for right, said in answers(case, first, found, other):
            tally[case, right or 'not hidden', said] += 1
        if not found.effects:
            tally[
                case, 'nothing found', 'same offsets' if other.same_offsets else 'other offsets'
            ] += 1
    print(
        table(
            ('second session', 'right answer', 'answer', 'causes'),
            [(*key, str(n)) for key, n in sorted(tally.items())],
        )
    )


if __name__ == '__main__':
    main()
