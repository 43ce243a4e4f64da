# SPDX-License-Identifier: Apache-2.0
"""ROS shell of the fake OptiTrack server, whose only connection to the product is NatNet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour
from remaster_ros.simulation.setup import open_world


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the fake OptiTrack server."""

    world: str = parameter('', 'folder of the hidden World; empty for the default one')
    sensor: str = parameter('mocap', "the bar's name in the World")
    version: str = parameter('3.1', 'NatNet bitstream', choices=('2.10', '3.1', '4.1'))
    transport: str = parameter('multicast', 'how frames go out', choices=('multicast', 'unicast'))
    rate: float = parameter(
        30.0, 'frames per second of world time', unit='Hz', low=1.0, high=1000.0
    )
    host: str = parameter('127.0.0.1', 'address to serve on')
    command_port: int = parameter(1510, 'port of the command channel', low=1, high=65535)
    data_port: int = parameter(1511, 'port of multicast data', low=1, high=65535)
    occlusions_per_s: float = parameter(
        0.02, 'how often the marker is hidden, world time', unit='1/s', low=0.0, high=10.0
    )


class FakeOptiTrackNode(RemasterNode):
    """Node that runs a fake OptiTrack server (NatNet) in a simulated world."""

    def __init__(self) -> None:
        super().__init__('fake_optitrack')
        p = declare(self, Parameters)
        self.world = world = open_world(p.world, self.get_namespace())
        major, minor = (int(part) for part in p.version.split('.'))
        self.server = FakeOptiTrackServer(
            world,
            p.sensor,
            np.random.default_rng([world.seed, 3]),
            version=(major, minor),
            transport='unicast' if p.transport == 'unicast' else 'multicast',
            rate_hz=p.rate,
            host=p.host,
            command_port=p.command_port,
            data_port=p.data_port,
            behaviour=OptiTrackBehaviour(
                occlusions_per_s=p.occlusions_per_s,
                further=world.truth.sensors[p.sensor].further,
            ),
        )
        self.server.start()

    def close(self) -> None:
        """Close the server's sockets and the World."""
        self.server.stop()
        self.world.close()


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal or an error ends it; return its exit status."""
    return run(FakeOptiTrackNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
