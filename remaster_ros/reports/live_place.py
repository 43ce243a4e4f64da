"""Where the live page is served: address, port, certificate, and the names that it answers to."""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
from dataclasses import dataclass

from remaster_ros.errors import InputError


@dataclass(frozen=True)
class Place:
    """Where the page is served.

    Attributes
    ----------
    address, port
        The IP address to listen on, and the port; 0 for any free one.
    names
        Names of this computer by which a browser may ask besides the address.
    certificate, key
        PEM files for https; an address that other computers reach needs them.
    """

    address: str = '127.0.0.1'
    port: int = 0
    names: tuple[str, ...] = ()
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
