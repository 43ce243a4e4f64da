"""Publish the calibration marker that an OptiTrack bar measures.

Occluded, model-filled and otherwise unmeasured frames never become a point; they are counted with
their reason in /remaster/status, which also says what is wrong when nothing comes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PointStamped

from remaster_ros.errors import DeviceError, InputError
from remaster_ros.nodes.messages import stamp_of
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import RELIABLE, NodeStatus
from remaster_ros.sensors.clock_offset import ClockMapping
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.diagnosis import NatNetSettings, warning
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.marker_follower import MarkerFollower
from remaster_ros.sensors.optitrack.natnetclient_backend import NatNetClientBackend
from remaster_ros.session.workcell import read_cell


@dataclass(frozen=True)
class Parameters:
    """Parameters of the OptiTrack node."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    sensor: str = parameter('mocap', "the bar's name among the cell's sensors")
    client: str = parameter(
        'builtin', 'which NatNet client to use', choices=('builtin', 'natnetclient')
    )
    server: str = parameter('192.168.0.10', 'the computer that runs Motive')
    local_interface: str = parameter(
        '', "this computer's network card towards it; empty lets the routing decide"
    )
    transport: str = parameter('multicast', 'as set in Motive', choices=('multicast', 'unicast'))
    multicast_group: str = parameter('239.255.42.99', 'as set in Motive')
    command_port: int = parameter(1510, 'as set in Motive', low=1, high=65535)
    data_port: int = parameter(1511, 'as set in Motive', low=1, high=65535)
    bitstream: str = parameter('', "NatNet version to ask for; empty takes the server's own")
    rigid_body: str = parameter('', 'name of the rigid body in Motive; empty for the only one')
    member: int = parameter(
        1, 'number of the marker in that body; 0 for a lone marker without a body', low=0, high=999
    )
    marker_id: int = parameter(
        0, 'id of the marker on the wire instead of body and member; 0 for these', low=0
    )
    start_timeout_s: float = parameter(
        20.0, 'how long to wait for the first reading, wall time', unit='s', low=0.1, high=3600.0
    )


class OptiTrackMarkers(RemasterNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('optitrack_markers')
        self.p = declare(self, Parameters)
        cell = read_cell(self.p.cell)
        if self.p.sensor not in cell.sensors:
            raise InputError(
                f'optitrack_markers: parameter sensor is {self.p.sensor!r}; '
                f'the cell has {", ".join(cell.sensors)}'
            )
        simulated = self.get_parameter('use_sim_time').value
        self._clock_mapping = ClockMapping(simulated=bool(simulated))
        self._publisher = self.create_publisher(
            PointStamped, cell.sensors[self.p.sensor].topic, RELIABLE
        )
        self.published = 0
        self.client = self._make_client()
        self.client.start()
        self.status = NodeStatus(self, self._summary)
        self._started_s = time.monotonic()
        self._timer = self.create_timer(0.5, self._check_start, clock=self.status.steady)

    def _make_client(self) -> MarkerFollower:
        lone = self.p.member == 0
        marker = MarkerChoice(
            rigid_body=self.p.rigid_body,
            member=max(self.p.member, 1),
            marker_id=self.p.marker_id or None,
            lone_marker=lone,
        )
        settings = NatNetSettings(
            server=self.p.server,
            local_interface=self.p.local_interface,
            transport='unicast' if self.p.transport == 'unicast' else 'multicast',
            multicast_group=self.p.multicast_group,
            command_port=self.p.command_port,
            data_port=self.p.data_port,
            bitstream=self.p.bitstream,
            marker=marker,
        )
        client = NatNetClientBackend if self.p.client == 'natnetclient' else NatNetClient
        return client(settings, self._publish, clock=self.now_s)

    def _check_start(self) -> None:
        """End the process with the diagnosis if nothing ever came."""
        if self.published:
            self._timer.cancel()
        elif time.monotonic() - self._started_s > self.p.start_timeout_s:
            message = self.client.diagnosis().message or 'no reading of the marker'
            self.failure = DeviceError(f'OptiTrack: {message}')

    def _publish(self, sample: MarkerSample) -> None:
        """Publish a reading with its time of capture; called in the client's thread."""
        if sample.received_s <= 0.0:
            # A simulated clock that has not been heard yet: nobody can say when this was.
            return
        message = PointStamped()
        captured = self._clock_mapping.capture_time(
            sample.timestamp_s, sample.age_s, sample.received_s
        )
        message.header.stamp = stamp_of(captured)
        message.header.frame_id = self.p.sensor
        message.point.x, message.point.y, message.point.z = map(float, sample.position)
        self._publisher.publish(message)
        self.published += 1

    def _summary(self) -> tuple[str, str, dict[str, Any]]:
        status = self.client.status()
        diagnosis = self.client.diagnosis()
        trouble = self.clock_trouble or diagnosis.message
        # A hidden marker is no reason to stop the arm: moving on shows it again.
        ready = diagnosis.fault in ('none', 'marker') and not self.clock_trouble
        values = {
            'sensor': self.p.sensor,
            'ready': 'yes' if ready else 'no',
            'fault': diagnosis.fault,
            'trouble': trouble,
            'frames': status.frames,
            'published': self.published,
            'lost': status.lost,
            'source': status.source,
            'sources_taken': status.sources_taken,
            'refused_sources': ', '.join([*status.rivals, *status.contestants, *status.foreign]),
            **{f'dropped_{reason}': count for reason, count in status.dropped.items()},
        }
        odd = warning(status)
        level = 'error' if trouble else 'warn' if odd else 'ok'
        return level, trouble or odd or 'ok', values

    def close(self) -> None:
        """Say goodbye to the server."""
        self.client.stop()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(OptiTrackMarkers, args)


if __name__ == '__main__':
    raise SystemExit(main())
