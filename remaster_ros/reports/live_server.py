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
import gzip
import hmac
import importlib.resources
import json
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from typing import Any

import msgspec
from tornado.httputil import HTTPServerRequest
from tornado.web import Application, HTTPError, RequestHandler

from remaster_ros.reports.live_connections import (
    IDLE_S,
    REQUEST_S,
    BoundedServer,
    Place,
    hosts,
    listen,
    log_rarely,
    tls,
)
from remaster_ros.reports.scene_view import view_script

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
    """Number and mark of the view that a person saw before `collect` or `confirm`."""

    view: int
    seen: str


class LiveServer:
    """Web server of the live page, in a thread of its own; it starts when made.

    ``place``: where it listens; ``token``: required for view and commands; ``scene``: fixed
    part of the 3-D view, JSON. ``send`` is called in the server's thread with the name of a
    command (``confirm/NAME`` for the plan of that name) and with a callback for its outcome,
    which any thread may call: success, and a line for the person. Raises InputError if address
    or certificate cannot be used.
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
        """Show a view on the page from now on; any thread may call this.

        ``view``: of `LiveView.view`. Its 'seen' is the mark that the commands 'collect' and
        'confirm' have to name; its 'confirmation' has the plan to be confirmed, or is None.
        """
        content = msgspec.json.encode(view)  # NaN becomes null, which browsers read.
        plan = view['confirmation']['plan'] if view['confirmation'] else ''
        self._loop.call_soon_threadsafe(self._show, content, str(view['seen']), plan)

    def _show(self, content: bytes, seen: str, plan: str) -> None:
        """Replace view and plan, and give the view a number and the time; in the server's thread.

        ``content``: the view as JSON; ``seen``: its mark; ``plan``: name of its plan, or ''.
        """
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
        """Replace name and compressed page of the plan; runs in the server's thread."""
        self._plan_page = name, content

    def plan_page(self, name: str) -> bytes:
        """Return the gzip-compressed page of the plan of this name; b'' for any other name."""
        current_name, content = self._plan_page
        return (
            content
            if current_name and hmac.compare_digest(current_name.encode(), name.encode())
            else b''
        )

    def view(self) -> bytes:
        """Return the current view as JSON, with number and age, s; note that somebody watches."""
        self._asked_s = time.monotonic()
        number, issued_s = self._issued[-1]
        age_s = min(self._asked_s - issued_s, 1e6)
        return b'{"number":%d,"age_s":%.2f,"view":%s}' % (number, age_s, self._view)

    def refusal(self, seen: SeenView) -> str:
        """Return the reason to refuse a command given on an outdated view; '' if it is current.

        A view is outdated if it is over 3 s old (`FRESH_S`), if a command on it or on a later
        one was accepted before, or if its mark is not that of the present state. If the result
        is '', the view counts as used.
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
        """Return the command to pass to `send` for a command of the page.

        'confirm' becomes 'confirm/NAME' with the name of the view's plan, or '' if the view has
        no plan; other commands are unchanged.
        """
        if name != CONFIRM:
            return name
        return f'{CONFIRM}/{self._plan}' if self._plan else ''

    def trust(self, request: HTTPServerRequest) -> None:
        """Count the connection of a request as one that has shown the token."""
        self._connections.trust(request)

    def note_answer(self, request: HTTPServerRequest) -> None:
        """Note that a request is answered: the time for its connection's next one begins."""
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
    """HTTP request handler that refuses requests by other host names or from other web pages."""

    SUPPORTED_METHODS = ('GET', 'HEAD', 'POST')  # type: ignore[assignment]

    def initialize(self, server: LiveServer) -> None:
        """Store the server that the application passes."""
        self._server = server

    def on_finish(self) -> None:
        """Note that the request is answered; called by tornado."""
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
        """Answer an error as JSON: 'done' is false, 'message' the reason."""
        self.set_header('Content-Type', 'application/json')
        self.finish(json.dumps({'done': False, 'message': self._reason}))

    def _packed(self, content: bytes, kind: str) -> None:
        """Answer with content that is gzip-compressed already; ``kind``: its Content-Type."""
        self.set_header('Content-Type', kind)
        self.set_header('Content-Encoding', 'gzip')
        self.finish(content)


class _File(_Handler):
    """Handler of the page's fixed files, which need no token."""

    def get(self) -> None:
        """Answer with the fixed file of the requested name."""
        self._packed(*self._server.files[self.request.path.removeprefix('/')])


class _Plan(_Handler):
    """Handler of the page of a plan, at a random address that only the view contains."""

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
    """Handler of all addresses that are not served."""

    def prepare(self) -> None:
        """Refuse any address that is not served, HTTPError 404."""
        super().prepare()
        raise HTTPError(404, reason='there is no such page')


class _WithToken(_Handler):
    """Handler of requests that need the token."""

    def prepare(self) -> None:
        """Refuse a request without the token, HTTPError 401; trust its connection otherwise."""
        super().prepare()
        given = self.request.headers.get_list('Authorization')
        wanted = f'Bearer {self._server.token}'
        if len(given) != 1 or not hmac.compare_digest(given[0].encode(), wanted.encode()):
            raise HTTPError(401, reason='open the page by the address that remaster watch gives')
        self._server.trust(self.request)


class _View(_WithToken):
    """Handler that answers with the current view."""

    def get(self) -> None:
        """Answer with the current view as JSON."""
        self.set_header('Content-Type', 'application/json')
        self.finish(self._server.view())


class _Scene(_WithToken):
    """Handler that answers with the fixed part of the 3-D view."""

    def get(self) -> None:
        """Answer with the fixed part of the 3-D view as JSON."""
        self._packed(self._server.scene, 'application/json')


class _Command(_WithToken):
    """Handler of the five commands of the page."""

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
    """Return the page's fixed files by name: gzip-compressed content, and Content-Type.

    '' is the page itself. Cached.
    """
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
