# SPDX-License-Identifier: Apache-2.0
"""The web server of the live page, read as somebody who is not meant to use it would."""

import gzip
import http.client
import json
import socket
import ssl
import subprocess
import time

import pytest

from remaster_ros.errors import InputError
from remaster_ros.reports import live_server
from remaster_ros.reports.live_connections import Place
from remaster_ros.reports.live_server import COMMANDS, SEEN_FIRST, LiveServer

TOKEN = 'T' * 43


HERE = Place()


class Page:
    """A server, and requests as a browser or an attacker makes them."""

    def __init__(self, place=HERE):
        self.sent = []
        self.answer = (True, 'done')
        self.server = LiveServer(place, TOKEN, b'{"surfaces":[]}', self.send)
        self.host = f'127.0.0.1:{self.server.port}'
        self.show('a')

    def send(self, name, done):
        self.sent.append(name)
        if self.answer is not None:
            done(*self.answer)

    def show(self, seen, plan='ab12cd34'):
        confirmation = {'plan': plan} if plan else None
        view = {'seen': seen, 'text': '<script>', 'none': float('nan')}
        self.server.publish({**view, 'confirmation': confirmation})

    def ask(self, method, path, body=None, *, token=TOKEN, **headers):
        """Return status, headers and content; a header that is None is left out."""
        given = {'Host': self.host, 'Origin': f'http://{self.host}' if method == 'POST' else None}
        given['Authorization'] = None if token is None else f'Bearer {token}'
        given |= {name.replace('_', '-'): value for name, value in headers.items()}
        connection = http.client.HTTPConnection('127.0.0.1', self.server.port, timeout=20)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in given.items():
                for item in value if isinstance(value, list) else [value]:
                    if item is not None:
                        connection.putheader(name, item)
            content = b'' if body is None else body
            if method == 'POST':
                connection.putheader('Content-Length', str(len(content)))
            connection.endheaders(content)
            response = connection.getresponse()
            return response.status, response.headers, response.read()
        finally:
            connection.close()

    def view(self):
        return json.loads(self.ask('GET', '/view')[2])

    def decide(self, name, shown=None, **changes):
        """Ask for what a person must have seen something of: of the view now, or of this one."""
        shown = shown or self.view()
        body = {'view': shown['number'], 'seen': shown['view']['seen'], **changes}
        status, _, content = self.ask('POST', f'/command/{name}', json.dumps(body).encode())
        return status, content

    def filled(self, texts):
        """Fill the port into a text or into several."""
        if isinstance(texts, list):
            return [self.filled(text) for text in texts]
        return texts and texts.format(port=self.server.port)


@pytest.fixture
def page():
    page = Page()
    yield page
    page.server.close()


def test_the_page_and_its_files_are_served_without_secrets(page):
    for name in ('', 'page.js', 'scene.js', 'page.css', 'plotly.js'):
        status, headers, content = page.ask('GET', f'/{name}', token=None)
        assert status == 200, name
        assert content[:2] == b'\x1f\x8b'
        assert TOKEN.encode() not in content
        assert "frame-ancestors 'none'" in headers['Content-Security-Policy']
        assert "script-src 'self'" in headers['Content-Security-Policy']
        assert 'unsafe-eval' not in headers['Content-Security-Policy']
        assert headers['X-Content-Type-Options'] == 'nosniff'
        assert headers['Set-Cookie'] is None
        assert headers['Server'] is None
        assert headers['Access-Control-Allow-Origin'] is None


def test_view_and_commands_with_the_token(page):
    shown = page.view()
    plan = {'plan': 'ab12cd34'}
    assert shown['view'] == {'seen': 'a', 'text': '<script>', 'none': None, 'confirmation': plan}
    assert shown['age_s'] < 5.0
    for name in ('pause', 'stop', 'fit'):
        status, _, content = page.ask('POST', f'/command/{name}')
        assert (status, json.loads(content)) == (200, {'done': True, 'message': 'done'})
    assert page.decide('collect')[0] == 200
    page.show('a')
    assert page.decide('confirm')[0] == 200
    assert page.sent == ['pause', 'stop', 'fit', 'collect', 'confirm/ab12cd34']


@pytest.mark.parametrize('path', ['/view', '/scene', *(f'/command/{name}' for name in COMMANDS)])
@pytest.mark.parametrize(
    'headers',
    [
        {'token': None},
        {'token': ''},
        {'token': TOKEN[:-1]},
        {'token': f'{TOKEN}T'},
        {'token': 'é' * 43},
        {'token': None, 'Authorization': TOKEN},
        {'token': None, 'Cookie': f'token={TOKEN}'},
        {'Authorization': [f'Bearer {TOKEN}', 'Bearer other']},
    ],
)
def test_without_the_token_there_is_nothing(page, path, headers):
    method = 'POST' if 'command' in path else 'GET'
    status, _, content = page.ask(method, path, **headers)
    assert status == 401
    assert b'seen' not in content
    assert page.sent == []


def test_a_token_in_the_address_does_not_count(page):
    assert page.ask('GET', f'/view?token={TOKEN}', token=None)[0] == 401


@pytest.mark.parametrize(
    'host',
    [
        'evil.example',
        '127.0.0.1',
        'localhost:1',
        'evil.example:{port}',
        '127.0.0.1:{port}.evil.example',
        '',
        None,
        ['127.0.0.1:{port}', 'evil.example'],
    ],
)
def test_another_name_of_this_address_is_refused(page, host):
    """A page whose name is made to resolve to this address (DNS rebinding) has its own Host."""
    for method, path in (('GET', '/'), ('GET', '/view'), ('POST', '/command/stop')):
        assert page.ask(method, path, Host=page.filled(host))[0] in (400, 421)
    assert page.sent == []


@pytest.mark.parametrize(
    'origin',
    [
        None,
        'null',
        '',
        'http://evil.example',
        'https://127.0.0.1:{port}',
        'http://127.0.0.1',
        'http://127.0.0.1:1',
        'http://localhost:{port}',
        ['http://127.0.0.1:{port}', 'http://127.0.0.1:{port}'],
    ],
)
@pytest.mark.parametrize('name', COMMANDS)
def test_commands_of_other_pages_are_refused(page, name, origin):
    value = page.filled(origin)
    assert page.ask('POST', f'/command/{name}', Origin=value)[0] == 403
    if origin is not None:
        assert page.ask('GET', '/view', Origin=value)[0] == 403
    assert page.sent == []


def test_no_preflight_is_answered_and_no_other_method(page):
    for method in ('OPTIONS', 'PUT', 'DELETE', 'PATCH', 'TRACE'):
        for path in ('/', '/view', '/command/stop'):
            status, headers, _ = page.ask(method, path, Origin=f'http://{page.host}')
            assert status in (404, 405)
            assert headers['Access-Control-Allow-Origin'] is None
    assert page.ask('GET', '/command/stop')[0] == 405
    assert page.sent == []


@pytest.mark.parametrize(
    'name', ['clear_halt', 'register', 'discover', 'COLLECT', 'stop/../collect', 'stop%00']
)
def test_there_are_five_commands_and_no_other(page, name):
    assert page.ask('POST', f'/command/{name}')[0] in (400, 404, 405)
    assert page.sent == []


@pytest.mark.parametrize(
    'path',
    ['/../live_server.py', '/%2e%2e/live_server.py', '/etc/passwd', '//etc/passwd', '/index.html'],
)
def test_no_other_file_is_served(page, path):
    assert page.ask('GET', path)[0] == 404


@pytest.mark.parametrize('name', SEEN_FIRST)
@pytest.mark.parametrize(
    'body',
    [
        b'',
        b'{}',
        b'[]',
        b'{"view":1}',
        b'{"view":"1","seen":"a"}',
        b'{"view":1,"seen":"a","more":1}',
        b'{"view":1e99,"seen":"a"}',
        b'\xff',
        b'[' * 900,
    ],
)
def test_what_needs_a_look_is_refused_without_one(page, name, body):
    assert page.ask('POST', f'/command/{name}', body)[0] == 400
    assert page.sent == []


@pytest.mark.parametrize('name', SEEN_FIRST)
def test_what_was_seen_of_another_state_or_in_an_old_view_is_refused(page, name, monkeypatch):
    assert page.decide(name, view=10_000)[0] == 409
    assert page.decide(name, seen='é')[0] == 409
    shown = page.view()
    page.show('b')
    status, content = page.decide(name, shown)
    assert status == 409
    assert b'changed meanwhile' in content
    # What was held up on its way: the view that it names was shown too long ago.
    monkeypatch.setattr(live_server, 'FRESH_S', 0.05)
    old = page.view()
    time.sleep(0.1)
    status, content = page.decide(name, old)
    assert status == 409
    assert b'not up to date' in content
    assert page.sent == []


@pytest.mark.parametrize('name', SEEN_FIRST)
def test_what_comes_twice_counts_once(page, name):
    shown = page.view()
    assert [page.decide(name, shown)[0] for _ in range(2)] == [200, 409]
    assert len(page.sent) == 1


def test_a_plan_is_confirmed_only_while_the_view_has_it(page):
    shown = page.view()
    page.show('b', plan='')
    status, content = page.decide('confirm', shown)
    assert status == 409
    assert b'no plan waits' in content
    page.show('c', plan='00000001')
    assert page.decide('confirm', shown)[0] == 409
    assert page.decide('confirm')[0] == 200
    assert page.sent == ['confirm/00000001']


def test_the_page_of_a_plan_has_a_secret_address_and_is_kept_away_from_the_live_page(page):
    assert page.ask('GET', '/plan/', token=None)[0] == 404
    assert page.ask('GET', '/plan/x', token=None)[0] == 404
    first, second = (page.server.show_plan(f'<p>{i}'.encode()) for i in range(2))
    assert len(first) > 40
    # It opens in a tab of its own, whose request has no header of ours.
    status, headers, content = page.ask('GET', f'/{second}', token=None)
    assert (status, gzip.decompress(content)) == (200, b'<p>1')
    policy = headers['Content-Security-Policy']
    assert policy.startswith('sandbox allow-scripts;')
    assert 'allow-same-origin' not in policy
    assert 'connect-src' not in policy.replace("default-src 'none'", '')
    # Browsers show nothing of a page that has both.
    assert headers['Cross-Origin-Opener-Policy'] is None
    assert page.ask('GET', f'/{first}', token=None)[0] == 404
    assert page.ask('GET', f'/{second}', token=None, Host='evil.example')[0] == 421
    assert page.ask('GET', f'/{second}', Origin='http://evil.example')[0] == 403


def test_a_large_body_is_refused(page):
    with pytest.raises((ConnectionError, http.client.HTTPException, AssertionError)):
        assert page.ask('POST', '/command/collect', b'x' * 100_000)[0] == 200
    assert page.sent == []
    assert page.view()['view']['seen'] == 'a'


def test_garbage_and_idle_connections_do_not_stop_it(page):
    idle = [socket.create_connection(('127.0.0.1', page.server.port)) for _ in range(50)]
    for text in (b'\x00\xff\r\n\r\n', b'GET / HTTP/9\r\n\r\n', b'POST /command/stop HTTP/1.1\r\n'):
        with socket.create_connection(('127.0.0.1', page.server.port)) as connection:
            connection.sendall(text)
    assert page.view()['view']['seen'] == 'a'
    for connection in idle:
        connection.close()
    assert page.sent == []


def test_what_a_service_refuses_is_told(page):
    page.answer = (False, 'the arm is halted: <b>silence</b>\r\nSet-Cookie: a=b')
    status, headers, content = page.ask('POST', '/command/pause')
    assert status == 200
    assert headers['Set-Cookie'] is None
    assert json.loads(content) == {'done': False, 'message': page.answer[1]}


def test_a_service_that_does_not_answer_is_told(page, monkeypatch):
    monkeypatch.setattr(live_server, 'ANSWER_S', 0.05)
    page.answer = None
    status, _, content = page.ask('POST', '/command/stop')
    assert status == 504
    assert b'no answer to stop' in content
    # A fit takes its time.
    assert json.loads(page.ask('POST', '/command/fit')[2])['done']


def test_a_view_tells_its_age(page):
    time.sleep(0.3)
    assert 0.3 <= page.view()['age_s'] < 5.0
    assert page.server.watched


def test_it_listens_on_this_computer_alone(page):
    assert page.server._socket.getsockname()[0] == '127.0.0.1'
    assert page.server.url == f'http://{page.host}/#token={TOKEN}'


@pytest.mark.parametrize(
    ('place', 'words'),
    [
        (Place('0.0.0.0'), 'give certificate and key'),
        (Place('192.168.1.5'), 'ssh -L'),
        (Place('::'), 'give certificate and key'),
        (Place('localhost'), 'no IP address'),
        (Place('127.0.0.1', certificate='/nowhere.pem'), '/nowhere.pem'),
    ],
)
def test_what_cannot_be_served_is_refused_in_one_line(place, words):
    with pytest.raises(InputError, match=words) as found:
        LiveServer(place, TOKEN, b'', lambda name, done: None)
    assert '\n' not in str(found.value)


def test_a_port_in_use_is_named(page):
    with pytest.raises(InputError, match=f'port {page.server.port}: Address already in use'):
        Page(Place(port=page.server.port))


def test_https_for_other_computers(tmp_path):
    command = ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256']
    command += ['-nodes', '-subj', '/CN=cell', '-addext', 'subjectAltName=DNS:cell', '-days', '1']
    try:
        subprocess.run(
            [*command, '-keyout', 'key.pem', '-out', 'cert.pem'],
            cwd=tmp_path,
            check=True,
            capture_output=True,
        )
    except FileNotFoundError:
        pytest.skip('needs openssl')
    files = str(tmp_path / 'cert.pem'), str(tmp_path / 'key.pem')
    server = LiveServer(Place('0.0.0.0', 0, ('cell',), *files), TOKEN, b'{}', lambda n, d: None)
    try:
        assert server.url.startswith(f'https://cell:{server.port}/#')
        context = ssl.create_default_context(cafile=files[0])
        raw = socket.create_connection(('127.0.0.1', server.port))
        with context.wrap_socket(raw, server_hostname='cell') as connection:
            request = f'GET / HTTP/1.1\r\nHost: cell:{server.port}\r\nConnection: close\r\n\r\n'
            connection.sendall(request.encode())
            assert connection.recv(100).startswith(b'HTTP/1.1 200')
    finally:
        server.close()
