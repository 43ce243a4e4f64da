# SPDX-License-Identifier: Apache-2.0
"""Whatever a verb raises becomes one line on stderr and an exit status."""

import os
import subprocess
import sys
import types

import pytest
from rigs.command_line import remaster

from remaster_ros.cli import main as cli
from remaster_ros.errors import DeviceError, InputError, InsufficientDataError


@pytest.fixture
def run_raising(monkeypatch, capsys):
    """Return a function that runs a verb that raises; gives status and stderr."""

    def run(error):
        def raise_it(args):
            raise error

        verb = types.SimpleNamespace(add_arguments=lambda parser: None, run=raise_it)
        monkeypatch.setattr(cli.importlib, 'import_module', lambda name: verb)
        status = cli.main(['fit'])
        out, err = capsys.readouterr()
        assert out == ''
        return status, err

    return run


@pytest.mark.parametrize(
    ('error', 'status', 'line'),
    [
        (
            InputError('a.csv, line 3: bad;\n  correct it'),
            2,
            'error: a.csv, line 3: bad; correct it',
        ),
        (DeviceError('the tracker is mute'), 2, 'error: the tracker is mute'),
        (InsufficientDataError('two poses'), 1, 'error: two poses'),
        (OSError(28, 'No space left on device', 'fit.json'), 2, 'error: fit.json: No space left'),
        (KeyboardInterrupt(), 130, 'stopped'),
        (ZeroDivisionError('division by zero'), 2, 'error: a fault of this program'),
    ],
)
def test_errors_are_one_line(run_raising, error, status, line):
    found, err = run_raising(error)
    assert found == status
    assert err.startswith(line)
    assert err.count('\n') == 1


def test_a_fault_of_the_program_can_be_traced(run_raising, monkeypatch):
    monkeypatch.setenv(cli.TRACEBACK, '1')
    status, err = run_raising(ZeroDivisionError('division by zero'))
    assert status == 2
    assert 'Traceback' in err
    assert 'in raise_it' in err


def test_every_verb_takes_the_common_options():
    for verb in cli.VERBS:
        help_text = cli.build_parser(verb)
        actions = help_text._subparsers._group_actions[0].choices[verb]._option_string_actions
        assert {'--seed', '--quiet', '--no-figures'} <= set(actions), verb


def test_help_lists_the_verbs():
    out = remaster('--help').stdout
    assert all(verb in out for verb in cli.VERBS)
    assert 'Exit status' in out


def test_without_a_verb_it_shows_its_help():
    out = remaster().stdout
    assert out.startswith('usage: remaster')
    assert all(verb in out for verb in cli.VERBS)


@pytest.mark.parametrize('shell', cli.SHELLS)
def test_it_prints_what_completes_it_in_a_shell(shell):
    assert 'remaster' in remaster('--completion', shell).stdout


@pytest.mark.parametrize(
    ('line', 'words'),
    [
        ('remaster im', {'import '}),
        ('remaster recover --', {'--json', '--seed', '--quiet', '--no-figures', '--help'}),
        ('remaster replay --w', {'--wait-for', '--with-commands'}),
    ],
)
def test_a_shell_that_asks_is_answered(line, words, tmp_path):
    """As argcomplete asks: the line in the environment, the answer on file descriptor 8."""
    answer = tmp_path / 'answer'
    environment = {
        **os.environ,
        '_ARGCOMPLETE': '1',
        '_ARGCOMPLETE_IFS': '\v',
        'COMP_LINE': line,
        'COMP_POINT': str(len(line)),
        'COMP_TYPE': '9',
    }
    command = f'"{sys.executable}" -m remaster_ros.cli.main 8>"{answer}" 9>/dev/null'
    subprocess.run(['bash', '-c', command], env=environment, check=True, timeout=60)
    assert set(answer.read_text().split('\v')) == words


def test_every_verb_that_prints_results_takes_json():
    without = {'demo', 'replay', 'watch'}
    for verb in set(cli.VERBS) - without:
        parser = cli.build_parser(verb)._subparsers._group_actions[0].choices[verb]
        assert '--json' in parser._option_string_actions, verb


@pytest.mark.parametrize('other', [['--hide', 'backlash@4'], ['--apply'], ['--full']])
def test_a_moving_demo_refuses_what_it_does_not_take(other, capsys, monkeypatch):
    monkeypatch.setattr('remaster_ros.cli.demo.become', lambda *_: pytest.fail('it began'))
    assert cli.main(['demo', '--moving', *other]) == 2
    assert capsys.readouterr().err.startswith('error: --moving goes without')


@pytest.mark.parametrize(('given', 'moving_s'), [([], 40.0), (['30'], 30.0)])
def test_a_moving_demo_has_dynamics_and_takes_the_time_of_a_real_arm(given, moving_s, monkeypatch):
    begun = {}
    monkeypatch.setattr('remaster_ros.cli.demo.become', lambda *how: begun.update(how[2]) or 0)
    cli.main(['demo', '--moving', *given, '--out', 'x'])
    wanted = {'cell': 'moving', 'moving_s': moving_s, 'dynamics': 1.0, 'rate': 1.0}
    assert begun.items() >= wanted.items()
    begun.clear()
    cli.main(['demo', '--out', 'x'])
    assert begun['dynamics'] == 0.0
    assert 'moving_s' not in begun
