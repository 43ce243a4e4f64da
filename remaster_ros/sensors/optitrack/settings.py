"""How to reach an OptiTrack server, and which marker to follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from ipaddress import AddressValueError, IPv4Address
from typing import Literal

from remaster_ros.errors import InputError
from remaster_ros.parameters import check_all, parameter
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice
from remaster_ros.sensors.optitrack.protocol import natnet
from remaster_ros.sensors.optitrack.protocol.wire import (
    ProtocolError,
    Version,
    require_supported,
)


@dataclass(frozen=True)
class NatNetSettings:
    """Settings of a client; those made with `parameter` are parameters of the node as well.

    Group and data port matter for multicast only (the data port for ``client: natnetclient``
    too). A `bitstream` can be requested from servers of 4.0 or newer, in unicast.

    Attributes
    ----------
    marker
        Which marker to follow.
    further_markers
        Further markers of the same rigid body to follow: their numbers in it by name.
    silence_s
        Without a frame for this long the stream counts as stopped, s (wall clock).

    Raises
    ------
    InputError
        Naming the setting that cannot work.
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
    marker: MarkerChoice = field(default_factory=MarkerChoice)
    further_markers: Mapping[str, int] = field(default_factory=dict)
    silence_s: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what can never work."""
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
        """Return which markers to follow: that of `marker` as '', and the further ones by name.

        Raises
        ------
        InputError
            Two of them are the same marker, or a lone marker has none beside it.
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
        """The bitstream to request, None for the server's own."""
        return natnet.parse_version(self.bitstream) if self.bitstream else None


def require_group(group: str) -> None:
    """Raise `InputError` unless it is an IPv4 multicast group."""
    try:
        is_group = IPv4Address(group).is_multicast
    except AddressValueError:
        is_group = False
    if not is_group:
        raise InputError(
            f'multicast_group: {group!r} is none (224.0.0.0 to 239.255.255.255; Motive uses '
            f'{natnet.DEFAULT_MULTICAST_GROUP})'
        )
