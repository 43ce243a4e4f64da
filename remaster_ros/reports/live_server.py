# SPDX-License-Identifier: Apache-2.0
"""Web server of the live page: fixed files, the view as JSON, and five commands.

A command lets an arm move, so each request is checked as if it came from an attacker:

- Host has to be a name of this server (a foreign page whose own name resolves to this address is
refused), and Origin, which each command needs, this server's own.
- View, scene and commands need the token in the header Authorization. No cookie is set: browsers
would send it with requests of other pages, and to servers on other ports of this address. The
token is behind the # of the page's address, which browsers never send.
- ``collect`` and ``confirm`` also name the view that the person has seen. A delayed request, or
one that belongs to another state of the collection or another plan, is refused.
- The page of a plan, which a browser opens without a header, has an address that only the view
contains, and is shown as a foreign one: it reaches neither this server nor the token (sandbox).
- Nothing is written, no path comes from a request, bodies are small, no other page may frame this
one, and only scripts of this package run here.
- Connections are few, and those that have not shown the token live for one request. Errors are
reported once a minute, and not at all if nobody reads them.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import hmac
import importlib.resources
import ipaddress
import json
import logging
import os
import re
import secrets
import select
import socket
import ssl
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import msgspec
from tornado.http1connection import HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import PeriodicCallback
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler

from remaster_ros.errors import InputError
from remaster_ros.reports.robot_scene import view_script

# Connections to the live page: few, and short until they have shown the token.
#
# Anybody who reaches the port can open connections; on the computer of the page each user can,
# and from its own address, too. So no address is refused. If there are too many connections, the
# oldest one without the token is closed, of the address that has the most: the page of the owner,
# which has shown the token, is kept, and a browser that opens the page needs milliseconds.


MOST = 128
"""Largest number of connections: a browser opens six to a page, so this is for twenty browsers."""
MOST_EACH = 64
"""Largest number of connections of one address, so that none can take the place of all others."""
REQUEST_S = 5.0
"""From the begin of a connection, or its last answer, to the end of a request, s."""
ANSWER_TAKEN_S = 60.0
"""Longest time to send an answer, s: the page has 1.5 MB, which takes a minute at 0.2 Mbit/s."""
IDLE_S = 30.0
"""Longest time without a request of a page that has shown the token, s."""
LINE_EVERY_S = 60.0
LONGEST_LINE = 400
"""Characters of a line that a pipe accepts as a whole (PIPE_BUF is 4096 bytes)."""


@dataclass
class _OpenConnection:
    """An open connection: its address, since when it owes a request.

    Last result: whether it has the token.
    """

    address: str
    since_s: float = field(default_factory=time.monotonic)
    has_token: bool = False


class BoundedServer(HTTPServer):
    """Web server with a bounded number of connections; parameters as of `HTTPServer`."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        """Set up as in tornado, and begin to close late connections."""
        super().initialize(*args, **kwargs)
        self._open: dict[IOStream, _OpenConnection] = {}
        PeriodicCallback(self._close_late, 500.0).start()

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Accept a connection, and close the oldest one if there are too many.

        Too many: 64 of its own address (`MOST_EACH`), or 128 of all (`MOST`), then of the address
        with the most. Those without the token are closed first.
        """
        connection = self._open[stream] = _OpenConnection(_network(str(address[0])))
        counts = Counter(other.address for other in self._open.values())
        if counts[connection.address] > MOST_EACH:
            self._close_oldest(connection.address)
        elif len(self._open) > MOST:
            self._close_oldest(max(counts, key=counts.__getitem__))
        if not stream.closed():
            super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        """Forget a connection that has ended."""
        assert isinstance(server_conn, HTTP1ServerConnection)
        super().on_close(server_conn)
        self._open.pop(server_conn.stream, None)

    def trust(self, request: HTTPServerRequest) -> None:
        """Mark the connection of a request, if open, as one that has shown the token."""
        if (connection := self._open.get(_stream(request))) is not None:
            connection.has_token = True

    def note_answer(self, request: HTTPServerRequest) -> None:
        """Note that a request is answered, so that the time for the next one begins."""
        if (connection := self._open.get(_stream(request))) is not None:
            connection.since_s = time.monotonic()

    def _close_oldest(self, address: str) -> None:
        """Close the oldest connection of an address, those without the token first.

        The address has to have one. Age is the time since its last answer or its begin.
        """
        of_it = [
            (connection.has_token, connection.since_s, id(stream))
            for stream, connection in self._of(address)
        ]
        worst = min(of_it)[2]
        self._close(next(stream for stream, _ in self._of(address) if id(stream) == worst))

    def _of(self, address: str) -> list[tuple[IOStream, _OpenConnection]]:
        """Open connections of an address, with their streams."""
        return [item for item in self._open.items() if item[1].address == address]

    def _close_late(self) -> None:
        """Close connections whose request does not come, or whose answer is not read.

        After 5 s without the token, 30 s with it, 60 s while an answer is sent.
        """
        now = time.monotonic()
        for stream, connection in list(self._open.items()):
            allowed = IDLE_S if connection.has_token else REQUEST_S
            if now - connection.since_s > (ANSWER_TAKEN_S if stream.writing() else allowed):
                self._close(stream)

    def _close(self, stream: IOStream) -> None:
        """Close a connection and forget it."""
        self._open.pop(stream, None)
        stream.close()


def _stream(request: HTTPServerRequest) -> IOStream:
    """Stream of a request's connection."""
    stream: IOStream = request.connection.stream  # type: ignore[union-attr]
    return stream


def _network(address: str) -> str:
    """Key of one user's addresses: an IPv4 address, or the /64 network of an IPv6 one.

    Text that is no address is unchanged.
    """
    with contextlib.suppress(ValueError):
        if isinstance(
            parsed := ipaddress.ip_address(address.partition('%')[0]), ipaddress.IPv6Address
        ):
            return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
    return address


class _RareHandler(logging.Handler):
    """Handler that writes a line a minute to stderr, and counts the others; it never blocks."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._next_s, self._left_out = float('-inf'), 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the text of a record in one line, or count it; see `note`."""
        self.note(' '.join(record.getMessage().split()))

    def note(self, text: str) -> None:
        """Write a line to stderr, or count it if one was written within the last minute.

        A line that cannot be written at once is dropped.
        """
        now = time.monotonic()
        if now < self._next_s:
            self._left_out += 1
            return
        more = f' ({self._left_out} more since the last such line)' if self._left_out else ''
        self._next_s, self._left_out = now + LINE_EVERY_S, 0
        line = f'live page: {text[:LONGEST_LINE]}{more}\n'.encode(errors='replace')
        # Another program may have closed this one's stderr.
        with contextlib.suppress(OSError, ValueError):
            descriptor = sys.stderr.fileno()
            if select.select([], [descriptor], [], 0.0)[1]:
                os.write(descriptor, line)


def log_rarely(loop: asyncio.AbstractEventLoop) -> None:
    """Report errors of tornado and of an event loop in one line a minute on stderr."""
    handler = _RareHandler()
    logger = logging.getLogger('tornado')
    logger.handlers, logger.propagate = [handler], False

    def report(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get('exception')
        what = f'{type(error).__name__}: {error}' if error else context['message']
        handler.note(' '.join(what.split()))

    loop.set_exception_handler(report)


@dataclass(frozen=True)
class Place:
    """Address and port at which the page is served."""

    # IP address to listen on, and port; 0 for any free port
    address: str = '127.0.0.1'
    port: int = 0
    # Further names of this computer that a browser may use
    names: tuple[str, ...] = ()
    # PEM files for https, required for an address that other computers reach; '' for http
    certificate: str = ''
    key: str = ''


def listen(place: Place) -> socket.socket:
    """Non-blocking socket that listens at a place.

    Raises InputError if the address is no IP address, is not a loopback address without a
    certificate, or cannot be used.
    """
    try:
        address = ipaddress.ip_address(place.address)
    except ValueError:
        raise InputError(
            f'live page: address {place.address!r} is no IP address, such as 127.0.0.1'
        ) from None
    if not address.is_loopback and not place.certificate:
        raise InputError(
            f'live page: {place.address} can be reached from other computers, and without https '
            'the token could be read on the way: give certificate and key, or leave the address '
            'and use ssh -L PORT:127.0.0.1:PORT from there'
        )
    try:
        family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
        found = socket.create_server((place.address, place.port), family=family)
    except OSError as error:
        raise InputError(
            f'live page: {place.address} port {place.port}: {os.strerror(error.errno or 0)}; give '
            'another port'
        ) from None
    found.setblocking(False)
    return found


def tls(place: Place) -> ssl.SSLContext | None:
    """TLS context of the certificate; None for http. Raises InputError if it cannot be read."""
    if not place.certificate:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(place.certificate, place.key or None)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f'live page: certificate {place.certificate}: {error}') from None
    return context


def hosts(place: Place, port: int) -> tuple[str, ...]:
    """Allowed values of the header Host, 'name:port'; the first is in the page's address.

    ``port``: that of the socket.
    """
    address = ipaddress.ip_address(place.address)
    shown = f'[{address}]' if address.version == 6 else str(address)
    names = [*place.names]
    if not address.is_unspecified:
        names.append(shown)
    if address.is_loopback or address.is_unspecified:
        names += ['localhost', '127.0.0.1']
    return tuple(f'{name.lower()}:{port}' for name in dict.fromkeys(names))


CONFIRM = 'confirm'
COMMANDS = ('collect', 'pause', 'stop', 'fit', CONFIRM)
SEEN_FIRST = ('collect', CONFIRM)
"""Commands that are accepted only from a person who has seen the current view."""
FRESH_S = 3.0
"""Largest age of a view that counts as current, s."""
ANSWER_S = 5.0
"""Longest wait for the outcome of a command, s."""
WATCHED_S = 5.0
LARGEST_BODY = 1024
Done = Callable[[bool, str], None]
Send = Callable[[str, Done], None]

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_PLAN_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = {
    'Content-Security-Policy': _POLICY,
    'X-Frame-Options': 'DENY',
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Cross-Origin-Opener-Policy': 'same-origin',
    'Cache-Control': 'no-store',
}


class SeenView(msgspec.Struct, forbid_unknown_fields=True):
    """View that a person has seen who lets the arm move or confirms: its number and mark."""

    view: int
    seen: str


class LiveServer:
    """Server of the page, in a thread of its own.

    ``token`` is required for view and commands, ``scene`` is the fixed part of the 3-D view, JSON.
    ``send`` is called in the server's thread with the name of a command (``confirm/NAME`` for the
    plan of that name) and with a callback for its outcome, which any thread may call: success, and
    a line for the person. Raises InputError if address or certificate cannot be used.
    """

    def __init__(self, place: Place, token: str, scene: bytes, send: Send) -> None:
        self.token, self.scene, self.send = token, gzip.compress(scene), send
        self._tls = tls(place)
        self._socket = listen(place)
        self.port = self._socket.getsockname()[1]
        self.scheme = 'http' if self._tls is None else 'https'
        self.hosts = hosts(place, self.port)
        self.files = _files()
        self._seen, self._view, self._plan = '', b'null', ''
        self._plan_page = '', b''
        self._issued: deque[tuple[int, float]] = deque([(0, float('-inf'))], maxlen=100)
        self._asked_s, self._used = float('-inf'), 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return f'{self.scheme}://{self.hosts[0]}/#token={self.token}'

    @property
    def watched(self) -> bool:
        """Whether anybody has requested the view within the last 5 s (`WATCHED_S`)."""
        return time.monotonic() - self._asked_s < WATCHED_S

    def publish(self, view: dict[str, Any]) -> None:
        """Show a view from now on; any thread may call this.

        Its ``seen`` is the mark that `collect` and `confirm` have to name; its ``confirmation``
        has the plan that they confirm, or is None.
        """
        content = msgspec.json.encode(view)  # NaN becomes null, which browsers read.
        plan = view['confirmation']['plan'] if view['confirmation'] else ''
        self._loop.call_soon_threadsafe(self._show, content, str(view['seen']), plan)

    def _show(self, content: bytes, seen: str, plan: str) -> None:
        """Replace view and plan, note number and time of the view; runs in the server's thread."""
        self._issued.append((self._issued[-1][0] + 1, time.monotonic()))
        self._view, self._seen, self._plan = content, seen, plan

    def show_plan(self, html: bytes) -> str:
        """Serve the page of a plan in place of the previous one; returns its address.

        ``html``: the page, not compressed. The address, relative, is random for each page.
        """
        name = secrets.token_urlsafe(32)
        self._loop.call_soon_threadsafe(self._take_plan, name, gzip.compress(html, 6))
        return f'plan/{name}'

    def _take_plan(self, name: str, content: bytes) -> None:
        """Replace the page of the plan; runs in the server's thread."""
        self._plan_page = name, content

    def plan_page(self, name: str) -> bytes:
        """Page of the plan of this name, compressed; empty for another name."""
        current_name, content = self._plan_page
        return (
            content
            if current_name and hmac.compare_digest(current_name.encode(), name.encode())
            else b''
        )

    def view(self) -> bytes:
        """The view as JSON with its number and age, s; notes that somebody watches."""
        self._asked_s = time.monotonic()
        number, issued_s = self._issued[-1]
        age_s = min(self._asked_s - issued_s, 1e6)
        return b'{"number":%d,"age_s":%.2f,"view":%s}' % (number, age_s, self._view)

    def refusal(self, seen: SeenView) -> str:
        """Reason why a person who has seen this view must look again; '' if it is current.

        Refused are views over 3 s old (`FRESH_S`), used before, or of another state. One that is
        accepted counts as used.
        """
        issued = dict(self._issued).get(seen.view, float('-inf'))
        if time.monotonic() - issued > FRESH_S or seen.view <= self._used:
            return 'the page was not up to date; look again'
        if not hmac.compare_digest(seen.seen.encode(), self._seen.encode()):
            return 'the collection has changed meanwhile; look again'
        # A request that comes twice counts once.
        self._used = seen.view
        return ''

    def command(self, name: str) -> str:
        """Command passed to `send`; '' if the view has no plan to confirm."""
        if name != CONFIRM:
            return name
        return f'{CONFIRM}/{self._plan}' if self._plan else ''

    def trust(self, request: HTTPServerRequest) -> None:
        """Keep the connection of a request that has shown the token."""
        self._connections.trust(request)

    def note_answer(self, request: HTTPServerRequest) -> None:
        """Begin the time for the next request of a connection."""
        self._connections.note_answer(request)

    def close(self) -> None:
        """Stop the server and wait up to 5 s for its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)

    def _run(self) -> None:
        """Serve until the loop is stopped, then close all connections; body of the thread."""
        asyncio.set_event_loop(self._loop)
        log_rarely(self._loop)
        application = Application(
            [
                (r'/view', _View, {'server': self}),
                (r'/scene', _Scene, {'server': self}),
                (r'/command/([a-z]+)', _Command, {'server': self}),
                (r'/plan/([\w-]+)', _Plan, {'server': self}),
                *(('/' + re.escape(name), _File, {'server': self}) for name in self.files),
            ],
            default_handler_class=_Nothing,
            default_handler_args={'server': self},
            log_function=lambda handler: None,
        )
        server = self._connections = BoundedServer(
            application,
            ssl_options=self._tls,
            max_body_size=LARGEST_BODY,
            max_buffer_size=16 * LARGEST_BODY,
            max_header_size=8 * LARGEST_BODY,
            idle_connection_timeout=IDLE_S,
            body_timeout=REQUEST_S,
        )
        server.add_socket(self._socket)
        try:
            self._loop.run_forever()
        finally:
            server.stop()
            self._loop.run_until_complete(server.close_all_connections())
            self._loop.close()


class _Handler(RequestHandler):
    """Request handler that refuses requests of other pages."""

    SUPPORTED_METHODS = ('GET', 'HEAD', 'POST')  # type: ignore[assignment]

    def initialize(self, server: LiveServer) -> None:
        """Store the server that the application passes."""
        self._server = server

    def on_finish(self) -> None:
        """Begin the time for the connection's next request."""
        self._server.note_answer(self.request)

    def set_default_headers(self) -> None:
        """Set the headers of every answer, without the name of the server."""
        self.clear_header('Server')
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse a request by another host name (HTTPError 421) or from another page (403).

        A command without the header Origin is refused as well (403).
        """
        headers, server = self.request.headers, self._server
        hosts, origins = headers.get_list('Host'), headers.get_list('Origin')
        if len(hosts) != 1 or hosts[0].lower() not in server.hosts:
            raise HTTPError(421, reason='not a name of this server')
        own_origin = f'{server.scheme}://{hosts[0].lower()}'
        if self.request.method == 'POST' and not origins:
            raise HTTPError(403, reason='a command needs the header Origin')
        if origins and origins != [own_origin]:
            raise HTTPError(403, reason='the request comes from another page')

    def write_error(self, status_code: int, **_: Any) -> None:
        """Answer an error as JSON: done false, and the reason as message."""
        self.set_header('Content-Type', 'application/json')
        self.finish(json.dumps({'done': False, 'message': self._reason}))

    def _packed(self, content: bytes, kind: str) -> None:
        """Answer with content that is gzip-compressed already; ``kind``: its Content-Type."""
        self.set_header('Content-Type', kind)
        self.set_header('Content-Encoding', 'gzip')
        self.finish(content)


class _File(_Handler):
    def get(self) -> None:
        """Answer with the fixed file of the requested name."""
        self._packed(*self._server.files[self.request.path.removeprefix('/')])


class _Plan(_Handler):
    """Page of a plan, at an address that only the view contains."""

    def get(self, name: str) -> None:
        """Answer with the page of a plan, sandboxed; HTTPError 404 if it is out of date."""
        content = self._server.plan_page(name)
        if not content:
            raise HTTPError(404, reason='this plan is out of date; look at the live page')
        self.set_header('Content-Security-Policy', _PLAN_POLICY)
        # Browsers refuse what is both in a sandbox and has an opener policy.
        self.clear_header('Cross-Origin-Opener-Policy')
        self._packed(content, 'text/html; charset=utf-8')


class _Nothing(_Handler):
    def prepare(self) -> None:
        """Refuse any address that is not served, HTTPError 404."""
        super().prepare()
        raise HTTPError(404, reason='there is no such page')


class _WithToken(_Handler):
    def prepare(self) -> None:
        """Refuse a request without the token, HTTPError 401; trust its connection otherwise."""
        super().prepare()
        given = self.request.headers.get_list('Authorization')
        wanted = f'Bearer {self._server.token}'
        if len(given) != 1 or not hmac.compare_digest(given[0].encode(), wanted.encode()):
            raise HTTPError(401, reason='open the page by the address that remaster watch gives')
        self._server.trust(self.request)


class _View(_WithToken):
    def get(self) -> None:
        """Answer with the current view as JSON."""
        self.set_header('Content-Type', 'application/json')
        self.finish(self._server.view())


class _Scene(_WithToken):
    def get(self) -> None:
        """Answer with the fixed part of the 3-D view as JSON."""
        self._packed(self._server.scene, 'application/json')


class _Command(_WithToken):
    async def post(self, name: str) -> None:
        """Send a command to its node and answer with its outcome; a long fit counts as 'fitting'.

        HTTPError: 404 unknown, 409 nothing to confirm or outdated view, 400 no view, 504 no answer
        within 5 s (`ANSWER_S`).
        """
        if name not in COMMANDS:
            raise HTTPError(404, reason='there is no such command')
        command = self._server.command(name)
        if not command:
            raise HTTPError(409, reason='no plan waits for a confirmation')
        if name in SEEN_FIRST:
            try:
                seen = msgspec.json.decode(self.request.body, type=SeenView)
            except (msgspec.MsgspecError, RecursionError):
                raise HTTPError(400, reason=f'{name} needs view and seen') from None
            if refusal := self._server.refusal(seen):
                raise HTTPError(409, reason=refusal)
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[tuple[bool, str]] = loop.create_future()

        def done(success: bool, message: str) -> None:
            loop.call_soon_threadsafe(_set, outcome, (success, message))

        self._server.send(command, done)
        try:
            success, message = await asyncio.wait_for(outcome, ANSWER_S)
        except TimeoutError:
            if name != 'fit':
                raise HTTPError(504, reason=f'no answer to {name} for {ANSWER_S:g} s') from None
            success, message = True, 'fitting'
        self.finish({'done': success, 'message': message})


def _set(future: asyncio.Future[tuple[bool, str]], outcome: tuple[bool, str]) -> None:
    """Set the result of a future, unless it is done already."""
    if not future.done():
        future.set_result(outcome)


@cache
def _files() -> dict[str, tuple[bytes, str]]:
    """Gzip-compressed files of the page by name ('' is the page itself), with their types."""
    folder = importlib.resources.files(__package__).joinpath('live_page')
    plotly = importlib.resources.files('plotly').joinpath('package_data', 'plotly.min.js')
    script = 'text/javascript; charset=utf-8'
    found = {
        '': (folder.joinpath('index.html'), 'text/html; charset=utf-8'),
        'page.js': (folder.joinpath('page.js'), script),
        'scene.js': (folder.joinpath('scene.js'), script),
        'page.css': (folder.joinpath('page.css'), 'text/css; charset=utf-8'),
        'plotly.js': (plotly, script),
    }
    texts = {name: (path.read_bytes(), kind) for name, (path, kind) in found.items()}
    texts['robot_view.js'] = view_script().encode(), script
    return {name: (gzip.compress(text, 6), kind) for name, (text, kind) in texts.items()}
