# SPDX-License-Identifier: Apache-2.0
"""The live page in a real browser, before a collection of events alone: no ROS, no devices."""

from __future__ import annotations

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import msgspec
import numpy as np
import pytest
from rigs.browser import Browser
from worlds.played_collection import CELL, CHAIN, PlayedCollection

from remaster_ros.planning.collection_plan import look_ahead
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.reports.live_connections import Place
from remaster_ros.reports.live_server import LiveServer
from remaster_ros.reports.live_view import PlanPage
from remaster_ros.reports.plan_page import plan_page, read_plan_page, write_plan_page
from remaster_ros.reports.robot_scene import robot_scene
from remaster_ros.reports.scene_view import scene_to_dict


class Empty(BaseHTTPRequestHandler):
    """A page without a policy of its own."""

    def do_GET(self):
        self.send_response(200)
        self.send_header('Content-Type', 'text/html')
        self.end_headers()
        self.wfile.write(b'another page')

    def log_message(self, *args):
        pass


pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]


SCENE = robot_scene(CELL, CELL.planning_scene(CHAIN))


def registration_plan(name):
    """Return the page of a small plan that waits for a confirmation."""
    counts = {'optimization': 3, 'validation': 2, 'registration': 6}
    planner = TourPlanner(CELL.planning_scene(CHAIN), counts, 0, design=CELL.design_settings())
    tours = [planner.registration(), planner.collection(planner.rough_places)]
    start = np.deg2rad([5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0])
    plan = look_ahead(planner, planner.rough_places, tours, start)
    return plan_page(plan, SCENE, 'demo', confirm=name)


class Played:
    """A collection that visits a configuration every so often, with its page."""

    def __init__(self):
        self.collection = PlayedCollection(of=24)
        content = msgspec.json.encode(scene_to_dict(SCENE))
        self._lock, self._ending = threading.Lock(), threading.Event()
        self.server = LiveServer(Place(), 'T' * 43, content, self._send)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _send(self, name, done):
        with self._lock:
            self.collection.command(name, done)

    def change(self, **values):
        with self._lock:
            vars(self.collection).update(values)

    def _run(self):
        while not self._ending.wait(0.1):
            with self._lock:
                self.collection.step()
                self.server.publish(self.collection.view.view(time.monotonic()))

    def close(self):
        self._ending.set()
        self._thread.join()
        self.server.close()


@pytest.fixture
def played():
    played = Played()
    yield played
    played.close()


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp('profile'), webgl=False)
    yield browser
    browser.close()


def opened(browser, played):
    browser.network(connected=True)
    browser.errors.clear()
    browser.open(played.server.url)
    browser.until(lambda: browser.text('#state') == 'ready', 'the page')


def begin(browser, answer='#sure-yes'):
    browser.click('#collect')
    browser.until(lambda: browser.text('#sure'), 'the question')
    browser.click(answer)


def test_from_begin_to_result(browser, played):
    opened(browser, played)
    assert browser.value('location.href').endswith('/'), 'the token left the address'
    begin(browser, '#sure-no')
    assert played.collection.commands == []
    begin(browser)
    browser.until(lambda: browser.text('#state') == 'collecting', 'the collection')
    browser.until(lambda: 'min left' in (t := browser.text('#left')) or 's left' in t, 'the time')
    browser.until(lambda: browser.text('#residuals-note').startswith('Distance'), 'residuals')
    browser.click('#pause')
    browser.until(lambda: browser.text('#state') == 'paused', 'the pause')
    done = browser.text('#count')
    browser.reload()
    browser.until(lambda: browser.text('#count') == done, 'the same after loading it again')
    assert browser.text('#state') == 'paused'
    browser.until(lambda: browser.text('#collect') == 'Go on', 'going on is offered')
    begin(browser)
    browser.until(lambda: browser.text('#state') == 'collection complete', 'the end')
    assert browser.text('#count').startswith('24 of 24 configurations')
    browser.click('#fit')
    browser.until(lambda: '0.123 mm' in browser.text('#result'), 'the result')
    assert browser.text('#offsets').count('joint_') == 7
    assert browser.text('#offsets').count('not identifiable') == 1
    assert played.collection.commands == ['collect', 'pause', 'collect', 'fit']
    # The arm stands in the picture, and nothing went wrong on the way.
    browser.until(
        lambda: browser.value('document.querySelectorAll("#scene canvas").length'), '3-D'
    )
    assert browser.text('#scene-note') == ''
    assert browser.errors == []
    origin = f'http://127.0.0.1:{played.server.port}/'
    asked = {r['url'] for r in browser.requests if not r['url'].startswith(('data:', 'about:'))}
    assert all(url.startswith(origin) for url in asked), 'nothing is fetched from elsewhere'


def test_std_stands_against_configurations_and_minutes(browser, played):
    opened(browser, played)
    looks = [
        {
            'configurations': 5 * i,
            'minutes': 1.5 * i,
            'joint_std_deg': dict.fromkeys(CHAIN.joint_names, 0.01 / i),
            'joint_rms_deg': 0.01 / i,
        }
        for i in (1, 2)
    ]
    for timed, minutes in (('true', ['1.5 min', '3.0 min']), ('false', [])):
        message = {'format': 'remaster-precision/1', 'message': timed, 'looks': looks}
        played.collection.view.take_precision(json.dumps(message))
        drawn = f'document.querySelector("#precision").layout?.xaxis2?.visible === {timed}'
        browser.until(lambda drawn=drawn: browser.value(drawn), f'with times: {timed}')
        layout = 'document.querySelector("#precision").layout.xaxis2'
        assert browser.value(f'{layout}.ticktext') == minutes
        for look in looks:
            look['minutes'] = None
    assert browser.value('document.querySelector("#precision").data[0].x') == [5, 10]
    assert browser.errors == []


def test_stop_with_the_network_cut(browser, played):
    opened(browser, played)
    begin(browser)
    browser.until(lambda: browser.text('#state') == 'collecting', 'the collection')
    browser.network(connected=False)
    browser.until(lambda: 'No connection' in browser.text('#link'), 'that the network is cut')
    assert 'red button' in browser.text('#link')
    assert browser.value('document.querySelector("#pause").disabled')
    browser.click('#stop')
    browser.until(lambda: 'stop was not done' in browser.text('#answer'), 'that it did not work')
    assert played.collection.commands == ['collect']
    browser.network(connected=True)
    browser.until(lambda: browser.text('#link') == '', 'the network')
    browser.click('#stop')
    browser.until(lambda: browser.text('#state') == 'stopped', 'the stop')
    assert played.collection.commands == ['collect', 'stop']
    assert 'No emergency stop' in browser.text('#stop-note')


def test_what_changes_while_a_person_decides_takes_the_question_back(browser, played):
    opened(browser, played)
    browser.click('#collect')
    browser.until(lambda: browser.text('#sure'), 'the question')
    played.change(halted='the emergency stop was pressed <b>twice</b>')
    browser.until(lambda: not browser.text('#sure'), 'that the question is taken back')
    assert 'look again' in browser.text('#answer')
    assert 'pressed <b>twice</b>' in browser.text('#halt'), 'text, not HTML'
    assert 'clear_halt' in browser.text('#halt')
    assert browser.value('document.querySelector("#collect").disabled')
    assert played.collection.commands == []


def test_without_the_token_the_page_is_empty(browser, played):
    opened(browser, played)
    browser.value('sessionStorage.clear()')
    browser.open(played.server.url.split('#')[0])
    browser.until(lambda: browser.text('#state') == 'no token', 'that the token is missing')
    assert browser.value('document.querySelectorAll("button:disabled").length') == 5
    browser.open(played.server.url[:-1])
    browser.until(lambda: 'by the address that' in browser.text('#link'), 'that it is wrong')
    assert browser.value('sessionStorage.clear()') is None


def test_a_plan_is_confirmed_in_this_tab_only_after_it_was_opened_here(browser, played, tmp_path):
    collection, plans = played.collection, ('ab12cd34', '00000002')
    first = registration_plan(plans[0])

    def show(name):
        """Have a plan shown, as planner and node do."""
        path = tmp_path / 's.plan.html'
        write_plan_page(path, first.replace(plans[0], name))
        address = played.server.show_plan(read_plan_page(path, name))
        collection.view.take_plan_page(PlanPage(name, address))
        collection.view.plan_offered = True
        played.change(plan=name)

    def confirm_is_off():
        return browser.value('document.querySelector("#confirm").disabled')

    show(plans[0])
    opened(browser, played)
    browser.until(lambda: f'confirmation of plan {plans[0]}' in browser.text('#plan-state'), '1')
    assert confirm_is_off()
    assert browser.value('document.querySelector("#collect").disabled')
    assert 'Look at the plan first' in browser.text('#plan-note')
    browser.look_elsewhere('#plan-link')
    browser.until(lambda: not confirm_is_off(), 'that it may be confirmed')
    # Another plan takes its place: what was opened does not count for it.
    show(plans[1])
    browser.until(lambda: f'of plan {plans[1]}' in browser.text('#plan-state'), 'the other plan')
    assert confirm_is_off()
    browser.click('#confirm')
    browser.look_elsewhere('#plan-link')
    browser.until(lambda: not confirm_is_off(), 'that it may be confirmed')
    # Cut off, the button is gone.
    browser.network(connected=False)
    browser.until(lambda: 'No connection' in browser.text('#link'), 'that the network is cut')
    assert confirm_is_off()
    browser.network(connected=True)
    browser.until(lambda: browser.text('#link') == '' and not confirm_is_off(), 'the network')
    assert collection.commands == []
    browser.click('#confirm')
    browser.until(lambda: f'{plans[1]} is confirmed' in browser.text('#plan-state'), 'it')
    assert collection.commands == [f'confirm/{plans[1]}']
    assert collection.state == 'idle', 'to confirm moves nothing'
    begin(browser)
    browser.until(lambda: browser.text('#state') == 'collecting', 'the collection')
    assert browser.errors == []


def test_the_page_of_a_plan_plays_and_reaches_nothing(browser, played):
    """It is shown as a stranger's page: whatever stands in it has neither token nor commands."""
    opened(browser, played)
    address = played.server.show_plan(registration_plan('ab12cd34').encode())
    origin = f'http://127.0.0.1:{played.server.port}'
    browser.open(f'{origin}/{address}')
    browser.until(lambda: browser.value('!!document.querySelector("#scene canvas")'), 'the arm')
    browser.click('#after')
    browser.until(lambda: '2' in browser.text('#state'), 'the second configuration')
    assert browser.errors == []
    assert browser.value('window.origin') == 'null'
    for reach in (
        'sessionStorage.getItem("token")',
        'document.cookie',
        f'await fetch("{origin}/view")',
        f'await fetch("{origin}/command/stop", {{method: "POST"}})',
    ):
        tried = f'(async () => {{ try {{ return [{reach}] }} catch (e) {{ return "kept" }} }})()'
        assert browser.value(tried) == 'kept', reach
    assert played.collection.commands == []


@pytest.mark.qualify
def test_a_page_of_another_origin_gets_nowhere(browser, played):
    """Another server on this computer, whose page a person has open beside this one."""
    url, other = f'http://127.0.0.1:{played.server.port}', HTTPServer(('127.0.0.1', 0), Empty)
    threading.Thread(target=other.serve_forever).start()
    try:
        browser.open(f'http://127.0.0.1:{other.server_port}/')
        browser.until(lambda: browser.text('body') == 'another page', 'the other page')
        for path in ('command/stop', 'command/collect', 'view'):
            ask = f'{{method: "{"GET" if path == "view" else "POST"}", mode: "MODE"}}'
            for mode, found in (('cors', 'refused'), ('no-cors', 'opaque 0')):
                outcome = browser.value(
                    f'fetch("{url}/{path}", {ask.replace("MODE", mode)})'
                    '.then((r) => `${r.type} ${r.status}`, () => "refused")'
                )
                # A token is guessed, too: the browser asks first, and is not answered.
                guessed = browser.value(
                    f'fetch("{url}/{path}", {{headers: {{Authorization: "Bearer {"T" * 43}"}}}})'
                    '.then(() => "answered", () => "refused")'
                )
                # The header that forbids other pages to load this one makes `opaque` an error.
                assert outcome in (found, 'refused')
                assert guessed == 'refused'
    finally:
        other.shutdown()
        other.server_close()
    assert played.collection.commands == []
