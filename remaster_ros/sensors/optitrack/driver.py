# SPDX-License-Identifier: Apache-2.0
"""OptiTrack bar as the sensor of a node: measured positions of the markers of a rigid body.

Occluded, model-filled and otherwise unmeasured frames never become a reading; they are counted
with their reason in the state, which also states the fault if no readings come.
"""

from __future__ import annotations

import queue
from dataclasses import dataclass, replace

from remaster_ros.parameters import parameter
from remaster_ros.sensors.clock_offset import ClockMapping
from remaster_ros.sensors.driver import SensorClock, SensorParameters, SensorState, StreamDriver
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.frame_gate import MarkerChoice, MarkerSample
from remaster_ros.sensors.optitrack.marker_follower import warning
from remaster_ros.sensors.optitrack.natnetclient_backend import READS, NatNetClientBackend
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.types import MarkerReading

WAIT_S = 0.05
"""Longest wait for a reading, s: a simulated world waits for this node, at most 0.15 s ahead."""


@dataclass(frozen=True)
class Parameters(NatNetSettings, SensorParameters):
    """Parameters of the OptiTrack node."""

    sensor: str = parameter('mocap', "the bar's name among the cell's sensors")
    server: str = parameter('192.168.0.10', 'the computer that runs Motive')
    client: str = parameter(
        'builtin',
        'which NatNet client to use: `builtin` reads NatNet 2.6 to 4.3, multicast and unicast; '
        f'`natnetclient`, the package of PyPI, {READS}',
        choices=('builtin', 'natnetclient'),
    )
    rigid_body: str = parameter('', 'name of the rigid body in Motive; empty for the only one')
    member: int = parameter(
        1,
        'number in that body of the marker that the cell file names first; 0 for a lone marker '
        'without a body',
        low=0,
        high=999,
    )
    marker_id: int = parameter(
        0, 'id of the marker on the wire instead of body and member; 0 for these', low=0
    )


class OptiTrackDriver(StreamDriver):
    """Driver of an OptiTrack bar; its client greets the server from the start until it answers."""

    parameters_type = Parameters
    device = 'OptiTrack'
    several_markers = True

    def __init__(self, parameters: Parameters, clock: SensorClock) -> None:
        p = parameters
        marker = MarkerChoice(
            rigid_body=p.rigid_body,
            member=max(p.member, 1),
            marker_id=p.marker_id or None,
            lone_marker=p.member == 0,
        )
        self._samples: queue.SimpleQueue[MarkerSample] = queue.SimpleQueue()
        self._mapping = ClockMapping(simulated=clock.simulated)
        # Time of capture of the last frame, common to its markers.
        self._frame: tuple[int, float, float] | None = None
        self._captured_s = 0.0
        by_package = p.client == 'natnetclient'
        self._client_name = f'natnetclient ({READS})' if by_package else p.client
        kind = NatNetClientBackend if by_package else NatNetClient
        self.client = kind(replace(p, marker=marker), self._samples.put, clock=clock.now)
        self.client.start()

    def open(self) -> None:
        """Do nothing: the client of the constructor keeps trying by itself."""

    def read(self) -> MarkerReading | None:
        """Next measured position; None without one in `WAIT_S`; see `StreamDriver.read`.

        None also before a simulated clock has begun.
        """
        try:
            sample = self._samples.get(timeout=WAIT_S)
        except queue.Empty:
            return None
        self.received_s = sample.received_s
        if sample.received_s <= 0.0:
            # A simulated clock that has not begun gives no time of capture.
            return None
        frame = (sample.frame_number, sample.timestamp_s, sample.received_s)
        if frame != self._frame:
            self._frame = frame
            self._captured_s = self._mapping.capture_time(
                sample.timestamp_s, sample.age_s, sample.received_s
            )
        return MarkerReading(self._captured_s, sample.position, marker=sample.marker)

    def state(self) -> SensorState:
        """State of the sensor by `MarkerFollower.diagnosis`, with counts of frames.

        Ready without a fault, and with the fault 'marker': frames come, but without a usable
        marker.
        """
        status = self.client.status()
        diagnosis = self.client.diagnosis()
        values = {
            'client': self._client_name,
            'fault': diagnosis.fault,
            'frames': status.frames,
            'lost': status.lost,
            'source': status.source,
            'sources_taken': status.sources_taken,
            'refused_sources': ', '.join([*status.rivals, *status.contestants, *status.foreign]),
            **{f'dropped_{reason}': count for reason, count in status.dropped.items()},
        }
        for name, counts in self.client.further_counts().items():
            values[f'accepted_{name}'] = counts.accepted
            values[f'not_seen_{name}'] = str(counts.last_reason or '')
        odd = warning(status)
        return SensorState(
            ready=diagnosis.fault in ('none', 'marker'),
            trouble=diagnosis.message,
            message=odd or 'ok',
            level='error' if diagnosis.message else 'warn' if odd else 'ok',
            values=values,
        )

    def close(self) -> None:
        """Disconnect from the server."""
        self.client.stop()
