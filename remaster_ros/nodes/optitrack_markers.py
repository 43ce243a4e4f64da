"""Publish the calibration marker that an OptiTrack bar measures.

Occluded, model-filled and otherwise unmeasured frames never become a point; they are counted with
their reason in /remaster/status, which also says what is wrong when nothing comes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from remaster_ros.errors import DeviceError
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import run
from remaster_ros.nodes.sensor_node import SensorNode, SensorState
from remaster_ros.sensors.clock_offset import ClockMapping
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.diagnosis import NatNetSettings, warning
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.marker_follower import MarkerFollower
from remaster_ros.sensors.optitrack.natnetclient_backend import NatNetClientBackend


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


class OptiTrackMarkers(SensorNode):
    """See the module's text."""

    def __init__(self) -> None:
        super().__init__('optitrack_markers')
        self.p = declare(self, Parameters)
        self.open_sensor(self.p.cell, self.p.sensor)
        simulated = self.get_parameter('use_sim_time').value
        self._clock_mapping = ClockMapping(simulated=bool(simulated))
        self.client = self._make_client()
        self.client.start()
        self.open_status()
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
        captured = self._clock_mapping.capture_time(
            sample.timestamp_s, sample.age_s, sample.received_s
        )
        self.publish_reading(sample.position, captured)

    def state(self) -> SensorState:
        """Return what the frames, and those that do not come, tell."""
        status = self.client.status()
        diagnosis = self.client.diagnosis()
        values = {
            'fault': diagnosis.fault,
            'frames': status.frames,
            'lost': status.lost,
            'source': status.source,
            'sources_taken': status.sources_taken,
            'refused_sources': ', '.join([*status.rivals, *status.contestants, *status.foreign]),
            **{f'dropped_{reason}': count for reason, count in status.dropped.items()},
        }
        odd = warning(status)
        return SensorState(
            ready=diagnosis.fault in ('none', 'marker'),
            trouble=diagnosis.message,
            message=odd or 'ok',
            level='error' if diagnosis.message else 'warn' if odd else 'ok',
            values=values,
        )

    def close(self) -> None:
        """Say goodbye to the server."""
        self.client.stop()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(OptiTrackMarkers, args)


if __name__ == '__main__':
    raise SystemExit(main())
