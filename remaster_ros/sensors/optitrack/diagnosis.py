"""What is wrong when marker readings are missing, and what to do; pure, no sockets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from remaster_ros.sensors.optitrack.frame_gate import Dropped, GateCounts
from remaster_ros.sensors.optitrack.protocol import natnet
from remaster_ros.sensors.optitrack.protocol.natnet import ProtocolError, ServerInfo, Version
from remaster_ros.sensors.optitrack.protocol.wire import require_supported
from remaster_ros.sensors.optitrack.settings import NatNetSettings

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


@dataclass(kw_only=True)
class StreamStatus(GateCounts):
    """The state of a client; its gate counts in it.

    Attributes
    ----------
    server_ip, interface
        Resolved addresses of the server and of this machine's card towards it.
    server
        Its answer to CONNECT; None while there is none.
    version
        Bitstream in use; None while unknown.
    port_closed
        The computer is there, but nothing listens on the command port.
    send_error
        Why the last request could not be sent; ''.
    foreign
        Addresses that sent something and are not the server (the first few).
    last_malformed
        What was wrong with the last datagram that could not be decoded; ''.
    silent_s
        Time since the last whole frame, s; None if there was none.
    starved_s
        Time since the last reading, s; None if there was none.
    source
        Address and port whose frames are believed; '' while there is none.
    sources_taken
        How often it was decided whose frames are believed.
    rivals
        Other ports of the server's address that sent lately, beside the believed one; refused.
    contestants
        Sources of which none is believed, as they send at the same time.
    """

    server_ip: str = ''
    interface: str = ''
    server: ServerInfo | None = None
    version: Version | None = None
    port_closed: bool = False
    send_error: str = ''
    foreign: tuple[str, ...] = ()
    last_malformed: str = ''
    silent_s: float | None = None
    starved_s: float | None = None
    source: str = ''
    sources_taken: int = 0
    rivals: tuple[str, ...] = ()
    contestants: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong: its kind, and one line with the remedy."""

    fault: Fault
    message: str


HEALTHY = Diagnosis('none', '')


def diagnose(status: StreamStatus, settings: NatNetSettings) -> Diagnosis:
    """Return why readings are missing; `HEALTHY` if they are not."""
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
    """Explain a server that answers but whose frames do not arrive (any more)."""
    multicast = settings.transport == 'multicast'
    told = server.connection
    if told is not None and told.is_multicast != multicast:
        theirs = 'multicast' if told.is_multicast else 'unicast'
        return Diagnosis(
            'multicast',
            f'the server streams {theirs}: set transport to {theirs}, or change Motive',
        )
    if told is not None and multicast and told.multicast_group != settings.multicast_group:
        return Diagnosis(
            'multicast',
            f'the server streams to the group {told.multicast_group}, not to '
            f'{settings.multicast_group}: set multicast_group',
        )
    if told is not None and multicast and told.data_port != settings.data_port:
        return Diagnosis(
            'port',
            f'the server streams to UDP port {told.data_port}, not to {settings.data_port}: '
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
    return (
        f'NatNet data come from {", ".join(status.foreign)}, not from {status.server_ip}: set '
        f'server to the one that is meant, or stop the other'
    )


def _contest(status: StreamStatus) -> str:
    return (
        f'frames come from {" and ".join(status.contestants)} at the same time, and none is '
        f'believed, as nothing tells which of them Motive sends: stop the other program'
    )


def _refused(status: StreamStatus) -> str:
    return (
        f'frames come only from {", ".join(status.rivals)}, which sent beside the believed source '
        f'and is refused: stop it; if it is Motive, restart its streaming'
    )


def warning(status: StreamStatus) -> str:
    """Return which other programs send while readings come; '' if none does."""
    others = [*status.rivals, *status.foreign]
    if not others or not status.source:
        return ''
    return (
        f'frames also come from {", ".join(others)} and are refused; those of {status.source} '
        f'are believed: stop the other program'
    )


def _no_marker(status: StreamStatus) -> Diagnosis:
    """Explain whole frames without a usable marker."""
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
    """Write an id as asset:member."""
    return f'{marker_id >> 16}:{marker_id & 0xFFFF}'
