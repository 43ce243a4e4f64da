# SPDX-License-Identifier: Apache-2.0
"""Common part of both OptiTrack clients: the thread, the markers, counts and diagnosis."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.frame_gate import Dropped, GateCounts, MarkerGate, MarkerSample
from remaster_ros.sensors.optitrack.natnet import ServerInfo, encode_echo_request
from remaster_ros.sensors.optitrack.natnet_bytes import ProtocolError, Version, require_supported
from remaster_ros.sensors.optitrack.natnet_frame import Frame
from remaster_ros.sensors.optitrack.settings import (
    NatNetSettings,
    interface_towards,
    port_is_closed,
    resolve,
)
from remaster_ros.sensors.optitrack.source_lock import Source, SourceLock, SourceVerdict, describe

Fault = Literal[
    'none',
    'address',
    'interface',
    'multicast',
    'port',
    'version',
    'rigid_body',
    'marker',
    'silence',
]
FOREIGN_REMEMBERED = 4
_log = logging.getLogger('remaster_ros')


@dataclass(kw_only=True)
class StreamStatus(GateCounts):
    """State of a client, with the counts of its gate."""

    # Resolved addresses of the server and of this machine's card towards it
    server_ip: str = ''
    interface: str = ''
    server: ServerInfo | None = None  # Answer to CONNECT; None while there is none
    version: Version | None = None  # Bitstream in use; None while unknown
    port_closed: bool = False  # Whether the computer answers that no program listens on the port
    send_error: str = ''  # Reason why the last request could not be sent; '' if it was sent
    # Addresses that sent something and are not the server (the first few)
    foreign: tuple[str, ...] = ()
    last_malformed: str = ''  # Error of the last datagram that could not be decoded; '' if none
    silent_s: float | None = None  # Time since the last whole frame, s; None if there was none
    starved_s: float | None = None  # Time since the last reading, s; None if there was none
    source: str = ''  # Address and port whose frames are believed; '' while there is none
    sources_taken: int = 0  # Number of decisions which source is believed
    # Other ports of the server's address that sent lately, at the same time; refused
    rivals: tuple[str, ...] = ()
    # Sources of which none is believed, because they send at the same time
    contestants: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """Fault: its kind, and one line with the remedy."""

    fault: Fault
    message: str


HEALTHY = Diagnosis('none', '')


def diagnose(status: StreamStatus, settings: NatNetSettings) -> Diagnosis:
    """Reason why readings are missing, with the remedy; `HEALTHY` if they are not.

    In this order: no answer, version, several sources, no frames for `silence_s`, no such rigid
    body, no reading for `silence_s`.
    """
    if status.server is None:
        return _unanswered(status, settings)
    version = status.version or status.server.natnet_version
    try:
        require_supported(version)
    except ProtocolError as error:
        return Diagnosis(
            'version',
            f'the server at {status.server_ip} streams a bitstream that cannot be read: {error}; '
            f'change it in Motive, or in unicast set bitstream to 4.1',
        )
    if status.contestants:
        return Diagnosis('address', _contest(status))
    if status.silent_s is None or status.silent_s > settings.silence_s:
        return _no_frames(status, settings, status.server, version)
    if status.problem:
        return Diagnosis('rigid_body', status.problem)
    if status.starved_s is None or status.starved_s > settings.silence_s:
        return _no_marker(status)
    return HEALTHY


def _unanswered(status: StreamStatus, settings: NatNetSettings) -> Diagnosis:
    """Diagnosis of a server that did not answer: interface, port or address, with the remedy."""
    where = f'{settings.server}:{settings.command_port}'
    if status.send_error:
        return Diagnosis(
            'interface',
            f'nothing can be sent to {where} from {status.interface} ({status.send_error}): '
            f'check the cable, and local_interface',
        )
    if status.port_closed:
        return Diagnosis(
            'port',
            f'{status.server_ip} is there, but nothing listens on UDP port '
            f'{settings.command_port}: start Motive and its streaming, or set command_port',
        )
    if status.foreign:
        return Diagnosis('address', _foreign(status))
    return Diagnosis(
        'address',
        f'no answer from {where} (UDP, from {status.interface}): is this the address of the '
        f'computer with Motive, is it on, and does its firewall let UDP through?',
    )


def _no_frames(
    status: StreamStatus, settings: NatNetSettings, server: ServerInfo, version: Version
) -> Diagnosis:
    """Diagnosis of a server that answers but whose frames do not arrive (any more).

    In this order: transport, group, port, version, other sources, silence, network card.
    """
    multicast = settings.transport == 'multicast'
    connection = server.connection
    if connection is not None and connection.is_multicast != multicast:
        theirs = 'multicast' if connection.is_multicast else 'unicast'
        return Diagnosis(
            'multicast',
            f'the server streams {theirs}: set transport to {theirs}, or change Motive',
        )
    if (
        connection is not None
        and multicast
        and connection.multicast_group != settings.multicast_group
    ):
        return Diagnosis(
            'multicast',
            f'the server streams to the group {connection.multicast_group}, not to '
            f'{settings.multicast_group}: set multicast_group',
        )
    if connection is not None and multicast and connection.data_port != settings.data_port:
        return Diagnosis(
            'port',
            f'the server streams to UDP port {connection.data_port}, not to {settings.data_port}: '
            f'set data_port',
        )
    if status.last_malformed:
        return Diagnosis(
            'version',
            f'frames arrive but are not NatNet {natnet.format_version(version)} '
            f'({status.last_malformed}): restart streaming in Motive',
        )
    if status.foreign:
        return Diagnosis('address', _foreign(status))
    if status.rivals:
        return Diagnosis('address', _refused(status))
    if status.silent_s is not None:
        return Diagnosis(
            'silence',
            f'no frame for {status.silent_s:.1f} s: is Motive still in Live mode and streaming, '
            f'is the cable in?',
        )
    if multicast:
        return Diagnosis(
            'interface',
            f'the server answers, but no frame comes from {settings.multicast_group}:'
            f'{settings.data_port} on {status.interface}: is local_interface the card towards '
            f'the server, does Motive stream multicast on that network, do firewall and switch '
            f'(IGMP) let it through?',
        )
    return Diagnosis(
        'silence',
        'the server answers, but sends no frames to this computer: switch on streaming in '
        'Motive and set it to unicast',
    )


def _foreign(status: StreamStatus) -> str:
    """Sentence that data come from the servers `status.foreign`, which must not be empty."""
    return (
        f'NatNet data come from {", ".join(status.foreign)}, not from {status.server_ip}: set '
        f'server to the one that is meant, or stop the other'
    )


def _contest(status: StreamStatus) -> str:
    """Text on several sources that send frames, of which none is believed, with the remedy."""
    return (
        f'frames come from {" and ".join(status.contestants)} at the same time, and none is '
        f'believed, as nothing tells which of them Motive sends: stop the other program'
    )


def _refused(status: StreamStatus) -> str:
    """Text on frames that come from refused sources only, with the remedy."""
    return (
        f'frames come only from {", ".join(status.rivals)}, which sent beside the believed source '
        f'and is refused: stop it; if it is Motive, restart its streaming'
    )


def warning(status: StreamStatus) -> str:
    """Text on other programs that send frames while readings come; '' if none does."""
    senders = [*status.rivals, *status.foreign]
    if not senders or not status.source:
        return ''
    return (
        f'frames also come from {", ".join(senders)} and are refused; those of {status.source} '
        f'are believed: stop the other program'
    )


def _no_marker(status: StreamStatus) -> Diagnosis:
    """Diagnosis of whole frames without a usable marker, by the last reason of the gate."""
    name = 'the marker' if status.marker_id is None else f'marker {_label(status.marker_id)}'
    reason = status.last_reason
    if reason == Dropped.NOT_PRESENT:
        seen = ', '.join(map(_label, status.labels)) or 'none'
        text = f'{name} is not in the frames (labelled are: {seen}): check rigid_body and member'
        return Diagnosis('rigid_body' if status.marker_id is not None else 'marker', text)
    if reason == Dropped.NOT_LIVE:
        return Diagnosis('silence', 'Motive plays a recording: switch it to Live mode')
    if reason == Dropped.FROZEN:
        text = f'{name} is at the same place to the last bit in every frame: restart streaming'
        return Diagnosis('silence', f'{text} in Motive')
    texts = {
        Dropped.OCCLUDED: f'{name} is hidden from the cameras',
        Dropped.MODEL_FILLED: f'{name} is hidden from the cameras; Motive guesses where it is',
        Dropped.AMBIGUOUS: f'{name} is not the only one in view: remove or mask reflections',
        Dropped.UNLABELLED: f'{name} belongs to no rigid body: check marker_id',
        Dropped.JUMP: f'{name} jumps about: look for reflections that are taken for it',
        Dropped.IMPLAUSIBLE: f'{name} is nowhere that a bar sees, or its stamps are not of one '
        f'clock: restart streaming in Motive',
        Dropped.STALE: 'the time of the frames stands still: restart streaming in Motive',
        Dropped.DISAGREEMENT: f'the two decoders disagree about {name}: set client to builtin',
        Dropped.DUPLICATE: 'the same frame comes again and again: restart streaming in Motive',
    }
    return Diagnosis('marker', texts.get(reason, f'{name} has not been seen yet'))  # type: ignore[arg-type]


def _label(marker_id: int) -> str:
    """Marker id as text ``asset:member``, the numbers in its upper and its lower 16 bits."""
    return f'{marker_id >> 16}:{marker_id & 0xFFFF}'


class MarkerFollower(ABC):
    """Client that follows the markers of one rigid body of an OptiTrack server, in its own thread.

    Each marker is judged separately: one that is hidden, model-filled or jumps is NaN in a frame
    with other visible markers. If none is visible there is no reading at all.

    ``settings``: address of the server, and choice of the markers; ``on_sample``: called in the
    thread with every reading, those of a frame one after another; its exceptions are logged;
    ``clock``: for the time of arrival of a datagram, s.
    """

    def __init__(
        self,
        settings: NatNetSettings,
        on_sample: Callable[[MarkerSample], object],
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._settings = settings
        self._on_sample = on_sample
        self._clock = clock
        self._status = StreamStatus()
        self._gate = MarkerGate(settings.marker, self._status)
        self._further = {
            name: MarkerGate(choice, GateCounts())
            for name, choice in settings.choices().items()
            if name
        }
        self._lock = SourceLock(settings.silence_s)
        self._believed_before: Source | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._frame_at: float | None = None
        self._sample_at: float | None = None

    def start(self) -> None:
        """Open the sockets and begin; the client keeps trying until `stop`. Returns at once.

        Raises DeviceError if the server's name is unknown, there is no route to it, or a
        socket cannot be opened.
        """
        settings = self._settings
        self._status.server_ip = resolve(settings.server)
        self._status.interface = settings.local_interface or interface_towards(
            self._status.server_ip, settings.command_port
        )
        self._stopping.clear()
        self._open()
        self._thread = threading.Thread(target=self._run, name='natnet', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the sockets; may be repeated."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close()

    def __enter__(self) -> MarkerFollower:
        """Start without waiting."""
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop."""
        self.stop()

    def status(self) -> StreamStatus:
        """Snapshot of the counts and the server's answers, with ages of now; from any thread."""
        now = time.monotonic()
        return replace(
            self._status,
            dropped=dict(self._status.dropped),
            silent_s=None if self._frame_at is None else now - self._frame_at,
            starved_s=None if self._sample_at is None else now - self._sample_at,
            source='' if self._lock.source is None else describe(self._lock.source),
            sources_taken=self._lock.taken,
            rivals=tuple(map(describe, self._lock.rivals(now)[:FOREIGN_REMEMBERED])),
            contestants=tuple(map(describe, self._lock.contestants(now)[:FOREIGN_REMEMBERED])),
        )

    def further_counts(self) -> dict[str, GateCounts]:
        """Counts of each further marker, by name."""
        return {name: gate.counts for name, gate in self._further.items()}

    def diagnosis(self) -> Diagnosis:
        """Fault and remedy if readings are missing now; `HEALTHY` if they are not."""
        return diagnose(self.status(), self._settings)

    @abstractmethod
    def _open(self) -> None:
        """Open the sockets of `_run`; raises `DeviceError`, with nothing left open."""

    @abstractmethod
    def _run(self) -> None:
        """Receive frames and hand on readings until `_stopping` is set; runs in the thread."""

    @abstractmethod
    def _close(self) -> None:
        """Close the sockets that `_open` has opened; may be repeated."""

    def _is_foreign(self, address: str) -> bool:
        """Whether an address is not the server's; if so, count its datagram and remember it.

        The first `FOREIGN_REMEMBERED` addresses are remembered, in the status.
        """
        if address == self._status.server_ip:
            return False
        self._gate.drop(Dropped.FOREIGN)
        if address not in self._status.foreign and len(self._status.foreign) < FOREIGN_REMEMBERED:
            self._status.foreign = (*self._status.foreign, address)
        return True

    def _is_refused(self, source: Source) -> bool:
        """Whether `SourceLock` refuses a source (address, port); if so, count its datagram."""
        if not self._lock.is_refused(source, time.monotonic()):
            return False
        self._gate.drop(Dropped.FOREIGN)
        return True

    def _release_silent_source(self) -> bool:
        """Believe no source any more if the believed one is silent; return whether that was so.

        As `SourceLock.release_if_silent`, with a warning in the log: the server must answer
        before another source is believed.
        """
        holder = self._lock.source
        if holder is None or not self._lock.release_if_silent(time.monotonic()):
            return False
        _log.warning(
            'OptiTrack: no frame from %s for %g s; whose frames are believed is decided anew',
            describe(holder),
            self._settings.silence_s,
        )
        return True

    def _note_closed_port(self) -> None:
        """Set `port_closed` of the status: whether the server's command port has no listener."""
        self._status.port_closed = port_is_closed(
            self._status.server_ip, self._settings.command_port, encode_echo_request(0)
        )

    def _note_malformed(self, what: object) -> None:
        """Count a malformed packet, and keep its fault as text in the status, without logging."""
        self._gate.drop(Dropped.MALFORMED)
        self._status.last_malformed = str(what)

    def _name_assets(self, assets: Mapping[str, int]) -> None:
        """Find the markers' ids among the rigid bodies that the server streams, by name."""
        for gate in (self._gate, *self._further.values()):
            gate.name_assets(assets)

    def _take_whole_frame(
        self, frame: Frame, received_s: float, source: Source
    ) -> list[MarkerSample]:
        """Readings of a completely decoded frame, one for each marker; [] if none is visible.

        A marker that is not visible is NaN if another one is. The frame is counted; one of a
        source that is not believed (yet) has no readings.
        """
        now = time.monotonic()
        before = self._lock.source
        verdict = self._lock.judge(source, now)
        if verdict is SourceVerdict.FOREIGN:
            self._gate.drop(Dropped.FOREIGN)
            return []
        if verdict is SourceVerdict.PROBATION:
            self._gate.pass_over(Dropped.PROBATION)
            return []
        if before is None:
            self._begin_source(source)
        self._status.last_malformed = ''
        self._frame_at = now
        connection = self._status.server.connection if self._status.server is not None else None
        ticks_per_s = connection.clock_frequency if connection is not None else 0
        found = {
            name: gate.admit(frame, received_s, ticks_per_s)
            for name, gate in {'': self._gate, **self._further}.items()
        }
        seen = next(filter(None, found.values()), None)
        if seen is None:
            return []
        # A message for every marker: a listener to several topics then knows by the stamps alone
        # that a frame is complete.
        hidden = replace(seen, position=np.full(3, np.nan))
        return [replace(sample or hidden, marker=name) for name, sample in found.items()]

    def _begin_source(self, source: Source) -> None:
        """Log the source whose frames are believed from now on.

        If it is another one than before, its frames are compared with none of the other.
        """
        before, self._believed_before = self._believed_before, source
        if before is not None and before != source:
            for gate in (self._gate, *self._further.values()):
                gate.begin_source()
            _log.warning(
                'OptiTrack: frames of %s are believed from now on, before it was %s',
                describe(source),
                describe(before),
            )
        else:
            _log.info('OptiTrack: frames of %s are believed', describe(source))

    def _hand_on(self, sample: MarkerSample) -> None:
        """Pass a sample to `_on_sample`, and note the time; log an exception of the callback."""
        self._sample_at = time.monotonic()
        try:
            self._on_sample(sample)
        except Exception:
            _log.exception('a reading of the OptiTrack marker could not be handed on')
