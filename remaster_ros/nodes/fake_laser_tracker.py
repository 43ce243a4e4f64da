# SPDX-License-Identifier: Apache-2.0
"""ROS shell of the fake laser tracker, whose only connection to the product is emScon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.simulation.laser_tracker import FakeLaserTracker
from remaster_ros.simulation.laser_tracker_behaviour import TrackerBehaviour
from remaster_ros.simulation.setup import open_world


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the fake laser tracker."""

    world: str = parameter('', 'folder of the hidden World; empty for the default one')
    sensor: str = parameter('tracker', "the tracker's name in the World")
    host: str = parameter('127.0.0.1', 'address to serve on')
    port: int = parameter(700, 'TCP port', low=1, high=65535)
    warm_up_s: float = parameter(
        5.0, 'from switching on to ready, world time', unit='s', low=0.0, high=1e5
    )


class FakeLaserTrackerNode(RemasterNode):
    """Node that runs a fake laser tracker (an emScon server) in a simulated world."""

    def __init__(self) -> None:
        super().__init__('fake_laser_tracker')
        p = declare(self, Parameters)
        self.world = world = open_world(p.world, self.get_namespace())
        self.tracker = FakeLaserTracker(
            world,
            p.sensor,
            np.random.default_rng([world.seed, 4]),
            host=p.host,
            port=p.port,
            behaviour=TrackerBehaviour(warm_up_s=p.warm_up_s),
            further=world.truth.sensors[p.sensor].further
            if p.sensor in world.truth.sensors
            else {},
        )
        self.tracker.start()

    def close(self) -> None:
        """Close the tracker's sockets and the World."""
        self.tracker.close()
        self.world.close()


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run(FakeLaserTrackerNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
