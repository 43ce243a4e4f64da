"""UDP sockets for NatNet, opened so that they receive on Linux, with errors a user can act on."""

from __future__ import annotations

import errno
import socket

from remaster_ros.errors import DeviceError

RECEIVE_BUFFER_BYTES = 1 << 22
"""A second of 1 kHz frames with 50 markers; Linux gives as much as net.core.rmem_max allows."""


def resolve(host: str) -> str:
    """Return the IPv4 address of a host.

    Raises
    ------
    DeviceError
        If the name is unknown.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise DeviceError(
            f'server: {host!r} is not known ({error}); give the address that Motive shows under '
            f'"Local Interface"'
        ) from error


def interface_towards(server_ip: str, port: int) -> str:
    """Return the address of this machine's interface from which packets reach the server.

    Raises
    ------
    DeviceError
        If there is no route.
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
    """Open a non-blocking UDP socket bound to an address and port.

    Parameters
    ----------
    purpose, remedy
        For the error message: what the port is for, and which parameter to change.
    shared
        Whether other programs may listen on the same port (multicast).

    Raises
    ------
    DeviceError
        If the port is in use, or the address is not one of this machine.
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
    """Open the data socket of a multicast client.

    Linux delivers a group's packets to sockets bound to the group's address (or to any), and
    none to a socket bound to the interface's own address.

    Raises
    ------
    DeviceError
        If the port is in use, or the interface cannot join the group.
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
    """Return whether the host is there but nothing listens on the port.

    Only a connected socket reports the "port unreachable" that such a host sends back.
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
