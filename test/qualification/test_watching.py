"""`remaster watch` before real nodes on fake devices, in a real browser: collect to result."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest
from browser import Browser
from collection_rig import Cell
from ros_rig import ROOT, call, node_arguments

from remaster_ros.nodes.demo import free_ports

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.qualify,
    pytest.mark.timeout(600),
]


@pytest.fixture
def browser(tmp_path):
    browser = Browser(tmp_path / 'profile')
    yield browser
    browser.close()


def watched(start, port, fit):
    """Start the page; return its process and the address with the token."""
    common = ROOT / 'config' / 'fake.yaml'
    own = {'watch:port': port, 'watch:fit': fit}
    process = start('remaster_ros.nodes.watch', *node_arguments(common, **own))
    line = process.stdout.readline()
    file = Path(re.fullmatch(r'live page: open (.*)\n', line)[1])
    assert file.stat().st_mode & 0o077 == 0
    return process, re.search('http://[^"]*', file.read_text())[0]


def test_collect_pause_reload_kill_stop_result(start, client, browser, tmp_path):
    (port,) = free_ports(socket.SOCK_STREAM)
    fit = tmp_path / 'fit'
    page, url = watched(start, port, fit)
    # Slower than the other tests: a browser takes processors, and an arm that lags is halted.
    cell = Cell(start, client, tmp_path, 'mocap', ('mocap',), candidates=4, rate=4.0)
    cell.nodes['optimizer'] = start(
        'remaster_ros.nodes.optimizer',
        *node_arguments(
            ROOT / 'config' / 'fake.yaml',
            **{
                'optimizer:session': cell.session,
                'optimizer:out': fit,
                'optimizer:figures': False,
            },
        ),
    )

    def until(condition, what):
        cell.until(condition, what)

    def state():
        return browser.text('#state')

    browser.open(url)
    until(lambda: state() == 'collecting', 'the collection')
    until(lambda: browser.text('#residuals-note').startswith('Distance'), 'residuals')
    until(lambda: ' left' in browser.text('#left'), 'the time that is left')

    browser.click('#pause')
    until(lambda: state() == 'paused', 'the pause')
    assert cell.said['pose_planner']['state'] == 'paused'
    commanded = cell.said['robot_bridge']['commanded']
    browser.reload()
    until(lambda: state() == 'paused', 'the page after loading it again')

    # Killed and started again it has another token.
    page.kill()
    page.wait()
    until(lambda: 'No connection' in browser.text('#link'), 'that the server is gone')
    page, again = watched(start, port, fit)
    assert again != url
    until(lambda: 'by the address' in browser.text('#link'), 'that the old token is refused')
    browser.open(again)
    until(lambda: browser.text('#link') == '' and state() == 'paused', 'the page is back')
    assert cell.said['robot_bridge']['commanded'] == commanded, 'nothing has moved meanwhile'

    def go_on():
        until(lambda: browser.text('#collect') == 'Go on', 'the word')

        def offered():
            # The fake arm, ten times as fast, stops elsewhere on a busy machine.
            is_off = browser.value('document.querySelector("#collect").disabled')
            if cell.said['robot_bridge']['halted'] and 'clear_halt' in browser.text('#halt'):
                assert is_off
                assert call(client, '/remaster/clear_halt').success
            return not is_off

        until(offered, 'the offer')
        browser.click('#collect')
        until(lambda: browser.text('#sure'), 'the question')
        browser.click('#sure-yes')
        until(lambda: state() == 'collecting', 'that it goes on')

    go_on()
    browser.network(connected=False)
    until(lambda: 'No connection' in browser.text('#link'), 'that the network is cut')
    browser.network(connected=True)
    until(lambda: browser.text('#link') == '' and state() == 'collecting', 'the network')
    browser.click('#stop')
    until(lambda: state() == 'stopped', 'the stop')
    assert cell.said['pose_planner']['state'] == 'stopped'
    until(lambda: cell.recorder('exit_status') == 'stopped', 'the session is closed')
    go_on()
    cell.complete()
    until(lambda: browser.value('document.querySelector("#precision").data?.length'), 'looks')
    until(lambda: state() == 'collection complete', 'the end')
    browser.click('#fit')
    until(lambda: str(fit) in browser.text('#result'), 'the result')
    assert browser.text('#offsets').count('joint_') == 7
    assert browser.errors == []
    assert page.poll() is None
