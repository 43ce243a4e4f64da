# SPDX-License-Identifier: Apache-2.0
"""A demo whose arm is halted says so, offers to go on, and fits what was measured."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from rich.console import Console

from remaster_ros.demo.demo import Demo
from remaster_ros.errors import DeviceError

pytestmark = pytest.mark.ros

WHY = 'no sign of robot for 3 s'


class Keys:
    """A terminal on which these lines are typed, one at each look; None for none there."""

    def __init__(self, lines):
        self.is_there, self._lines = lines is not None, list(lines or ())

    def line(self):
        return self._lines.pop(0) if self._lines else None


class HaltedDemo(Demo):
    """Of a bridge that is halted until a person clears it; no process and no ROS."""

    def __init__(self, lines, watch=False, quiet=False, spins=3, clears=1):
        self.console, self._keyboard, self._printed_reason = Console(quiet=quiet), Keys(lines), ''
        self.p = SimpleNamespace(watch=watch, quiet=quiet)
        self.summaries = {
            'robot_bridge': {'halted': WHY, 'message': WHY},
            'pose_planner': {'state': 'paused', 'configurations_done': '50', 'message': WHY},
        }
        self.node = SimpleNamespace(summaries=self.summaries)
        self.spins, self.clears, self.calls = spins, clears, []

    def _spin(self):
        self.spins -= 1
        if not self.spins and self._keyboard.line() is None and self.p.watch:
            # A person at the live page.
            self.summaries['robot_bridge']['halted'] = ''
        assert self.spins > -20, 'it waits for ever'

    def _estimate(self):
        self.calls.append('fit')
        if self.clears < 0:
            raise DeviceError('remaster/fit: too few poses')
        return []

    def _trigger(self, service, server, timeout_s=0.0):
        self.calls.append(service)
        if service == 'remaster/clear_halt':
            self.clears -= 1
            if self.clears:
                raise DeviceError('remaster/clear_halt: the arm is reported elsewhere')


@pytest.mark.parametrize('quiet', [False, True])
def test_where_nobody_is_at_the_terminal_what_was_measured_is_fitted(quiet, capsys):
    demo = HaltedDemo(None, quiet=quiet)
    assert not demo._wait_for_operator(WHY)
    said = capsys.readouterr()
    said = said.err if quiet else said.out
    assert f'the arm is halted: {WHY}. 50 configurations were measured' in said
    assert 'fitted' in said
    assert demo.calls == []


def test_where_nothing_was_measured_nothing_is_fitted(capsys):
    demo = HaltedDemo(None)
    demo.summaries['pose_planner']['configurations_done'] = '0'
    with pytest.raises(DeviceError, match='nothing to fit'):
        demo._wait_for_operator(WHY)
    assert f'the arm is halted: {WHY}' in capsys.readouterr().out


def test_a_person_at_the_terminal_goes_on_or_has_it_fitted(capsys):
    demo = HaltedDemo([None, ''])
    assert demo._wait_for_operator(WHY)
    assert demo.calls == ['remaster/clear_halt', 'remaster/collect']
    demo = HaltedDemo([None, 'f'])
    assert not demo._wait_for_operator(WHY)
    assert demo.calls == []
    said = capsys.readouterr().out
    assert 'Enter goes on' in said
    assert 'f and Enter fits what was measured' in said


def test_an_arm_that_is_elsewhere_is_cleared_twice_and_the_reason_is_said(capsys):
    demo = HaltedDemo([''], clears=2)
    assert demo._wait_for_operator(WHY)
    assert demo.calls == 2 * ['remaster/clear_halt'] + ['remaster/collect']
    assert 'the arm is reported elsewhere' in capsys.readouterr().out


def test_with_the_live_page_it_is_said_and_fitted_and_the_page_may_go_on(capsys):
    demo = HaltedDemo(None, watch=True)
    assert demo._wait_for_operator(WHY)
    assert demo.calls == ['fit']
    said = capsys.readouterr().out
    assert f'the arm is halted: {WHY}' in said
    assert 'the live page goes on' in said
    demo = HaltedDemo(None, watch=True, clears=-1)
    assert demo._wait_for_operator(WHY)
    assert 'too few poses' in capsys.readouterr().out


@pytest.mark.parametrize('watch', [False, True])
def test_an_interruption_that_asks_for_a_person_is_said_once(watch, capsys):
    demo = HaltedDemo(None, watch=watch)
    asks = 'the collection was interrupted for more than 5 s: /remaster/collect goes on'
    demo.summaries['robot_bridge'] = {'halted': '', 'asks_for_collect': asks}
    for _ in range(3):
        demo._resume_if_paused()
    said = capsys.readouterr().out
    assert said.count('the collection was interrupted') == (1 if watch else 3)
    assert demo.calls == ([] if watch else 3 * ['remaster/collect'])
