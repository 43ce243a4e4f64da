# SPDX-License-Identifier: Apache-2.0
"""Settings of an OptiTrack client: address of the server, and choice of the markers."""

from __future__ import annotations

import errno
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from ipaddress import AddressValueError, IPv4Address
from typing import Literal

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.parameters import check_all, parameter
from remaster_ros.sensors.optitrack import natnet
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice
from remaster_ros.sensors.optitrack.natnet_bytes import ProtocolError, Version, require_supported

RECEIVE_BUFFER_BYTES = 1 << 22
"""Receive buffer for a second of 1 kHz frames with 50 markers; Linux limits it by
net.core.rmem_max."""


def resolve(host: str) -> str:
    """IPv4 address of a host; raises DeviceError if the name is unknown."""
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise DeviceError(
            f'server: {host!r} is not known ({error}); give the address that Motive shows under '
            f'"Local Interface"'
        ) from error


def interface_towards(server_ip: str, port: int) -> str:
    """IPv4 address of this machine from which packets reach the server.

    Nothing is sent. Raises DeviceError if there is no route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((server_ip, port))
        except OSError as error:
            raise DeviceError(
                f'server: no route to {server_ip} ({error.strerror}); check the cable and the '
                f'address, or set local_interface'
            ) from error
        return probe.getsockname()[0]


def open_socket(
    address: str, port: int, *, purpose: str, remedy: str, shared: bool = False
) -> socket.socket:
    """Non-blocking UDP socket bound to an address and port.

    ``purpose, remedy``: purpose of the port and parameter to change, for the error message;
    ``shared``: whether other programs may listen on the same port (multicast). Raises DeviceError
    if the socket cannot be opened: the port is in use, the address is not one of this machine, or
    the system refuses for another reason.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if shared:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        opened.bind((address, port))
        opened.setblocking(False)
    except OSError as error:
        opened.close()
        if error.errno == errno.EADDRINUSE:
            reason = (
                f'UDP port {port} ({purpose}) is in use by another program: stop it '
                f'(`ss -ulpn` names it) or {remedy}'
            )
        elif error.errno == errno.EADDRNOTAVAIL:
            reason = (
                f'{address} ({purpose}) is no address of this machine (`ip -4 address` lists '
                f'them): {remedy}'
            )
        else:
            reason = f'UDP {address}:{port} ({purpose}) cannot be opened ({error}): {remedy}'
        raise DeviceError(reason) from error
    return opened


def open_multicast_socket(group: str, port: int, interface: str) -> socket.socket:
    """Data socket of a multicast client, joined to the group on an interface.

    ``interface``: IPv4 address of this machine's card. Linux delivers a group's packets to sockets
    bound to the group's address (or to any), and none to a socket bound to the interface's own
    address. Raises DeviceError if the port is in use, or the interface cannot join the group.
    """
    opened = open_socket(
        group, port, purpose='NatNet data', remedy='set data_port as in Motive', shared=True
    )
    try:
        membership = socket.inet_aton(group) + socket.inet_aton(interface)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError as error:
        opened.close()
        raise DeviceError(
            f'local_interface: {interface} cannot join {group} ({error.strerror}); set '
            f'local_interface to the address of the network card towards the server'
        ) from error
    return opened


def port_is_closed(server_ip: str, port: int, request: bytes) -> bool:
    """Whether the host answers that no program listens on the port.

    False if it answers or is silent for 0.2 s. Only a connected socket reports the "port
    unreachable" of such a host. ``request``: datagram that is sent.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.settimeout(0.2)
        try:
            probe.connect((server_ip, port))
            probe.send(request)
            probe.recv(1)
        except ConnectionRefusedError:
            return True
        except OSError:
            return False
    return False


@dataclass(frozen=True)
class NatNetSettings:
    """Settings of a client; those made with `parameter` are parameters of the node as well.

    Group and data port matter for multicast only (the data port for ``client: natnetclient`` too).
    A `bitstream` can be requested from servers of 4.0 or newer, in unicast. Raises InputError,
    with the name of the setting, for a value that cannot work.
    """

    server: str = parameter('127.0.0.1', 'the computer that runs Motive')
    local_interface: str = parameter(
        '', "this computer's network card towards it; empty lets the routing decide"
    )
    transport: Literal['multicast', 'unicast'] = parameter(
        'multicast', 'as set in Motive', choices=('multicast', 'unicast')
    )
    multicast_group: str = parameter(natnet.DEFAULT_MULTICAST_GROUP, 'as set in Motive')
    command_port: int = parameter(
        natnet.DEFAULT_COMMAND_PORT, 'as set in Motive', low=1, high=65535
    )
    data_port: int = parameter(natnet.DEFAULT_DATA_PORT, 'as set in Motive', low=1, high=65535)
    bitstream: str = parameter('', "NatNet version to ask for; empty takes the server's own")
    marker: MarkerChoice = field(default_factory=MarkerChoice)  # Marker that the client follows
    # Further markers of the same rigid body: name -> number in the body
    further_markers: Mapping[str, int] = field(default_factory=dict)
    # Time without a frame after which the stream counts as stopped, s (wall clock)
    silence_s: float = 1.0

    def __post_init__(self) -> None:
        """Raises InputError for values that can never work."""
        check_all('OptiTrack', self)
        require_group(self.multicast_group)
        if not self.silence_s > 0:
            raise InputError(f'silence_s: {self.silence_s} is not above 0')
        if self.bitstream:
            if self.transport == 'multicast':
                raise InputError(
                    'bitstream: a multicast stream has one version for all; remove it'
                )
            try:
                require_supported(natnet.parse_version(self.bitstream))
            except (ValueError, ProtocolError) as error:
                raise InputError(f'bitstream: {error}') from error

    def choices(self) -> dict[str, MarkerChoice]:
        """Choices of the followed markers: that of `marker` as '', and the further ones by name.

        Raises InputError if two of them are the same marker, or a lone marker is combined with
        others.
        """
        first = self.marker
        found = {'': first}
        used = {
            first.member if first.marker_id is None else first.marker_id & 0xFFFF: 'its marker'
        }
        for name, member in self.further_markers.items():
            if first.lone_marker:
                raise InputError(
                    f'member: a lone marker belongs to no rigid body, but the cell file has '
                    f'{name} beside it; set member to its number in the body'
                )
            if member in used:
                raise InputError(
                    f'member: {name} of further_markers in the cell file has the number {member}, '
                    f'which is that of {used[member]}; give every marker its own'
                )
            used[member] = name
            asset = None if first.marker_id is None else first.marker_id >> 16 << 16
            marker_id = None if asset is None else asset | member
            found[name] = replace(first, member=member, marker_id=marker_id)
        return found

    @property
    def wanted_version(self) -> Version | None:
        """Bitstream to request, None for the server's own."""
        return natnet.parse_version(self.bitstream) if self.bitstream else None


def require_group(group: str) -> None:
    """Raise InputError unless the text is an IPv4 multicast group."""
    try:
        is_group = IPv4Address(group).is_multicast
    except AddressValueError:
        is_group = False
    if not is_group:
        raise InputError(
            f'multicast_group: {group!r} is none (224.0.0.0 to 239.255.255.255; Motive uses '
            f'{natnet.DEFAULT_MULTICAST_GROUP})'
        )
