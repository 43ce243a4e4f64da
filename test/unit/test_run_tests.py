# SPDX-License-Identifier: Apache-2.0
"""tools/run-tests: every test is in one group, and a failure in any of them is a failure."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GROUPS = ('motion', 'others')
# In place of Python: notes its arguments, and ends with the status that is set for its group.
STUB = """#!/bin/bash
group=$(grep -o 'pytest_cache/[a-z]*' <<< "$*")
group=${group#*/}
echo "$@" > "$(dirname "$0")/$group.arguments"
exit "$(cat "$(dirname "$0")/$group" 2>/dev/null || echo 0)"
"""


@pytest.fixture
def run(tmp_path):
    """Return a function that runs the script with a status for each group."""

    def run_with(*arguments, **statuses):
        stub = tmp_path / 'python'
        stub.write_text(STUB, encoding='utf-8')
        stub.chmod(0o755)
        for group, status in statuses.items():
            (tmp_path / group).write_text(str(status), encoding='utf-8')
        done = subprocess.run(
            [ROOT / 'tools' / 'run-tests', stub, *arguments], timeout=60, check=False
        )
        return done.returncode

    return run_with


def arguments_of(tmp_path):
    return {path.stem: path.read_text().split() for path in tmp_path.glob('[a-z]*.arguments')}


@pytest.mark.parametrize('qualify', [False, True])
def test_each_test_file_is_in_one_group(run, tmp_path, qualify):
    assert run(*['--qualify'][: int(qualify)], '-k', 'name') == 0
    groups = arguments_of(tmp_path)
    assert set(groups) == set(GROUPS)
    assert all(arguments[-2:] == ['-k', 'name'] for arguments in groups.values())
    paths = {group: [w for w in groups[group] if w.startswith('test/')] for group in GROUPS}
    left_out = [word.split('=')[1] for word in groups['others'] if word.startswith('--ignore=')]
    assert paths['motion'] == left_out
    assert all((ROOT / path).is_file() for path in left_out)
    folders = ['test/system', 'test/integration', 'test/unit']
    assert paths['others'] == ['test/qualification'] * qualify + folders
    assert all(any(f'{folder}/' in path for folder in paths['others']) for path in left_out)


def test_campaigns_and_their_folder_are_left_to_qualify(run, tmp_path):
    assert run() == 0
    for words in arguments_of(tmp_path).values():
        assert '-m' not in words[2:]
        assert not any('test/qualification' in word for word in words)
    assert run('--qualify') == 0
    groups = arguments_of(tmp_path)
    assert all('-m' in words[2:] for words in groups.values())
    assert 'test/qualification/test_watching.py' in groups['motion']


def test_files_that_are_named_run_alone_with_their_campaigns(run, tmp_path):
    assert run('--qualify', 'test/unit/test_run_tests.py', chosen=1) == 1
    (words,) = arguments_of(tmp_path).values()
    assert words[-2:] == ['-m', 'test/unit/test_run_tests.py']


@pytest.mark.parametrize('group', GROUPS)
def test_a_failure_in_any_group_is_a_failure(run, group):
    assert run(**{group: 1}) == 1


def test_a_group_without_a_test_of_the_name_is_none(run):
    """Pytest ends with 5 where it has selected no test."""
    assert run(motion=5, others=0) == 0
    assert run(motion=0, others=5) == 0
    assert run(motion=5, others=5) == 5


def test_files_that_are_named_run_alone(run, tmp_path):
    assert run('test/unit/test_run_tests.py', '-x', chosen=3) == 3
    assert set(arguments_of(tmp_path)) == {'chosen'}


def test_no_two_test_modules_have_one_name():
    """Make qualify collects all folders in one process, which refuses a name that comes twice."""
    names = [path.name for path in (ROOT / 'test').rglob('test_*.py')]
    assert sorted(names) == sorted(set(names))
