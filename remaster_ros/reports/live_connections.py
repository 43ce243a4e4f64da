# SPDX-License-Identifier: Apache-2.0
"""Connections to the live page: address, TLS, limits of number and time, log of errors.

Connections are few, and short until they have shown the token. Anybody who reaches the port can
open them; on the computer of the page each user can, and from its own address, too. So no address
is refused. If there are too many connections, the oldest one without the token is closed, of the
address that has the most: the page of the owner, which has shown the token, is kept, and a browser
that opens the page needs milliseconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import select
import socket
import ssl
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from tornado.http1connection import HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import PeriodicCallback
from tornado.iostream import IOStream

from remaster_ros.errors import InputError

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


@dataclass(frozen=True)
class Place:
    """Address, port and certificate with which the live page is served."""

    # IP address to listen on, and port; 0 for any free port
    address: str = '127.0.0.1'
    port: int = 0
    # Further names of this computer that a browser may use
    names: tuple[str, ...] = ()
    # PEM files for https, required for an address that other computers reach; '' for http
    certificate: str = ''
    key: str = ''


def listen(place: Place) -> socket.socket:
    """Open a non-blocking socket that listens at an address and port.

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
    """Return the allowed values of the HTTP header Host, 'name:port'; the URL has the first.

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


@dataclass
class _OpenConnection:
    """Open connection to a browser.

    ``address``: of the user, see `_network`; ``since_s``: monotonic time of its begin or last
    answer; ``has_token``: whether it has shown the token.
    """

    address: str
    since_s: float = field(default_factory=time.monotonic)
    has_token: bool = False


class BoundedServer(HTTPServer):
    """HTTP server with a bounded number of connections.

    Parameters as of tornado's `HTTPServer`.
    """

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
        """Forget a connection that has ended; called by tornado."""
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
        """Close the oldest connection of an address, one without the token if there is any.

        ValueError if the address has none. Age is the time since its last answer or its begin.
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
    """Return the key by which connections of one user are counted.

    An IPv4 address, or the /64 network of an IPv6 one; text that is no address is unchanged.
    """
    with contextlib.suppress(ValueError):
        if isinstance(
            parsed := ipaddress.ip_address(address.partition('%')[0]), ipaddress.IPv6Address
        ):
            return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
    return address


class _RareHandler(logging.Handler):
    """Log handler that writes at most a line a minute to stderr, and counts the others.

    It never blocks.
    """

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
    """Log errors of tornado and of an event loop to stderr, at most one line a minute.

    Replaces the handlers of the logger 'tornado' and the loop's exception handler.
    """
    handler = _RareHandler()
    logger = logging.getLogger('tornado')
    logger.handlers, logger.propagate = [handler], False

    def report(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get('exception')
        what = f'{type(error).__name__}: {error}' if error else context['message']
        handler.note(' '.join(what.split()))

    loop.set_exception_handler(report)
