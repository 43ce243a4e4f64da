"""Judge the tests of the code that limits motion: coverage of lines and branches, and mutants.

Copies the modules and their tests into a temporary folder, where coverage.py counts what the tests
reach and mutmut changes the code in all its ways, one change at a time: the tests must fail for
each. Ends with status 1 where a line or branch is not reached or a mutant survives that
`motion_mutants.yaml` does not explain.

    python benchmarks/check_motion_code.py            (pip install coverage mutmut)
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
EXPLAINED = Path(__file__).with_name('motion_mutants.yaml')
LEFT_OUT = ('__init__', 'path_search')
"""Path search is a dozen lines around the collision model, and has its tests there."""
MODULES = [
    f'remaster_ros/motion/{path.name}'
    for path in sorted((ROOT / 'remaster_ros' / 'motion').glob('*.py'))
    if path.stem not in LEFT_OUT
]
TESTS = [
    str(path.relative_to(ROOT))
    for path in sorted((ROOT / 'test' / 'unit' / 'motion').glob('test_*.py'))
    if path.stem.removeprefix('test_') not in LEFT_OUT
]
CONFIG = """\
[mutmut]
source_paths=remaster_ros
only_mutate=
    {modules}
pytest_add_cli_args_test_selection=
    {tests}
also_copy=
    config
    pytest.ini
"""


def main() -> int:
    """Print the figures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--children', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--keep', type=Path, help='work in this folder and leave it')
    parser.add_argument('--only', nargs='+', default=[''], help='parts of the names of modules')
    parser.add_argument('--tests', nargs='+', default=[''], help='parts of the names of tests')
    parser.add_argument('--no-mutants', action='store_true', help='coverage only')
    args = parser.parse_args()
    modules = [name for name in MODULES if any(part in name for part in args.only)]
    tests = [name for name in TESTS if any(part in name for part in args.tests)]
    folder = args.keep or Path(tempfile.mkdtemp(prefix='motion_code_'))
    try:
        prepare(folder, modules, tests)
        missed = coverage(folder, modules, tests)
        survivors = 0 if args.no_mutants else mutants(folder, args.children)
    finally:
        if args.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    return 1 if missed or survivors else 0


def prepare(folder: Path, modules: list[str], tests: list[str]) -> None:
    """Copy what the tests need."""
    folder.mkdir(exist_ok=True)
    for name in ('remaster_ros', 'config', 'test/unit/motion'):
        shutil.copytree(
            ROOT / name,
            folder / name,
            ignore=shutil.ignore_patterns('__pycache__', 'mutants'),
            dirs_exist_ok=True,
        )
    shutil.copy(ROOT / 'pytest.ini', folder)
    (folder / 'setup.cfg').write_text(
        CONFIG.format(modules='\n    '.join(modules), tests='\n    '.join(tests)), encoding='utf-8'
    )


def coverage(folder: Path, modules: list[str], tests: list[str]) -> bool:
    """Run the tests under coverage.py; return whether anything is not reached."""
    include = ','.join(modules)
    python = [sys.executable, '-m']
    run(folder, *python, 'coverage', 'run', '--branch', f'--include={include}', '-m', 'pytest',
        '-q', *tests)  # fmt: skip
    report = run(
        folder, *python, 'coverage', 'report', '--show-missing', '--fail-under=100', check=False
    )
    print(report.stdout)
    return report.returncode != 0


def mutants(folder: Path, children: int) -> int:
    """Run mutmut; return how many mutants the tests did not notice."""
    mutmut = [sys.executable, '-m', 'mutmut']
    began = time.monotonic()
    done = run(folder, *mutmut, 'run', '--max-children', str(children), check=False)
    results = run(folder, *mutmut, 'results', '--all', 'true').stdout
    fates = [line.rsplit(': ', 1) for line in results.splitlines() if ': ' in line]
    counts = Counter(fate for _, fate in fates)
    if not counts:
        sys.exit(f'mutmut made no mutants:\n{done.stdout[-2000:]}{done.stderr[-2000:]}')
    print(f'{sum(counts.values())} mutants in {time.monotonic() - began:.0f} s: {dict(counts)}')
    unnoticed = [name.strip() for name, fate in fates if fate not in ('killed', 'timeout')]
    explained = yaml.safe_load(EXPLAINED.read_text(encoding='utf-8'))
    survivors = 0
    for name in unnoticed:
        module, key = what(name, run(folder, *mutmut, 'show', name, check=False).stdout)
        if key not in explained.get(module, {}):
            survivors += 1
            print(f'{name}\n{module}:\n  {json.dumps(key)}:')
    print(f'{len(unnoticed)} not noticed, {survivors} of them not explained')
    return survivors


def what(name: str, diff: str) -> tuple[str, str]:
    """Return the module of a mutant, and its function and change in words that stay the same."""
    path, _, _ = name.rpartition('__mutmut_')
    module, _, function = path.partition('.x')
    changed = {
        sign: ' '.join(
            line[1:].strip()
            for line in diff.splitlines()
            if line.startswith(sign) and not line.startswith(3 * sign)
        )
        for sign in '-+'
    }
    function = function[1:].replace('\u01c1', '.')
    return module.rpartition('.')[2], f'{function}: {changed["-"]} -> {changed["+"]}'


def run(folder: Path, *command: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a command in the folder, quietly unless it fails."""
    environment = {**os.environ, 'OMP_NUM_THREADS': '1', 'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1'}
    environment['PYTEST_ADDOPTS'] = '-p pytest_timeout -p no:cacheprovider'
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if check and done.returncode:
        sys.exit(f'{" ".join(command)} failed:\n{done.stdout[-3000:]}{done.stderr[-3000:]}')
    return done


if __name__ == '__main__':
    raise SystemExit(main())
