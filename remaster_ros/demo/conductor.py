# SPDX-License-Identifier: Apache-2.0
"""The node of the demo: its parameters, service calls, and the status of the other nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from remaster_ros.collection.events import (
    EventRecord,
    TourPlanned,
)
from remaster_ros.demo.configuration_times import ConfigurationTimes
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.status import listen


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the demo."""

    out: str = parameter(
        '', 'folder of everything the demo writes: new, empty, or of a demo to go on with'
    )
    seed: int = parameter(0, 'seed of the hidden World and of all randomness', low=0)
    cell: str = parameter('demo', 'cell file: a path, or the name of a shipped one')
    candidates: int = parameter(
        14, 'candidate poses for optimization and for validation, each', low=1, high=1000
    )
    held_out_candidates: int = parameter(
        0, 'candidate poses for validation, where not as many; 0 for as many', low=0, high=1000
    )
    reference_every: int = parameter(
        25, 'configurations between two visits to the references; 0 for none', low=0, high=10_000
    )
    rate: float = parameter(
        10.0, 'how many times as fast as the wall clock world time runs', low=1.0, high=20.0
    )
    hide: str = parameter(
        '', 'what else is wrong with the hidden arm: NAME[@JOINT][:SIZE_MM],…, or random'
    )
    dynamics: float = parameter(
        0.0,
        'hidden dynamics of the arm while it moves: 1 for sizes of real machines; reports and '
        'frames then come as fast as those of real devices (for rate 1)',
        low=0.0,
        high=10.0,
    )
    moving_s: float = parameter(
        0.0,
        'seconds of motion that are measured while the arm moves (with dynamics); 0 for stop and '
        'go',
        unit='s',
        low=0.0,
        high=600.0,
    )
    figures: bool = parameter(True, 'write figures and the report')
    apply: bool = parameter(
        False, 'correct the arm by what was found, and measure poses that no fit has seen'
    )
    watch: bool = parameter(False, 'serve the live page, and end with a signal')
    quiet: bool = parameter(False, 'print nothing but errors')


class Conductor(Node):
    """Node that calls the services of the other nodes, and keeps their last status."""

    def __init__(self) -> None:
        super().__init__('demo')
        self.p = declare(self, Parameters)
        self.summaries: dict[str, dict[str, str]] = {}
        self.times = ConfigurationTimes(self.p.rate)
        self.planned = ''
        listen(self, self._on_record, self._on_summary)
        self._clients_by_name: dict[str, Any] = {}

    def _on_summary(self, node: str, message: str, values: dict[str, str]) -> None:
        """Keep the last summary of a node, by its name: its message and values."""
        self.summaries[node] = {'message': message, **values}

    def _on_record(self, record: EventRecord) -> None:
        """Keep the times in a node's event, and the description of a planned tour."""
        if isinstance(record.body, TourPlanned):
            self.planned = record.body.description
        self.times.add(record.body)

    def call(self, service: str) -> Any:
        """Call a std_srvs/Trigger service; return the future of its response.

        None, and no call, if the service is not ready now.
        """
        if service not in self._clients_by_name:
            self._clients_by_name[service] = self.create_client(Trigger, service)
        client = self._clients_by_name[service]
        return client.call_async(Trigger.Request()) if client.service_is_ready() else None
