# SPDX-License-Identifier: Apache-2.0
"""`remaster watch` before real nodes on fake devices, in a real browser: plan to result.

Everything that moves the arm is asked for on the page, in the words and with the buttons that a
person has there. On a busy machine the fake arm, which runs faster than the clock, comes late, and
is halted as it has to be: then the person here clears the halt beside the arm and goes on.
"""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest
from rigs.browser import Browser
from rigs.collection_rig import Cell
from rigs.ros_rig import ROOT, clear_halt, node_arguments
from worlds.simple_cells import write_cell

from remaster_ros.demo.processes import free_ports

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.qualify,
    pytest.mark.timeout(900),
]

MOST_HALTS = 25
COLLECTING = ('collecting', 'registering the sensors')


@pytest.fixture
def browser(tmp_path):
    browser = Browser(tmp_path / 'profile')
    yield browser
    browser.close()


def watched(start, port, fit, cell):
    """Start the page; return its process and the address with the token."""
    common = ROOT / 'config' / 'fake.yaml'
    values = {'watch:port': port, 'watch:fit': fit, 'watch:cell': cell}
    process = start('remaster_ros.nodes.watch', *node_arguments(common, **values))
    line = process.stdout.readline()
    file = Path(re.fullmatch(r'live page: open (.*)\n', line)[1])
    assert file.stat().st_mode & 0o077 == 0
    return process, re.search('http://[^"]*', file.read_text())[0]


class Person:
    """Who stands beside the arm with the page."""

    def __init__(self, cell, client, browser):
        self.cell, self.client, self.browser = cell, client, browser
        self.halts, self.confirmed = 0, []

    def until(self, condition, what):
        self.cell.until(condition, what, 300)

    def state(self):
        return self.browser.text('#state')

    def is_off(self, button):
        return self.browser.value(f'document.querySelector("#{button}").disabled')

    def keep_going(self, condition, what):
        """Wait for it, and have the arm go on wherever it was held up."""

        def turn():
            if condition():
                return True
            if self.state() not in COLLECTING:
                self.take_a_step()
            return False

        self.until(turn, what)

    def take_a_step(self):
        """Do what the page asks for next: see to a halt, look at a plan and confirm it, go on."""
        if 'clear_halt' in self.browser.text('#halt'):
            assert self.is_off('collect')
            self.halts += 1
            assert self.halts <= MOST_HALTS, self.browser.text('body')
            clear_halt(self.client)
            self.until(lambda: not self.browser.text('#halt'), 'the end of the halt')
        if 'waits for your confirmation' in self.browser.text('#plan-state'):
            self.confirm()
        elif not self.is_off('collect'):
            self.browser.click('#collect')
            self.browser.click('#sure-yes')
            self.until(lambda: self.browser.text('#answer') != 'collect: asking', 'the answer')

    def confirm(self):
        """Look at the plan that is next, and confirm it."""
        browser = self.browser
        plan = browser.text('#plan-state').rstrip('.').split()[-1]
        assert self.is_off('collect'), 'nothing is begun without a confirmation'
        self.until(lambda: browser.text('#plan-link'), 'the page of the plan')
        assert self.is_off('confirm'), 'it was not looked at yet'
        browser.look_elsewhere('#plan-link')
        self.until(lambda: not self.is_off('confirm'), 'that it may be confirmed')
        assert browser.text('#confirm') == f'Confirm plan {plan}'

        def confirmed():
            if f'{plan} is confirmed' in browser.text('#plan-state'):
                return True
            # What was seen too long ago, on a busy machine, is refused: then once more.
            if not self.is_off('confirm') and browser.text('#answer') != 'confirm: asking':
                browser.click('#confirm')
            return False

        self.until(confirmed, 'that it is')
        self.confirmed.append(plan)


def test_plan_confirm_collect_pause_reload_kill_stop_result(start, client, browser, tmp_path):
    (port,) = free_ports(socket.SOCK_STREAM)
    fit, file = tmp_path / 'fit', write_cell(tmp_path / 'cell.yaml', confirm=True)
    page, url = watched(start, port, fit, file)
    cell = Cell(
        *(start, client, tmp_path, 'mocap', ('mocap',)),
        candidates=4,
        cell=file,
        collect=False,
        rate=4.0,
    )
    values = {'session': cell.session, 'out': fit, 'figures': False}
    values = {f'optimizer:{key}': value for key, value in values.items()}
    fake = ROOT / 'config' / 'fake.yaml'
    cell.nodes['optimizer'] = start(
        'remaster_ros.nodes.optimizer', *node_arguments(fake, **values)
    )
    person = Person(cell, client, browser)
    until, keep_going, state = person.until, person.keep_going, person.state

    browser.open(url)
    until(lambda: 'waits for your confirmation' in browser.text('#plan-state'), 'the plan')
    assert cell.said['robot_bridge']['commanded'] == '0'
    keep_going(lambda: state() in COLLECTING, 'the registration')
    assert len(person.confirmed) == 1
    keep_going(lambda: browser.text('#residuals-note').startswith('Distance'), 'residuals')
    keep_going(lambda: ' left' in browser.text('#left'), 'the time that is left')
    # Of the collection, which follows from the registration, it was asked again.
    assert len(set(person.confirmed)) > 1

    keep_going(lambda: state() in COLLECTING, 'that it goes on')
    browser.click('#pause')
    until(lambda: state() == 'paused', 'the pause')
    # The page knows it by a record, and what the nodes show to people comes on its own.
    until(lambda: cell.said['pose_planner']['state'] == 'paused', 'the planner')
    cell.told_to_stand()
    commanded = cell.said['robot_bridge']['commanded']
    browser.reload()
    until(lambda: state() == 'paused', 'the page after loading it again')

    # Killed and started again it has another token.
    page.kill()
    page.wait()
    until(lambda: 'No connection' in browser.text('#link'), 'that the server is gone')
    page, again = watched(start, port, fit, file)
    assert again != url
    until(lambda: 'by the address' in browser.text('#link'), 'that the old token is refused')
    browser.open(again)
    until(lambda: browser.text('#link') == '' and state() == 'paused', 'the page is back')
    assert cell.said['robot_bridge']['commanded'] == commanded, 'nothing has moved meanwhile'

    until(lambda: browser.text('#collect') == 'Go on', 'the word')
    keep_going(lambda: state() in COLLECTING, 'that it goes on')
    browser.network(connected=False)
    until(lambda: 'No connection' in browser.text('#link'), 'that the network is cut')
    browser.click('#stop')
    until(lambda: 'stop was not done' in browser.text('#answer'), 'that it did not work')
    assert 'red button' in browser.text('#answer')
    assert cell.said['pose_planner']['state'] != 'stopped'
    browser.network(connected=True)
    until(lambda: browser.text('#link') == '', 'the network')
    browser.click('#stop')
    until(lambda: state() == 'stopped', 'the stop')
    until(lambda: cell.said['pose_planner']['state'] == 'stopped', 'the planner')
    until(lambda: cell.recorder('exit_status') == 'stopped', 'the session is closed')
    keep_going(lambda: cell.recorder('exit_status') == 'complete', 'the end')
    until(lambda: browser.value('document.querySelector("#precision").data?.length'), 'looks')
    until(lambda: state() == 'collection complete', 'the end on the page')
    browser.click('#fit')
    until(lambda: str(fit) in browser.text('#result'), 'the result')
    assert browser.text('#offsets').count('joint_') == 7
    assert browser.errors == []
    assert page.poll() is None
    print('halts', person.halts)
