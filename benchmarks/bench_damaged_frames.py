"""Damaged NatNet datagrams, which have no checksum, and readings of a marker that stands still.

The fuzzer's stream (test/fuzz_messages.py, test/fuzzing.py; seeds as in bench_fuzz.py): every
tenth datagram is a valid frame, the others are spoilt ones. What the client lets through becomes
readings of 60 frames as the recorder makes them (half a second at 120 Hz). The marker's true place
is known. (The fuzzer's marker moves along a line of 1 mm, so that no two frames are alike; that is
taken out, and noise of 0.1 mm per axis put in.) Counted are the frames and the readings that are
more than 2 mm off, and for comparison plain means of the same frames.

Run: python benchmarks/bench_damaged_frames.py [--blocks 11]
"""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test'))

import fuzz_messages  # noqa: E402
import fuzzing  # noqa: E402

from remaster_ros.collection.pairing import Pairing, Rejection, SensorRules  # noqa: E402
from remaster_ros.types import FloatArray, MarkerReading  # noqa: E402

BLOCK = 50_000
FRAMES = 60
OFF_M = 2e-3
NOISE_M = 1e-4
TRUE = np.array([0.1, 0.2, 2.0])
MOVES = np.array([0.0, 1e-3, 0.0])
RULES = SensorRules('mocap', 'sir')
SPACING_S = RULES.dwell_s / FRAMES


def frames_let_through(number: int) -> FloatArray:
    """Return the positions that the client hands on in one block, m, (n, 3)."""
    rng = random.Random(f'natnet {number}')
    version = fuzz_messages.VERSIONS[number % len(fuzz_messages.VERSIONS)]
    target = fuzzing.NatNetClientTarget(rng, version)
    found: list[FloatArray] = []
    look = target.client._on_sample
    target.client._on_sample = lambda sample: (look(sample), found.append(sample.position))
    with fuzzing.silent_natnet_client():
        fuzzing.run(fuzz_messages.natnet_mutator(rng, version), [target], BLOCK)
    positions = np.array(found).reshape(-1, 3)
    still = positions - np.clip(positions - TRUE, 0.0, MOVES)
    return still + NOISE_M * np.random.default_rng(number).standard_normal(still.shape)


def reading_of(frames: FloatArray) -> FloatArray | None:
    """Return the reading that the recorder makes of frames, m, (3,); None where it makes none."""
    pairing = Pairing(0.0, np.zeros(6), (RULES,))
    for i, position in enumerate(frames):
        pairing.add_reading('mocap', MarkerReading((i + 1) * SPACING_S, position))
    pairing.add_reading('mocap', MarkerReading(2.0 * RULES.dwell_s, frames[-1]))
    pairing.add_joint_state(2.0 * RULES.dwell_s, np.zeros(6))
    decided = pairing.decided['mocap']
    return None if isinstance(decided, Rejection) else decided.position


def off(positions: FloatArray) -> FloatArray:
    """Return how far positions are from the marker, m."""
    return np.linalg.norm(positions - TRUE, axis=-1)


def main() -> int:
    """Count; print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--blocks', type=int, default=11, help='of 50,000 datagrams (default 11)')
    args = parser.parse_args()
    frames = []
    plain, recorded, refused = [], [], 0
    for number in range(args.blocks):
        block = frames_let_through(number)
        frames.append(block)
        for begin in range(0, len(block) - FRAMES + 1, FRAMES):
            part = block[begin : begin + FRAMES]
            plain.append(off(part.mean(axis=0)))
            reading = reading_of(part)
            refused += reading is None
            if reading is not None:
                recorded.append(off(reading))
    for name, errors in (
        ('frames let through', off(np.concatenate(frames))),
        ('plain means of 60', np.array(plain)),
        ('readings recorded', np.array(recorded)),
    ):
        count = int(np.sum(errors > OFF_M))
        largest = f'{1e3 * errors.max():.3f} mm'
        print(f'{name}: {len(errors)}, more than 2 mm off {count}, largest {largest}')
    print(f'readings refused: {refused}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
