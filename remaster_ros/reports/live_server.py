# SPDX-License-Identifier: Apache-2.0
"""Web server of the live page: fixed files, the view as JSON, and five commands.

Whoever may command here lets an arm move, so every request is judged as if it came from somebody
who is not meant to:

- Host has to be a name of this server (a foreign page that has its own name resolve to this
  address is refused), and Origin, which every command needs, this server's own.
- View, scene and commands need the token in the header Authorization. No cookie is set: browsers
  would send it with requests of other pages, and to servers on other ports of this address. The
  token stands behind the # of the page's address, which browsers never send.
- ``collect`` and ``confirm`` also name the view that the person has seen. A request that was held
  up on its way, or that belongs to another state of the collection or another plan, is refused.
- The page of a plan, which a browser opens without a header, has an address that only the view
  tells, and is shown as a stranger's: it reaches neither this server nor the token (sandbox).
- Nothing is written, no path comes from a request, bodies are small, no page may frame this one,
  and no script runs here but the ones of this package.
- Connections are few, and those that have not shown the token live for one request
  (`live_connections`). Trouble is one line a minute, which is left out where nobody reads.
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

# Connections to the live page: few, short until they have shown the token, and no flood of words.
#
# Whoever reaches the port can open connections: on the computer of the page every user can, and
# from its own address, too. So nobody is refused for where he comes from. Where there are too
# many connections, the oldest one without the token is closed, of the address that has the most:
# the page of its owner, which has shown the token, is kept, and a browser that opens the page
# needs milliseconds.


MOST = 128
"""Connections in all: a browser opens six to a page, so this is for twenty browsers."""
MOST_EACH = 64
"""Of one address: one cannot take the place of all others."""
REQUEST_S = 5.0
"""From the begin of a connection, or its last answer, to the end of a request, s."""
ANSWER_TAKEN_S = 60.0
"""So long an answer may be on its way, s: the page has 1.5 MB, 0.2 Mbit/s take a minute."""
IDLE_S = 30.0
"""How long a page that has shown the token may ask for nothing, s."""
LINE_EVERY_S = 60.0
LONGEST_LINE = 400
"""Characters: a line that a pipe takes at once where it takes anything (PIPE_BUF is 4096)."""


@dataclass
class _Held:
    """A connection that is open: whose, since when it owes a request, whether it has the token."""

    address: str
    since_s: float = field(default_factory=time.monotonic)
    believed: bool = False


class BoundedServer(HTTPServer):
    """A web server with a bounded number of connections; parameters as of `HTTPServer`."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        """As in tornado."""
        super().initialize(*args, **kwargs)
        self._held: dict[IOStream, _Held] = {}
        PeriodicCallback(self._close_late, 500.0).start()

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Take a new connection, and close another one where there are too many."""
        held = self._held[stream] = _Held(_network(str(address[0])))
        counts = Counter(other.address for other in self._held.values())
        if counts[held.address] > MOST_EACH:
            self._close_oldest(held.address)
        elif len(self._held) > MOST:
            self._close_oldest(max(counts, key=counts.__getitem__))
        if not stream.closed():
            super().handle_stream(stream, address)

    def on_close(self, server_conn: object) -> None:
        """Forget a connection that has ended."""
        assert isinstance(server_conn, HTTP1ServerConnection)
        super().on_close(server_conn)
        self._held.pop(server_conn.stream, None)

    def believe(self, request: HTTPServerRequest) -> None:
        """Keep the connection of a request that has shown the token."""
        if (held := self._held.get(_stream(request))) is not None:
            held.believed = True

    def answered(self, request: HTTPServerRequest) -> None:
        """Note that a request is answered; the next one has its own time."""
        if (held := self._held.get(_stream(request))) is not None:
            held.since_s = time.monotonic()

    def _close_oldest(self, address: str) -> None:
        """Close the connection of an address that is dearest to nobody: without token, oldest."""
        of_it = [(held.believed, held.since_s, id(stream)) for stream, held in self._of(address)]
        worst = min(of_it)[2]
        self._close(next(stream for stream, _ in self._of(address) if id(stream) == worst))

    def _of(self, address: str) -> list[tuple[IOStream, _Held]]:
        return [item for item in self._held.items() if item[1].address == address]

    def _close_late(self) -> None:
        """Close connections whose request does not come, or whose answer is not taken."""
        now = time.monotonic()
        for stream, held in list(self._held.items()):
            allowed = IDLE_S if held.believed else REQUEST_S
            if now - held.since_s > (ANSWER_TAKEN_S if stream.writing() else allowed):
                self._close(stream)

    def _close(self, stream: IOStream) -> None:
        self._held.pop(stream, None)
        stream.close()


def _stream(request: HTTPServerRequest) -> IOStream:
    stream: IOStream = request.connection.stream  # type: ignore[union-attr]
    return stream


def _network(address: str) -> str:
    """Return what one user has: an IPv4 address, or all of a network of IPv6."""
    with contextlib.suppress(ValueError):
        if isinstance(
            parsed := ipaddress.ip_address(address.partition('%')[0]), ipaddress.IPv6Address
        ):
            return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
    return address


class _Rarely(logging.Handler):
    """Writes a line a minute to stderr, with how many were left out; never waits for a reader."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._next_s, self._left_out = float('-inf'), 0

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, or count it."""
        self.note(' '.join(record.getMessage().split()))

    def note(self, text: str) -> None:
        """Write a line, or count it."""
        now = time.monotonic()
        if now < self._next_s:
            self._left_out += 1
            return
        more = f' ({self._left_out} more since the last such line)' if self._left_out else ''
        self._next_s, self._left_out = now + LINE_EVERY_S, 0
        line = f'live page: {text[:LONGEST_LINE]}{more}\n'.encode(errors='replace')
        # Another program may have closed what this one has as stderr.
        with contextlib.suppress(OSError, ValueError):
            where = sys.stderr.fileno()
            if select.select([], [where], [], 0.0)[1]:
                os.write(where, line)


def log_rarely(loop: asyncio.AbstractEventLoop) -> None:
    """Have what tornado and a loop report in one line a minute."""
    handler = _Rarely()
    logger = logging.getLogger('tornado')
    logger.handlers, logger.propagate = [handler], False

    def report(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get('exception')
        what = f'{type(error).__name__}: {error}' if error else context['message']
        handler.note(' '.join(what.split()))

    loop.set_exception_handler(report)


@dataclass(frozen=True)
class Place:
    """Where the page is served."""

    # The IP address to listen on, and the port; 0 for any free one
    address: str = '127.0.0.1'
    port: int = 0
    # Names of this computer by which a browser may ask besides the address
    names: tuple[str, ...] = ()
    # PEM files for https; an address that other computers reach needs them
    certificate: str = ''
    key: str = ''


def listen(place: Place) -> socket.socket:
    """Return a socket that listens there."""
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
    """Return what https needs; None for http."""
    if not place.certificate:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(place.certificate, place.key or None)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f'live page: certificate {place.certificate}: {error}') from None
    return context


def hosts(place: Place, port: int) -> tuple[str, ...]:
    """Return what the header Host may be; the first one stands in the page's address."""
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
"""What a person must have seen something of who asks for it."""
FRESH_S = 3.0
"""A view that is older has not been seen just now."""
ANSWER_S = 5.0
"""So long a command is waited for."""
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


class Seen(msgspec.Struct, forbid_unknown_fields=True):
    """What a person has seen who lets the arm move or confirms: number and mark of the view."""

    view: int
    seen: str


class LiveServer:
    """Serves the page in a thread of its own.

    ``token`` is what view and commands ask for, ``scene`` the fixed part of the 3-D view, JSON.
    ``send`` is called in the server's thread with the name of a command (``confirm/NAME`` for the
    plan of that name) and with what takes its outcome, from any thread: whether it was done, and a
    line for the person. An `InputError` where address or certificate cannot be used.
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
        """The address of the page, with the token."""
        return f'{self.scheme}://{self.hosts[0]}/#token={self.token}'

    @property
    def watched(self) -> bool:
        """Whether somebody has asked for the view within the last seconds."""
        return time.monotonic() - self._asked_s < WATCHED_S

    def publish(self, view: dict[str, Any]) -> None:
        """Show a view from now on.

        Its ``seen`` is the mark that `collect` and `confirm` have to name; its ``confirmation``
        has the plan that is confirmed with it.
        """
        content = msgspec.json.encode(view)  # NaN becomes null, which browsers read.
        plan = view['confirmation']['plan'] if view['confirmation'] else ''
        self._loop.call_soon_threadsafe(self._show, content, str(view['seen']), plan)

    def _show(self, content: bytes, seen: str, plan: str) -> None:
        self._issued.append((self._issued[-1][0] + 1, time.monotonic()))
        self._view, self._seen, self._plan = content, seen, plan

    def show_plan(self, html: bytes) -> str:
        """Serve the page of a plan in place of the one before; return its address."""
        name = secrets.token_urlsafe(32)
        self._loop.call_soon_threadsafe(self._take_plan, name, gzip.compress(html, 6))
        return f'plan/{name}'

    def _take_plan(self, name: str, content: bytes) -> None:
        self._plan_page = name, content

    def plan_page(self, name: str) -> bytes:
        """Return the page of the plan, compressed, where this is its name; empty otherwise."""
        own, content = self._plan_page
        return content if own and hmac.compare_digest(own.encode(), name.encode()) else b''

    def view(self) -> bytes:
        """Return the view as JSON, with its number and age."""
        self._asked_s = time.monotonic()
        number, issued_s = self._issued[-1]
        age_s = min(self._asked_s - issued_s, 1e6)
        return b'{"number":%d,"age_s":%.2f,"view":%s}' % (number, age_s, self._view)

    def refusal(self, seen: Seen) -> str:
        """Return why a person who has seen this must look again; ''."""
        issued = dict(self._issued).get(seen.view, float('-inf'))
        if time.monotonic() - issued > FRESH_S or seen.view <= self._used:
            return 'the page was not up to date; look again'
        if not hmac.compare_digest(seen.seen.encode(), self._seen.encode()):
            return 'the collection has changed meanwhile; look again'
        # A request that comes twice counts once.
        self._used = seen.view
        return ''

    def command(self, name: str) -> str:
        """Return what `send` is asked for; '' where the view has no plan to confirm."""
        if name != CONFIRM:
            return name
        return f'{CONFIRM}/{self._plan}' if self._plan else ''

    def believe(self, request: HTTPServerRequest) -> None:
        """Keep the connection of a request that has shown the token, whatever others do."""
        self._connections.believe(request)

    def answered(self, request: HTTPServerRequest) -> None:
        """Give the connection of a request time for the next one."""
        self._connections.answered(request)

    def close(self) -> None:
        """End the server and its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)

    def _run(self) -> None:
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
    """Refuses what does not come from the page of this server."""

    SUPPORTED_METHODS = ('GET', 'HEAD', 'POST')  # type: ignore[assignment]

    def initialize(self, server: LiveServer) -> None:
        self._server = server

    def on_finish(self) -> None:
        self._server.answered(self.request)

    def set_default_headers(self) -> None:
        self.clear_header('Server')
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        headers, server = self.request.headers, self._server
        hosts, origins = headers.get_list('Host'), headers.get_list('Origin')
        if len(hosts) != 1 or hosts[0].lower() not in server.hosts:
            raise HTTPError(421, reason='not a name of this server')
        own = f'{server.scheme}://{hosts[0].lower()}'
        if self.request.method == 'POST' and not origins:
            raise HTTPError(403, reason='a command needs the header Origin')
        if origins and origins != [own]:
            raise HTTPError(403, reason='the request comes from another page')

    def write_error(self, status_code: int, **_: Any) -> None:
        self.set_header('Content-Type', 'application/json')
        self.finish(json.dumps({'done': False, 'message': self._reason}))

    def _packed(self, content: bytes, kind: str) -> None:
        """Answer with content that is compressed already."""
        self.set_header('Content-Type', kind)
        self.set_header('Content-Encoding', 'gzip')
        self.finish(content)


class _File(_Handler):
    def get(self) -> None:
        self._packed(*self._server.files[self.request.path.removeprefix('/')])


class _Plan(_Handler):
    """The page of a plan, by the address that the view tells to those who have the token."""

    def get(self, name: str) -> None:
        content = self._server.plan_page(name)
        if not content:
            raise HTTPError(404, reason='this plan is out of date; look at the live page')
        self.set_header('Content-Security-Policy', _PLAN_POLICY)
        # Browsers refuse what is both in a sandbox and has an opener policy.
        self.clear_header('Cross-Origin-Opener-Policy')
        self._packed(content, 'text/html; charset=utf-8')


class _Nothing(_Handler):
    def prepare(self) -> None:
        super().prepare()
        raise HTTPError(404, reason='there is no such page')


class _WithToken(_Handler):
    def prepare(self) -> None:
        super().prepare()
        given = self.request.headers.get_list('Authorization')
        wanted = f'Bearer {self._server.token}'
        if len(given) != 1 or not hmac.compare_digest(given[0].encode(), wanted.encode()):
            raise HTTPError(401, reason='open the page by the address that remaster watch gives')
        self._server.believe(self.request)


class _View(_WithToken):
    def get(self) -> None:
        self.set_header('Content-Type', 'application/json')
        self.finish(self._server.view())


class _Scene(_WithToken):
    def get(self) -> None:
        self._packed(self._server.scene, 'application/json')


class _Command(_WithToken):
    async def post(self, name: str) -> None:
        if name not in COMMANDS:
            raise HTTPError(404, reason='there is no such command')
        command = self._server.command(name)
        if not command:
            raise HTTPError(409, reason='no plan waits for a confirmation')
        if name in SEEN_FIRST:
            try:
                seen = msgspec.json.decode(self.request.body, type=Seen)
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
    if not future.done():
        future.set_result(outcome)


@cache
def _files() -> dict[str, tuple[bytes, str]]:
    """Return the page's files by name, compressed, with their types."""
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
