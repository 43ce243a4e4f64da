"""Parameters of the recorder."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from remaster_ros.collection.pairing import SensorRules
from remaster_ros.parameters import SimulationParameters, parameter
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import Measurements, Session


@dataclass(frozen=True)
class Parameters(SimulationParameters):
    """Parameters of the recorder."""

    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    session: str = parameter(
        'session', 'folder of the session: new, empty, or of an unfinished one, which goes on'
    )
    bag: bool = parameter(True, 'record a rosbag2 (MCAP) of the raw topics into session/bag')
    call_measure: bool = parameter(
        True, 'call the measure service of single-shot sensors; false when a bag is replayed'
    )
    dwell_s: float = parameter(0.5, 'how long a stream is averaged', unit='s', low=0.01, high=60.0)
    min_samples: int = parameter(5, 'fewest samples in the dwell', low=1)
    max_std_m: float = parameter(
        0.5e-3, 'largest standard deviation over the dwell', unit='m', low=1e-6, high=0.1
    )
    motion_tolerance: float = parameter(
        5e-4, 'largest joint movement during a reading', unit='rad', low=1e-7, high=0.01
    )
    stream_timeout_s: float = parameter(
        3.0, 'how long after the dwell a stream may stay out', unit='s', low=0.1, high=600.0
    )
    shot_timeout_s: float = parameter(
        60.0, 'how long after settling a single shot may stay out', unit='s', low=0.1, high=3600.0
    )
    settle_s: float = parameter(
        3.0, 'settle time of the bridge, noted in the session', unit='s', low=0.1, high=60.0
    )
    require: str = parameter(
        'all', "whom the arm waits for at each configuration: all, any, or a sensor's name"
    )
    heartbeat_s: float = parameter(
        3.0, 'longest silence of a sensor node, wall time', unit='s', low=0.5, high=60.0
    )
    max_deviation_m: float = parameter(
        0.05,
        'a reading further than this from where the robot has the marker is of another one',
        unit='m',
        low=1e-3,
        high=5.0,
    )
    reference_stop_m: float = parameter(
        0.5e-3,
        'a change at the reference configurations that is larger than this pauses the collection '
        'until a person has looked; 0 for never',
        unit='m',
        low=0.0,
        high=1.0,
    )


def sensor_rules(cell: Workcell, p: Parameters) -> tuple[SensorRules, ...]:
    """Return how each sensor of the cell is read."""
    return tuple(
        SensorRules(
            sensor=name,
            marker=sensor.marker,
            further=tuple(sensor.further_markers),
            single_shot=sensor.single_shot,
            dwell_s=p.dwell_s,
            min_samples=p.min_samples,
            max_std_m=p.max_std_m,
            timeout_s=p.shot_timeout_s if sensor.single_shot else p.stream_timeout_s,
        )
        for name, sensor in cell.sensors.items()
    )


def session_header(cell: Workcell, settle_s: float) -> Session:
    """Return a session of this cell without observations."""
    chain = cell.chain()
    return Session(
        urdf=cell.urdf_text,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers={name: np.array(position) for name, position in cell.markers.items()},
        sensors={name: sensor.marker for name, sensor in cell.sensors.items()},
        further_markers={
            name: tuple(sensor.further_markers)
            for name, sensor in cell.sensors.items()
            if sensor.further_markers
        },
        oriented=frozenset(name for name, sensor in cell.sensors.items() if sensor.pose_topic),
        measurements=Measurements.empty(len(chain)),
        marker_std_m=cell.marker_std_m,
        settle_s=settle_s,
        created=datetime.now(UTC).isoformat(timespec='seconds'),
    )
