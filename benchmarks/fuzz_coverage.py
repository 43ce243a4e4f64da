"""Coverage-guided fuzzing of the decoders with atheris; what it finds is kept in a folder.

Run by bench_fuzz.py: python benchmarks/fuzz_coverage.py natnet|emscon FOLDER RUNS
"""

from __future__ import annotations

import contextlib
import random
import sys
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

with atheris.instrument_imports(include=['remaster_ros.sensors']):
    import fuzz_messages
    import fuzzing


def natnet_target(data: bytes) -> None:
    """Decode as every version in turn; the first byte chooses."""
    if data:
        version = fuzz_messages.VERSIONS[data[0] % len(fuzz_messages.VERSIONS)]
        with contextlib.suppress(fuzz_messages.natnet.ProtocolError):
            fuzz_messages.natnet.decode_message(data[1:], version)


def main() -> None:
    """Run atheris; it exits the process itself, with a status of its own after a crash."""
    kind, folder, runs = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
    folder.mkdir(parents=True, exist_ok=True)
    seeds = folder.with_name(f'{kind}_seeds')
    seeds.mkdir(exist_ok=True)
    if kind == 'natnet':
        messages = [
            bytes([index]) + data
            for index, version in enumerate(fuzz_messages.VERSIONS)
            for data in fuzz_messages.natnet_seeds(version)
        ]
        target = natnet_target
    else:
        messages = fuzz_messages.emscon_seeds()
        target = fuzzing.read_from_both_sides(random.Random(0))
    for index, data in enumerate(messages):
        (seeds / f'{index:04d}').write_bytes(data)
    options = [f'-atheris_runs={runs}', '-max_len=8192', '-timeout=10', '-rss_limit_mb=2048']
    atheris.Setup([sys.argv[0], *options, str(folder), str(seeds)], target)
    atheris.Fuzz()


if __name__ == '__main__':
    main()
