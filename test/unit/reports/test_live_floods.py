# SPDX-License-Identifier: Apache-2.0
"""The live page among connections that want nothing of it: floods, trickles, garbage, no reader.

The server is a process of its own, with a pipe as stderr that nobody reads meanwhile.
"""

import contextlib
import http.client
import json
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections import deque

import pytest

from remaster_ros.reports import live_connections
from remaster_ros.reports.live_connections import MOST, MOST_EACH, REQUEST_S

TOKEN = 'T' * 43
# More than a process may have files open by default.
FLOOD = 1130
SERVER = f"""
import sys, threading
from remaster_ros.reports.live_connections import Place
from remaster_ros.reports.live_server import LiveServer
server = LiveServer(Place(), {TOKEN!r}, b'{{}}', lambda name, done: done(True, 'done'))
server.publish({{'seen': 'a', 'confirmation': None}})
print(server.port, flush=True)
sys.stdin.read()
"""


class Process:
    """The server, and its owner with the token."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, '-c', SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.port = int(self.process.stdout.readline())
        self.opened = []

    def connect(self, content=b'', address='127.0.0.1'):
        connection = socket.create_connection(('127.0.0.1', self.port), 20, (address, 0))
        if content:
            connection.sendall(content)
        self.opened.append(connection)
        return connection

    def owner(self):
        connection = http.client.HTTPConnection('127.0.0.1', self.port, timeout=20)
        self.opened.append(connection)
        return connection

    def ask(self, connection, method='GET', path='/view', token=TOKEN):
        host = f'127.0.0.1:{self.port}'
        headers = {'Origin': f'http://{host}', 'Authorization': f'Bearer {token}'}
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read()

    def opens_the_page(self):
        """Return whether somebody with the token can open the page anew and command there."""
        connection = self.owner()
        return (
            self.ask(connection, path='/')[0],
            json.loads(self.ask(connection)[1])['view']['seen'],
            self.ask(connection, 'POST', '/command/stop')[0],
        ) == (200, 'a', 200)

    @property
    def files(self):
        return len(os.listdir(f'/proc/{self.process.pid}/fd'))

    def end(self):
        for connection in self.opened:
            with contextlib.suppress(OSError):
                connection.close()
        self.process.stdin.close()
        self.process.wait(20)
        printed = self.process.stderr.read().decode()
        self.process.stdout.close()
        self.process.stderr.close()
        return printed


@pytest.fixture
def page():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    page = Process()
    # The server has the usual limit, which a flood goes beyond.
    resource.prlimit(page.process.pid, resource.RLIMIT_NOFILE, (1024, 1024))
    yield page
    if page.process.poll() is None:
        page.end()
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    ('content', 'flood'),
    [
        (b'', FLOOD),
        (b'GET / HTTP/1.1\r\nHost: ', 3 * MOST),
        (
            b'POST /command/stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 900\r\n\r\n{',
            3 * MOST,
        ),
    ],
    ids=['nothing', 'half a header', 'half a body'],
)
def test_a_flood_of_half_open_connections_leaves_the_page_to_its_owner(page, content, flood):
    kept = page.owner()
    assert page.ask(kept)[0] == 200
    for _ in range(flood):
        page.connect(content)
    assert page.ask(kept)[0] == 200
    assert page.opens_the_page()
    assert page.files < MOST_EACH + 40
    assert page.end().count('\n') <= 1


def test_a_flood_that_goes_on_leaves_the_page_to_its_owner(page):
    kept = page.owner()
    assert page.ask(kept)[0] == 200
    ending = threading.Event()

    def flood():
        # Each stays open until many more have come.
        latest = deque(maxlen=200)
        while not ending.is_set():
            with contextlib.suppress(OSError):
                latest.append(socket.create_connection(('127.0.0.1', page.port), 5))
                latest[-1].sendall(b'GET / HTTP/1.1\r\n')
                if len(latest) == latest.maxlen:
                    latest.popleft().close()
        for connection in latest:
            connection.close()

    threads = [threading.Thread(target=flood) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        assert all(page.ask(kept)[0] == 200 for _ in range(50))
        # Of one who opens it anew a connection may be lost; a browser tries again.
        opened = 0
        for _ in range(20):
            with contextlib.suppress(OSError, http.client.HTTPException):
                opened += page.opens_the_page()
        assert opened >= 10
    finally:
        ending.set()
        for thread in threads:
            thread.join()
    assert page.end().count('\n') <= 1


def test_an_address_cannot_take_the_place_of_others(page):
    other = page.connect(b'GET / HTTP/1.1\r\n', '127.0.0.3')
    for _ in range(2 * MOST):
        page.connect(address='127.0.0.2')
    time.sleep(0.2)
    other.sendall(f'Host: 127.0.0.1:{page.port}\r\n\r\n'.encode())
    assert other.recv(100).startswith(b'HTTP/1.1 200')
    for i in range(3 * MOST):
        page.connect(address=f'127.0.1.{1 + i % 200}')
    assert page.files < MOST + 40
    assert page.opens_the_page()


def test_a_request_that_trickles_in_is_ended_and_the_owner_is_not(page):
    """A byte a while keeps a connection busy for ever; each has so long for its whole request."""
    kept = page.owner()
    assert page.ask(kept)[0] == 200
    slow = [page.connect(b'GET / HTTP/1.1\r\n') for _ in range(20)]
    # Also behind a whole request.
    after = page.owner()
    assert page.ask(after, path='/', token='')[0] == 200
    slow.append(after.sock)
    begun, open_now = time.monotonic(), list(slow)
    while open_now and time.monotonic() - begun < 10.0 * REQUEST_S:
        time.sleep(0.3)
        for connection in list(open_now):
            try:
                connection.sendall(b'x')
            except OSError:
                open_now.remove(connection)
    assert not open_now
    assert page.ask(kept)[0] == 200


def test_garbage_is_one_line_and_an_unread_pipe_stops_nothing(page):
    kept = page.owner()
    garbage = [
        b'\x16\x03\x01\x02\x00' + os.urandom(50),
        b'GET\r\n\r\n',
        b'\x00' * 100 + b'\r\n\r\n',
    ]
    garbage += [b'GET / HTTP/1.1\r\n' + b'a' * 20_000, b'GET / HTTP/1.1\r\na b: c\r\n\r\n']
    garbage += [b'POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nZZ\r\n\r\n']
    garbage += [b'POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n']
    for i in range(1500):
        with contextlib.suppress(OSError):
            page.connect(garbage[i % len(garbage)]).close()
        if i % 100 == 0:
            assert page.ask(kept)[0] == 200
    # The pipe is full, as of one who has never read it.
    assert page.opens_the_page()
    printed = page.end()
    assert len(printed.splitlines()) <= 1
    assert len(printed) < 1000


def test_a_full_pipe_is_not_waited_for(monkeypatch):
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, b'x' * 4096)
    os.set_blocking(write, True)
    with os.fdopen(write, 'w') as pipe:
        monkeypatch.setattr(sys, 'stderr', pipe)
        rarely = live_connections._RareHandler()
        rarely.note('a line')
        rarely.note('another')
        # Now somebody reads.
        os.read(read, 1 << 20)
        monkeypatch.setattr(live_connections, 'LINE_EVERY_S', 0.0)
        rarely._next_s = 0.0
        rarely.note('the next')
        assert os.read(read, 1000) == b'live page: the next (1 more since the last such line)\n'
    os.close(read)
