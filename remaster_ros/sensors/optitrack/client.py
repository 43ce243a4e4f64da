# SPDX-License-Identifier: Apache-2.0
"""OptiTrack client: sockets and one thread around the NatNet decoder, without ROS.

No datagram can end the thread: a foreign, damaged, late or not measured one is counted with its
reason and dropped. CONNECT is sent again whenever the stream stops or cannot be decoded, so that
the client follows a restarted server, or one of another version.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerSample
from remaster_ros.sensors.optitrack.marker_follower import MarkerFollower
from remaster_ros.sensors.optitrack.natnet import Message, MessageId, ServerInfo
from remaster_ros.sensors.optitrack.natnet_bytes import ProtocolError
from remaster_ros.sensors.optitrack.natnet_frame import (
    BITSTREAM_CHANGED,
    MODEL_LIST_CHANGED,
    Frame,
)
from remaster_ros.sensors.optitrack.natnet_model import ModelDefinition
from remaster_ros.sensors.optitrack.settings import (
    NatNetSettings,
    open_multicast_socket,
    open_socket,
)
from remaster_ros.sensors.optitrack.source_lock import Source

RETRY_S = 0.5
KEEPALIVE_S = 1.0
POLL_S = 0.1
DATAGRAMS_PER_TURN = 1024
"""Largest number of datagrams between two checks of the thread's timers."""
DIGEST_S = 0.005
"""Longest time of decoding, s, before the sockets are emptied again."""
MAX_BACKLOG_BYTES = 1 << 26
"""Largest backlog of datagrams: twenty seconds of 1 kHz frames with 50 markers."""
MALFORMED_IN_A_ROW = 3
"""Malformed datagrams in a row from which the version has probably changed; then CONNECT again."""
NEGOTIATION_TRIES = 4
MAX_DATAGRAM_BYTES = 1 << 16
# Known messages, and those between servers and other clients of a multicast group.
_KNOWN = frozenset(map(int, MessageId))
_OF_OTHERS = frozenset(
    {MessageId.KEEPALIVE, MessageId.DISCOVERY, MessageId.ECHOREQUEST, MessageId.CONNECT}
)
_FRAME_ID = MessageId.FRAMEOFDATA.to_bytes(2, 'little')


class NatNetClient(MarkerFollower):
    """Client for NatNet 2.6 to 4.3, multicast or unicast; see `MarkerFollower`."""

    def __init__(
        self,
        settings: NatNetSettings,
        on_sample: Callable[[MarkerSample], object],
        clock: Callable[[], float] = time.time,
    ) -> None:
        super().__init__(settings, on_sample, clock)
        self._command: socket.socket | None = None
        self._data: socket.socket | None = None
        self._greet = True
        self._model_wanted = False
        self._negotiation_tries = 0
        self._malformed_in_a_row = 0
        self._bitstream_changed = False
        # Datagrams not yet decoded: bytes, arrival, sender, whether received by the data socket.
        self._backlog: deque[tuple[bytes, float, Source, bool]] = deque()
        self._backlog_bytes = 0
        self._due = dict.fromkeys(('connect', 'model', 'keepalive', 'bitstream'), 0.0)

    def _open(self) -> None:
        """Open the command socket and, for multicast, the data socket.

        Raises DeviceError if that fails; no socket stays open then.
        """
        settings = self._settings
        self._command = open_socket(
            self._status.interface, 0, purpose='local_interface', remedy='correct local_interface'
        )
        if settings.transport == 'multicast':
            try:
                self._data = open_multicast_socket(
                    settings.multicast_group, settings.data_port, self._status.interface
                )
            except DeviceError:
                self._command.close()
                self._command = None
                raise

    def _close(self) -> None:
        """Take leave of the server, close both sockets, and drop the backlog."""
        self._send(natnet.join_datagram(MessageId.DISCONNECT))
        for opened in (self._command, self._data):
            if opened is not None:
                opened.close()
        self._command = self._data = None
        self._backlog.clear()
        self._backlog_bytes = 0

    def _run(self) -> None:
        """Send due requests, receive datagrams and digest them, until `_stopping` is set."""
        with selectors.DefaultSelector() as selector:
            for opened in (self._command, self._data):
                if opened is not None:
                    selector.register(opened, selectors.EVENT_READ)
            while not self._stopping.is_set():
                self._greet = self._release_silent_source() or self._greet
                self._send_due_requests(time.monotonic())
                for key, _ in selector.select(0.0 if self._backlog else POLL_S):
                    self._receive(key.fileobj)  # type: ignore[arg-type]
                self._digest_backlog()

    def _send_due_requests(self, now: float) -> None:
        """Send the requests that are due at `now`, `time.monotonic`, s.

        CONNECT while frames or the answer are missing, the wanted bitstream, KEEPALIVE in unicast,
        the model's description if it is wanted.
        """
        silent = (
            self._status.server is None
            or self._frame_at is None
            or now - self._frame_at > self._settings.silence_s
            or self._greet
        )
        negotiating = self._status.server is not None and self._status.version is None
        if silent and not negotiating and self._is_due('connect', now, RETRY_S):
            self._send(natnet.encode_connect_request('remaster_ros'))
            if self._status.server is None:
                self._note_closed_port()
        if self._status.server is None:
            return
        if negotiating and self._is_due('bitstream', now, RETRY_S):
            self._negotiate(self._status.server)
        if self._is_unicast(self._status.server) and self._is_due('keepalive', now, KEEPALIVE_S):
            self._send(natnet.join_datagram(MessageId.KEEPALIVE))
        if self._status.version and self._model_wanted and self._is_due('model', now, RETRY_S):
            self._send(natnet.join_datagram(MessageId.REQUEST_MODELDEF))

    def _is_unicast(self, server: ServerInfo) -> bool:
        """Whether the server streams unicast, by its own answer.

        By the setting `transport` if the answer has no connection settings (before NatNet
        3.0).
        """
        if server.connection is None:
            return self._settings.transport == 'unicast'
        return not server.connection.is_multicast

    def _is_due(self, what: str, now: float, every_s: float) -> bool:
        """Whether a kind of request is due at `now`, s; the next is due `every_s` after it.

        ``what``: key of `_due`; ``now``: `time.monotonic`.
        """
        if now < self._due[what]:
            return False
        self._due[what] = now + every_s
        return True

    def _send(self, datagram: bytes) -> None:
        """Send a datagram to the server, unless closed; note a failure in `send_error`."""
        if self._command is None:
            return
        try:
            self._command.sendto(datagram, (self._status.server_ip, self._settings.command_port))
            self._status.send_error = ''
        except OSError as error:
            self._status.send_error = error.strerror or str(error)

    def _receive(self, source: socket.socket) -> None:
        """Empty a socket into the backlog.

        The buffer of a socket is small: a thread that waited long for a processor must not lose
        more while it decodes the received datagrams.
        """
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                datagram, sender = source.recvfrom(MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except OSError as error:
                self._status.send_error = error.strerror or str(error)
                self._stopping.wait(POLL_S)
                return
            received_s = self._clock()
            if self._is_foreign(sender[0]):
                continue
            if self._backlog_bytes + len(datagram) > MAX_BACKLOG_BYTES:
                self._gate.drop(Dropped.OVERRUN)
                continue
            self._backlog_bytes += len(datagram)
            self._backlog.append((datagram, received_s, sender, source is self._data))

    def _digest_backlog(self) -> None:
        """Digest waiting datagrams, oldest first, for `DIGEST_S` at most; the others stay."""
        until = time.monotonic() + DIGEST_S
        while self._backlog:
            datagram, received_s, sender, from_data_socket = self._backlog.popleft()
            self._backlog_bytes -= len(datagram)
            self._digest(datagram, received_s, sender, from_data_socket=from_data_socket)
            if time.monotonic() >= until:
                return

    def _digest(
        self, datagram: bytes, received_s: float, sender: Source, *, from_data_socket: bool
    ) -> None:
        """Decode one datagram and process it; drop a foreign one, count a malformed one.

        Frames count from one source, answers from the command port only: another program on
        the server's computer could send another version or another marker. ``received_s``:
        when the datagram came, s; ``from_data_socket``: whether by the data socket, else by
        the command socket.
        """
        looks_like_frame = datagram[:2] == _FRAME_ID
        is_answer = not from_data_socket and sender[1] == self._settings.command_port
        if not (is_answer and not looks_like_frame) and self._is_refused(sender):
            return
        if not (is_answer or looks_like_frame or from_data_socket):
            self._gate.drop(Dropped.FOREIGN)
            return
        try:
            message_id, _payload = natnet.split_datagram(datagram)
            is_frame = message_id == MessageId.FRAMEOFDATA
            if _is_of_others(message_id, from_data_socket):
                return
            if from_data_socket and not is_frame:
                raise ProtocolError(f'message {message_id} on the data port')
            if self._status.version is None and (is_frame or message_id == MessageId.MODELDEF):
                self._gate.drop(Dropped.UNRESOLVED)
                return
            message = natnet.decode_message(datagram, self._status.version)
        except ProtocolError as error:
            self._note_malformed(error)
            self._malformed_in_a_row += 1
            self._greet = self._greet or self._malformed_in_a_row >= MALFORMED_IN_A_ROW
            return
        if isinstance(message, Frame):
            self._take_frame(message, received_s, sender)
        else:
            self._take_answer(message)

    def _take_frame(self, frame: Frame, received_s: float, sender: Source) -> None:
        """Hand on the readings of a frame, if its source is the believed one.

        A changed bitstream has the server greeted again, a changed model requested again.
        ``received_s``: when the frame came, s; ``sender``: its source.
        """
        samples = self._take_whole_frame(frame, received_s, sender)
        if sender != self._lock.source:
            return
        self._malformed_in_a_row = 0
        bitstream_changed = bool(frame.params & BITSTREAM_CHANGED)
        if bitstream_changed and not self._bitstream_changed:
            self._greet = True
        self._bitstream_changed = bitstream_changed
        if frame.params & MODEL_LIST_CHANGED:
            self._model_wanted = True
        for sample in samples:
            self._hand_on(sample)

    def _take_answer(self, message: Message) -> None:
        """Process an answer on the command channel, by its type.

        A server that disconnects counts as unanswered; other kinds are ignored.
        """
        if isinstance(message, ServerInfo):
            self._take_server(message)
        elif isinstance(message, ModelDefinition):
            self._model_wanted = False
            self._name_assets(message.labelled_assets)
        elif isinstance(message, natnet.Response):
            self._take_bitstream(message)
        elif isinstance(message, natnet.Notice):
            if message.id == MessageId.UNRECOGNIZED_REQUEST:
                self._take_bitstream(None)
            else:
                self._status.server = None

    def _take_server(self, server: ServerInfo) -> None:
        """Process an answer to CONNECT: request the model, negotiate the bitstream if one is set.

        Frames may be believed (`SourceLock`) from then on; without a set bitstream the
        server's own version is read.
        """
        self._status.server = server
        self._lock.answer()
        self._status.port_closed = False
        self._malformed_in_a_row = 0
        self._greet = False
        self._model_wanted = True
        self._negotiation_tries = 0
        # A server that was greeted again may have forgotten the negotiated version.
        self._status.version = None if self._settings.wanted_version else server.natnet_version

    def _negotiate(self, server: ServerInfo) -> None:
        """Request the wanted bitstream once more, up to NEGOTIATION_TRIES times.

        After that, or if none is wanted, the server's own version is read.
        """
        wanted = self._settings.wanted_version
        if wanted is None or self._negotiation_tries >= NEGOTIATION_TRIES:
            self._status.version = server.natnet_version
            return
        self._negotiation_tries += 1
        self._send(natnet.encode_command_request(f'Bitstream,{natnet.format_version(wanted)}'))

    def _take_bitstream(self, answer: natnet.Response | None) -> None:
        """Process the answer to the request of `_negotiate`; None if the server refused it.

        The version that is read from then on is the one in the answer's text
        (``Bitstream,4.1``), the wanted one if the answer is the code 0, else the server's own.
        Ignored if no answer is awaited.
        """
        if self._status.server is None or self._status.version is not None:
            return
        self._status.version = self._status.server.natnet_version
        if answer is None:
            return
        name, _, version = answer.text.partition(',')
        if name == 'Bitstream':
            with contextlib.suppress(ValueError):
                self._status.version = natnet.parse_version(version)
        elif answer.code == 0:
            self._status.version = self._settings.wanted_version


def _is_of_others(message_id: int, from_data_socket: bool) -> bool:
    """Whether a message is valid NatNet that a client does not need, and therefore not malformed.

    On the data port, to which a multicast server also sends its notes and answers to others, these
    are all messages but frames.
    """
    if from_data_socket:
        return message_id in _KNOWN and message_id != MessageId.FRAMEOFDATA
    return message_id in _OF_OTHERS
