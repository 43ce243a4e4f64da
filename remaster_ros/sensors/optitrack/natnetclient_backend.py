# SPDX-License-Identifier: Apache-2.0
"""Backend ``client: natnetclient``: PyPI ``natnetclient`` with checks.

That package (LGPL, 2018) reads NatNet 2.6 to 2.10 from a server on the same computer that sends
its frames unicast to a fixed port. It checks no datagram, keeps markers that are no longer sent
and waits a minute if no datagram comes. So it runs here without its own thread: each datagram is
first checked by our decoder, then read by ``natnetclient`` with its memory cleared, and a reading
counts only if both agree.
"""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import time
import warnings
from collections.abc import Callable
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.frame_gate import Dropped, MarkerSample
from remaster_ros.sensors.optitrack.marker_follower import Diagnosis, MarkerFollower
from remaster_ros.sensors.optitrack.natnet_bytes import OLDEST_VERSION, ProtocolError
from remaster_ros.sensors.optitrack.natnet_frame import (
    MODEL_FILLED,
    OCCLUDED,
    Frame,
    LabeledMarker,
)
from remaster_ros.sensors.optitrack.settings import NatNetSettings, open_socket

NEWEST_READ = (2, 10)
READS = 'NatNet 2.6 to 2.10 in unicast only, one marker, from a server on this computer'
"""Part of NatNet that this backend supports, for people."""
POLL_S = 0.2
FAILURES_IN_A_ROW = 3
"""Failures from which the server's model has probably changed: natnetclient begins again."""


class NatNetClientBackend(MarkerFollower):
    """Client for one marker by PyPI ``natnetclient``; same interface as `NatNetClient`.

    ``settings``: `transport` must be ``unicast``; frames are expected on `data_port` of this
    computer; ``on_sample, clock``: as for `NatNetClient`. Raises InputError if ``natnetclient`` is
    not installed, or does not support the settings.
    """

    def __init__(
        self,
        settings: NatNetSettings,
        on_sample: Callable[[MarkerSample], object],
        clock: Callable[[], float] = time.time,
    ) -> None:
        wrong = {
            f'transport is {settings.transport}': settings.transport != 'unicast',
            f'bitstream is {settings.bitstream}': bool(settings.bitstream),
            'the cell file has further_markers': bool(settings.further_markers),
        }
        if refused := ' and '.join(text for text, is_wrong in wrong.items() if is_wrong):
            raise InputError(
                f'client: natnetclient reads {READS}, but {refused}: set client to builtin, which '
                'reads NatNet 2.6 to 4.3, multicast and unicast'
            )
        # natnetclient replaces the blanks of a name by underscores.
        name = settings.marker.rigid_body.replace(' ', '_')
        marker = dataclasses.replace(settings.marker, rigid_body=name)
        super().__init__(dataclasses.replace(settings, marker=marker), on_sample, clock)
        self._kind = _quiet_client()
        self._refusal = ''

    def diagnosis(self) -> Diagnosis:
        """Fault and remedy if readings are missing, `HEALTHY` if they are not.

        The fault is 'version' if natnetclient cannot read the version that the server streams.
        """
        return Diagnosis('version', self._refusal) if self._refusal else super().diagnosis()

    def _open(self) -> None:
        """Check that the server's address and data port can be bound here; else DeviceError."""
        # natnetclient binds the server's own address; this check fails before it opens sockets.
        open_socket(
            self._status.server_ip,
            self._settings.data_port,
            purpose='frames for natnetclient, which needs the server on this computer',
            remedy='set client to builtin',
            shared=True,
        ).close()

    def _close(self) -> None:
        """Do nothing: `_run` closes its own sockets."""

    def _run(self) -> None:
        """Greet and follow the server until stopped; after an error (in the status), again."""
        while not self._stopping.is_set():
            if self._greet():
                client = self._kind.__new__(self._kind)
                try:
                    client.__init__(
                        self._status.server_ip,
                        self._settings.data_port,
                        self._settings.command_port,
                    )
                    self._follow(client)
                except Exception as error:  # natnetclient raises whatever its bugs raise
                    self._status.last_malformed = f'natnetclient: {error!r}'
                finally:
                    _close_sockets(client)
            self._stopping.wait(POLL_S)

    def _greet(self) -> bool:
        """Request the server's version with our decoder; return whether natnetclient can read it.

        False also without an answer in `POLL_S`; `diagnosis` has the reason.
        """
        request = natnet.encode_connect_request('remaster_ros')
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as command:
            command.settimeout(POLL_S)
            try:
                command.sendto(request, (self._status.server_ip, self._settings.command_port))
                answer = natnet.decode_message(command.recv(1 << 16), None)
            except (OSError, ProtocolError):
                answer = None
        if not isinstance(answer, natnet.ServerInfo):
            self._status.server = None
            self._note_closed_port()
            return False
        self._status.server, self._status.port_closed = answer, False
        self._lock.answer()
        self._status.version = answer.natnet_version
        self._refusal = ''
        if not OLDEST_VERSION <= answer.natnet_version <= NEWEST_READ:
            version = natnet.format_version(answer.natnet_version)
            self._refusal = (
                f'natnetclient reads {READS}; the server streams {version}: set client to builtin'
            )
        return not self._refusal

    def _follow(self, client: Any) -> None:
        """Receive frames, and hand on the readings on which both decoders agree.

        Returns when the client is stopped, after `silence_s` without a frame, and after
        `FAILURES_IN_A_ROW` frames in a row that natnetclient cannot read.
        """
        self._name_assets({name: body.id for name, body in client.rigid_bodies.items()})
        source = client.data_sock._sock
        source.settimeout(POLL_S)
        failures = 0
        last_frame_s = time.monotonic()
        while not self._stopping.is_set() and failures < FAILURES_IN_A_ROW:
            if self._release_silent_source() or (
                time.monotonic() - last_frame_s > self._settings.silence_s
            ):
                return
            try:
                datagram, sender = source.recvfrom(1 << 16)
            except TimeoutError:
                continue
            received_s = self._clock()
            if self._is_foreign(sender[0]) or self._is_refused(sender):
                continue
            try:
                frame = natnet.decode_message(datagram, self._status.version)
                if not isinstance(frame, Frame):
                    raise ProtocolError('a message on the data port that is no frame')
            except ProtocolError as error:
                self._note_malformed(error)
                continue
            last_frame_s = time.monotonic()
            samples = self._take_whole_frame(frame, received_s, sender)
            if sender != self._lock.source:
                continue
            theirs = _read(client, datagram)
            failures = failures + 1 if theirs is None else 0
            for sample in samples:
                self._compare(sample, theirs)

    def _compare(self, sample: MarkerSample, markers: tuple[LabeledMarker, ...] | None) -> None:
        """Hand a reading on if natnetclient has read the same marker position, with no flag set.

        A flag: occluded, model-filled or the like. Otherwise the reading is withdrawn
        (`Dropped.DISAGREEMENT`). ``markers``: those that natnetclient has read from the
        datagram, None if it failed.
        """
        if markers is not None and any(
            marker.position == tuple(sample.position) and not marker.params
            for marker in markers
            if self._status.marker_id in (None, marker.id)
        ):
            self._hand_on(sample)
        else:
            self._gate.disown(Dropped.DISAGREEMENT)


def _quiet_client() -> Any:
    """Client class of natnetclient without its thread and its first wait of a minute.

    Raises InputError if natnetclient is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', SyntaxWarning)
            from natnetclient import NatClient
    except ImportError as error:
        raise InputError(
            'client: natnetclient is not installed: pip install natnetclient, or set client to '
            'builtin'
        ) from error

    class QuietClient(NatClient):  # type: ignore[misc]
        def _continuous_get_data(self, sleep_time: float) -> None:
            """Do not read in the background."""

        def get_data(self) -> None:
            """Do not wait for a frame while connecting."""

        def parse(self, datagram: bytes) -> None:
            """Read one datagram as if it had just arrived."""
            packet = _Packet(datagram)
            self.data_sock.recv = lambda: packet
            super().get_data()

    return QuietClient


class _Packet:
    """Received datagram in the form that natnetclient expects from its socket."""

    def __init__(self, datagram: bytes) -> None:
        self._packet = datagram


def _read(client: Any, datagram: bytes) -> tuple[LabeledMarker, ...] | None:
    """Labelled markers of a datagram by natnetclient, or None if it fails in any way."""
    client.labeled_markers.clear()
    try:
        client.parse(datagram)
        return tuple(
            LabeledMarker(
                label,
                tuple(marker.position),
                marker.size,
                OCCLUDED * bool(marker.occluded) | MODEL_FILLED * bool(marker.model_solved),
            )
            for label, marker in client.labeled_markers.items()
        )
    except Exception:  # a fault of natnetclient must not end the thread
        return None


def _close_sockets(client: Any) -> None:
    """Close both sockets of natnetclient's client; missing sockets and errors are ignored."""
    for name in ('comm_sock', 'data_sock'):
        with contextlib.suppress(AttributeError, OSError):
            getattr(client, name)._sock.close()
