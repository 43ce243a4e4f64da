"""Connections to the live page: few, short until they have shown the token, and no flood of words.

Whoever reaches the port can open connections: on the computer of the page every user can, and
from its own address, too. So nobody is refused for where he comes from. Where there are too many
connections, the oldest one without the token is closed, of the address that has the most: the
page of its owner, which has shown the token, is kept, and a browser that opens the page needs
milliseconds.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import select
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
