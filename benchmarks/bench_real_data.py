"""Real robots, zero-offsets only: `remaster fit` on the public sets beside this repository.

Prints the mean error on the held-out poses, nothing refitted, and what an independent fit of
others reached with registration, marker and zero-offsets.

    python benchmarks/bench_real_data.py [FOLDER]        (default: ../shared/data)
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# Largest held-out mean that is as good as the independent fit's, mm.
LIMITS_MM = {'ur10_two_solutions': 1.02, 'irb120_three_points': 0.64}


def main() -> None:
    beside = Path(__file__).resolve().parents[2] / 'shared' / 'data'
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else beside
    print('set                   rows  held out  before   after   limit mm  converged  command s')
    for name, limit in LIMITS_MM.items():
        if not (data / name).is_dir():
            print(f'{name:21s} is not in {data}')
            continue
        with tempfile.TemporaryDirectory() as out:
            command = [sys.executable, '-m', 'remaster_ros.cli.main', 'fit', str(data / name)]
            started = time.perf_counter()
            subprocess.run([*command, '--out', out, '--no-figures', '--quiet'], check=True)
            seconds = time.perf_counter() - started
            result = json.loads((Path(out) / 'fit.json').read_text(encoding='utf-8'))
        metric = result['accuracy']['validation']['post_registration']
        before, after = metric['before']['mean_mm'], metric['after']['mean_mm']
        sizes = result['session']
        print(
            f'{name:20s} {sizes["optimization"]["observations"]:5d} '
            f'{sizes["validation"]["observations"]:9d} {before:7.3f} {after:7.3f} '
            f'{"<=" if after <= limit else "> "} {limit:.2f}     '
            f'{"yes" if result["sampler"]["converged"] else "NO":9s} {seconds:8.1f}'
        )


if __name__ == '__main__':
    main()
