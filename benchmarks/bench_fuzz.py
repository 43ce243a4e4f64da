"""Ten million damaged NatNet datagrams and a million emScon packets: no crash, hang or growth.

In valid messages of every version bits are flipped, parts cut, spliced and repeated, counts made
absurd and numbers replaced by NaN or infinity (test/fuzz_messages.py). The bare decoders and the
clients, all but their sockets, receive them. The work is cut into blocks of known seed; a finished
block is recorded, so that the next run continues where this one stopped. A failure is recorded
with its input and ends the run with status 1.

`--atheris N` first lets Google's coverage-guided fuzzer (pip install atheris; CPython 3.11 to
3.13) look N times for inputs that reach new code; what it finds joins the valid messages.

Run: python benchmarks/bench_fuzz.py [--datagrams 10000000] [--packets 1000000] [--out fuzz_state]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing import Pool
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test'))

import fuzz_messages  # noqa: E402
import fuzzing  # noqa: E402

BLOCK = 50_000
GROWTH_LIMIT_MB = 20.0
COVERAGE_GUIDED = Path(__file__).with_name('fuzz_coverage.py')


def work(job: tuple[str, int, int, Path]) -> dict[str, Any]:
    """Run one block; return what is written down about it."""
    kind, number, inputs, corpus = job
    rng = random.Random(f'{kind} {number}')
    more = [path.read_bytes() for path in sorted((corpus / kind).glob('*'))]
    if kind == 'natnet':
        # The first byte of a coverage-guided input chose the version.
        more = [data[1:] for data in more]
    begun = time.perf_counter()
    result: dict[str, Any] = {'kind': kind, 'block': number, 'inputs': inputs}
    try:
        if kind == 'natnet':
            version = fuzz_messages.VERSIONS[number % len(fuzz_messages.VERSIONS)]
            client = fuzzing.NatNetClientTarget(rng, version)
            with fuzzing.silent_natnet_client():
                outcome = fuzzing.run(
                    fuzz_messages.natnet_mutator(rng, version, more),
                    [fuzzing.decode_as_any_version(rng), client],
                    inputs,
                )
            result['readings'] = client.samples
        else:
            tracker = fuzzing.TrackerClientTarget(rng)
            outcome = fuzzing.run(
                fuzz_messages.emscon_mutator(rng, more),
                [fuzzing.read_from_both_sides(rng), tracker],
                inputs,
            )
            result['readings'] = tracker.readings
    except fuzzing.FuzzError as error:
        return {**result, 'failure': str(error)}
    return {
        **result,
        'longest_s': outcome.longest_s,
        'grown_mb': outcome.grown_mb,
        'resident_mb': fuzzing.resident_mb(),
        'process': os.getpid(),
        'seconds': time.perf_counter() - begun,
    }


def jobs(kind: str, inputs: int, done: set[tuple[str, int]], corpus: Path) -> Iterator[Any]:
    """Yield the blocks that are not done yet."""
    for number, begin in enumerate(range(0, inputs, BLOCK)):
        if (kind, number) not in done:
            yield kind, number, min(BLOCK, inputs - begin), corpus


def memory_growth_mb(kind: str, blocks: list[dict[str, Any]]) -> float:
    """Return the most that a process has grown after its first block, which warms it up."""
    sizes: dict[int, list[float]] = {}
    for block in blocks:
        if block['kind'] == kind and 'seconds' in block:
            sizes.setdefault(block['process'], []).append(block['resident_mb'])
    return max((max(of_one) - of_one[0] for of_one in sizes.values()), default=0.0)


def summary(kind: str, blocks: list[dict[str, Any]]) -> str:
    """Return one line on what has been done of a kind."""
    blocks = [block for block in blocks if block['kind'] == kind and 'seconds' in block]
    if not blocks:
        return f'{kind}: nothing yet'
    inputs = sum(block['inputs'] for block in blocks)
    seconds = sum(block['seconds'] for block in blocks)
    return (
        f'{kind}: {inputs} inputs, {inputs / seconds:.0f} a second and core, '
        f'slowest {max(block["longest_s"] for block in blocks) * 1e3:.1f} ms of processor time, '
        f'memory grown by {memory_growth_mb(kind, blocks):.1f} MB at most, '
        f'{sum(block["readings"] for block in blocks)} readings came through'
    )


def main() -> int:
    """Run what is left to do; print as it goes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--datagrams', type=int, default=10_000_000)
    parser.add_argument('--packets', type=int, default=1_000_000)
    parser.add_argument('--processes', type=int, default=os.cpu_count())
    parser.add_argument('--atheris', type=int, default=0, help='coverage-guided runs of each kind')
    parser.add_argument('--out', type=Path, default=Path('fuzz_state'))
    args = parser.parse_args()
    corpus = args.out / 'corpus'
    corpus.mkdir(parents=True, exist_ok=True)
    for kind in ('natnet', 'emscon') if args.atheris else ():
        command = [sys.executable, COVERAGE_GUIDED, kind, corpus / kind, str(args.atheris)]
        if subprocess.run(command, check=False).returncode:
            print(f'the coverage-guided fuzzer failed on {kind}: see above', file=sys.stderr)
            return 1
        print(f'{kind}: {len(list((corpus / kind).iterdir()))} inputs of new coverage', flush=True)

    journal = args.out / 'blocks.jsonl'
    blocks = (
        [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []
    )
    done = {(block['kind'], block['block']) for block in blocks if 'failure' not in block}
    todo = [
        *jobs('natnet', args.datagrams, done, corpus),
        *jobs('emscon', args.packets, done, corpus),
    ]
    failed = False
    with journal.open('a') as file, Pool(args.processes) as pool:
        for count, block in enumerate(pool.imap_unordered(work, todo), start=1):
            file.write(json.dumps(block) + '\n')
            file.flush()
            blocks.append(block)
            if 'failure' in block:
                failed = True
                print(f'FAILED: {block["kind"]} block {block["block"]}: {block["failure"]}')
            if count % 10 == 0 or count == len(todo):
                print(
                    f'{count} of {len(todo)} blocks; {summary(block["kind"], blocks)}', flush=True
                )
    for kind in ('natnet', 'emscon'):
        print(summary(kind, blocks))
        if memory_growth_mb(kind, blocks) > GROWTH_LIMIT_MB:
            failed = True
            print(f'FAILED: {kind}: memory grows')
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
