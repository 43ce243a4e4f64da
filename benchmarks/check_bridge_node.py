"""Judge the tests of the robot bridge's shell by mutants of it.

Changes the node and what it is made of, one small change at a time (see mutants.py), and runs
their tests against each in a process of its own, forked after everything else was imported: DDS
does not outlive a fork, so no test has run before. The tests must fail, or not end. Ends with
status 1 where a mutant survives that `bridge_mutants.yaml` does not explain.
Each mutant meets the tests that reach its lines (coverage.py), those of module level all of them.

    python benchmarks/check_bridge_node.py [--only robot_bridge] [--children 2] [--resume FILE]
                                           (pip install coverage)
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType
from typing import Any

import yaml
from coverage import Coverage, CoverageData
from diagnostic_msgs.msg import DiagnosticArray
from mutants import Mutant, mutants_of
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

ROOT = Path(__file__).resolve().parents[1]
NODES = 'test/unit/nodes'
MODULES = {
    'remaster_ros.session.halt_file': ['test/unit/session/test_halt_file.py'],
    'remaster_ros.motion.path_search': ['test/unit/motion/test_path_search.py'],
    'remaster_ros.nodes.background': [f'{NODES}/test_background.py'],
    'remaster_ros.nodes.emergency_link': [f'{NODES}/test_emergency_link.py'],
    'remaster_ros.nodes.rivals': [f'{NODES}/test_rivals.py'],
    'remaster_ros.nodes.bridge_parameters': [f'{NODES}/test_bridge_parameters.py'],
    'remaster_ros.nodes.robot_bridge': [
        f'{NODES}/test_bridge_node.py',
        f'{NODES}/test_bridge_halts.py',
    ],
}
EXPLAINED = Path(__file__).with_name('bridge_mutants.yaml')
BEFORE = (
    'hostile_arm',
    'numpy',
    'pytest',
    'rclpy.executors',
    'rclpy.node',
    'remaster_ros.kinematics.free_paths',
    'remaster_ros.collection.events',
    'remaster_ros.motion.arm_supervisor',
    'remaster_ros.nodes.waypoints',
    'remaster_ros.nodes.parameters',
    'remaster_ros.nodes.running',
    'remaster_ros.nodes.status',
    'remaster_ros.session.workcell',
    'remaster_ros.reports.fit_json',
    'simple_cells',
)
"""Imported before the forks: slow, and nothing of what is changed."""
DOMAIN = 216
TIMEOUT_S = 120.0
CONTROL, CONTROL_EVERY = 'control', 40
"""After so many mutants the tests run without a change; on an overloaded machine they fail too."""


class Changed(SourceFileLoader, MetaPathFinder):
    """Loads one module from another source."""

    def __init__(self, name: str, path: str, source: str) -> None:
        super().__init__(name, path)
        self._source = source

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Find the module."""
        if fullname != self.name:
            return None
        return spec_from_file_location(fullname, self.path, loader=self)

    def get_code(self, fullname: str) -> CodeType:
        """Compile the other source."""
        return compile(self._source, self.path, 'exec', dont_inherit=True)


def main() -> int:
    """Print the figures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--children', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--only', action='append', help='the last part of a module name')
    parser.add_argument('--match', default='', help='only mutants with this text in their names')
    parser.add_argument('--resume', type=Path, help='keep results there, and do not repeat them')
    args = parser.parse_args()
    os.environ |= {'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1', 'OMP_NUM_THREADS': '1'}
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / 'test'), str(ROOT / NODES)]
    for name in BEFORE:
        importlib.import_module(name)
    for kind in (JointState, JointTrajectory, DiagnosticArray, String, Trigger):
        # Else rclpy loads the libraries of a message when it is first used.
        type(kind).__import_type_support__()
    explained = yaml.safe_load(EXPLAINED.read_text()) if EXPLAINED.exists() else {}
    left = 0
    for module, tests in MODULES.items():
        short = module.rpartition('.')[2]
        if not args.only or short in args.only:
            left += judge(module, tests, explained.get(short) or {}, args)
    return 1 if left else 0


def judge(
    module: str, tests: list[str], explained: dict[str, str], args: argparse.Namespace
) -> int:
    """Run the mutants of a module; return how many survive without an explanation."""
    path = ROOT / (module.replace('.', '/') + '.py')
    text = path.read_text(encoding='utf-8')
    began = time.monotonic()
    reached = reach(module, path, text, tests)
    alone_s = time.monotonic() - began
    known = results_before(args.resume, module)
    fates: dict[str, str] = {}
    todo = []
    for mutant in mutants_of(text):
        if args.match not in mutant.name:
            continue
        fate = known.get(mutant.name)
        if fate:
            fates[mutant.name] = fate
        else:
            todo.append(mutant)
    lines = {mutant.name: mutant.line for mutant in mutants_of(text)}
    control = Mutant(CONTROL, 0, 0, text)
    for place in range(0, len(todo) + len(todo) // CONTROL_EVERY + 1, CONTROL_EVERY + 1):
        todo.insert(place, control)
    controls: Counter[str] = Counter()
    for mutant, fate in run_all(module, path, reached, todo, args.children):
        if mutant is control:
            controls[fate] += 1
            continue
        fates[mutant.name] = fate
        if args.resume:
            with args.resume.open('a', encoding='utf-8') as file:
                file.write(json.dumps([module, mutant.name, fate]) + '\n')
        if fate == 'survived' and mutant.name not in explained:
            print(f'  {path.name}:{mutant.line}: {mutant.name}', flush=True)
    alive = [name for name, fate in fates.items() if fate == 'survived']
    left = [name for name in alive if name not in explained]
    counts = Counter(fates.values())
    print(
        f'{module}: {len(fates)} mutants, {dict(counts)}, {len(alive) - len(left)} explained, '
        f'{len(left)} not; {controls["survived"]} of {controls.total()} runs without a change '
        f'passed; tests {alone_s:.0f} s alone, all {time.monotonic() - began:.0f} s',
        flush=True,
    )
    for name in left if args.resume else ():
        print(f'  left: {path.name}:{lines[name]}: {name}')
    for name in explained.keys() - fates.keys() if not args.match else ():
        print(f'  explained, but no mutant any more: {name}')
    return len(left)


def reach(module: str, path: Path, text: str, tests: list[str]) -> dict[int, list[str]]:
    """Run the tests without a change; return which of them reach each line.

    Line 0 has all of them, in their order.
    """
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / 'coverage'
        pid = start(module, path, text, tests, 0, data)
        if wait_for({pid: (0, None, time.monotonic())})[2] != 'survived':
            sys.exit(f'{module}: its tests fail without any change')
        found = CoverageData(basename=str(data))
        found.read()
        contexts = found.contexts_by_lineno(str(path))
    files = {Path(test).stem: test for test in tests}
    reached: dict[int, list[str]] = {0: tests}
    for line, names in contexts.items():
        parts = sorted(name.rpartition('.')[::2] for name in names)
        # What is run as the module is imported is reached by every test.
        if all(stem in files for stem, _ in parts):
            reached[line] = [f'{files[stem]}::{test}' for stem, test in parts]
    return reached


def results_before(file: Path | None, module: str) -> dict[str, str]:
    """Return the fates that a former run has kept."""
    if file is None or not file.exists():
        return {}
    rows = map(json.loads, file.read_text(encoding='utf-8').splitlines())
    return {name: fate for owner, name, fate in rows if owner == module}


def run_all(
    module: str, path: Path, reached: dict[int, list[str]], todo: Sequence[Mutant], children: int
) -> Any:
    """Yield each mutant with its fate; some run at a time."""
    waiting = list(reversed(todo))
    running: dict[int, tuple[int, Mutant | None, float]] = {}
    while waiting or running:
        while waiting and len(running) < children:
            slot = min(set(range(children)) - {slot for slot, _, _ in running.values()})
            mutant = waiting.pop()
            lines = range(mutant.line, mutant.last_line + 1)
            tests = list(dict.fromkeys(t for line in lines for t in reached.get(line, [])))
            pid = start(module, path, mutant.source, tests or reached[0], slot)
            running[pid] = slot, mutant, time.monotonic()
        _, mutant, fate = wait_for(running)
        yield mutant, fate


def start(
    module: str, path: Path, source: str, tests: list[str], slot: int, lines: Path | None = None
) -> int:
    """Fork a process that runs the tests with another source; `lines` takes what they reach."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    status = 1
    with contextlib.suppress(BaseException):
        os.setpgid(0, 0)
        with tempfile.TemporaryFile() as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
        os.environ['REMASTER_TEST_DOMAIN'] = str(DOMAIN + slot)
        sys.meta_path.insert(0, Changed(module, str(path), source))
        import pytest

        options = ['-x', '-q', '-p', 'pytest_timeout', '-p', 'no:cacheprovider']
        # A test that waits in vain for a message does so for seconds, not for a minute.
        counter = None
        if lines is not None:
            counter = Coverage(data_file=str(lines), include=[str(path)])
            counter.set_option('run:dynamic_context', 'test_function')
            counter.start()
        status = int(pytest.main([*options, '--timeout=30', *tests]))
        if counter is not None:
            counter.stop()
            counter.save()
    os._exit(status)


def wait_for(
    running: dict[int, tuple[int, Mutant | None, float]],
) -> tuple[int, Mutant | None, str]:
    """Wait for one to end; take it out of `running`; return its process, mutant and fate."""
    while True:
        for pid, (_, mutant, began) in list(running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            late = time.monotonic() - began > TIMEOUT_S
            if not ended and late:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            if ended or late:
                del running[pid]
                fate = 'timeout' if not ended else 'killed' if status else 'survived'
                return pid, mutant, fate
        time.sleep(0.02)


if __name__ == '__main__':
    raise SystemExit(main())
