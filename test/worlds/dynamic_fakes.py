# SPDX-License-Identifier: Apache-2.0
"""The fakes of an arm with hidden dynamics, played as fast as they can be and recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from remaster_ros.importing.moving import MarkerStream, MovingOptions, moving_session
from remaster_ros.importing.standstills import Stream
from remaster_ros.sensors.optitrack.natnet_frame import MEASURED
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.arm_motion import ServoPoint
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour, OptiTrackScene
from remaster_ros.simulation.robot import FakeArm
from remaster_ros.simulation.setup import make_world
from remaster_ros.simulation.world import START_S, World
from remaster_ros.types import FloatArray, Session

CELL = read_cell('quick')
REACH = np.array([0.5, 0.4, 0.5, 0.4, 0.6, 0.5, 0.8])
"""Of a joint to either side of where the fake arm begins, where its tool faces the bar, rad."""


class SteppedWorld(World):
    """A World whose time the test sets."""

    time_s = START_S

    def now(self) -> float:
        return self.time_s


@dataclass(frozen=True, eq=False)
class Played:
    """What the fakes said of a motion; the truth is the world's."""

    world: SteppedWorld
    joints: Stream  # Reported positions by their stamps, rad, (n, k)
    # Frames by the times at which they arrived, and what their own clock says, s, (f,)
    arrived_s: FloatArray
    clock_s: FloatArray
    points: FloatArray  # In the sensor's frame, m, (f, markers, 3)

    def session(self, seed: int) -> Session:
        """Return the moving session of what arrived, stamped as `optitrack_markers` does."""
        offset_s = float(np.min(self.arrived_s - self.clock_s))
        names = self.world.truth.sensors['mocap'].markers
        stamps = self.clock_s + offset_s
        streams = [
            MarkerStream('mocap', name, Stream.of(stamps, self.points[:, i]))
            for i, name in enumerate(names)
        ]
        places = {name: np.array(CELL.markers[name]) for name in names}
        return moving_session(
            'played',
            self.joints,
            streams,
            self.world.chain,
            CELL.urdf_text,
            MovingOptions(places=places),
            np.random.default_rng(seed),
        )[0]


def play(
    folder: Path,
    seed: int,
    seconds: float,
    *,
    scale: float = 1.0,
    rest_s: float = 0.0,
    joints_hz: float = 125.0,
    frames_hz: float = 60.0,
) -> Played:
    """Move a fake arm between random configurations, with a rest at each, and record the fakes."""
    made = make_world(folder, CELL, seed, 1.0, dynamics=scale)
    made.close()
    world, rng = SteppedWorld.open(folder), np.random.default_rng(seed)
    arm = FakeArm(world, np.random.default_rng([seed, 2]))
    behaviour = OptiTrackBehaviour(further=world.truth.sensors['mocap'].further, strays=())
    scene = OptiTrackScene(world, 'mocap', np.random.default_rng([seed, 3]), behaviour)
    k, members = len(world.chain), len(world.truth.sensors['mocap'].markers)
    joints: list[tuple[float, FloatArray]] = []
    frames: list[tuple[float, float, FloatArray]] = []
    number, due = 0, [(0.0, 'move'), (0.0, 'joints'), (0.0, 'frame')]
    while True:
        since, what = min(due)
        due.remove((since, what))
        if since > seconds:
            break
        world.time_s = START_S + since
        if what == 'move':
            goal = world.start_q + REACH[:k] * rng.uniform(-1.0, 1.0, k)
            takes = 1.0 + 1.5 * float(np.max(np.abs(goal - world.reported(world.time_s)[0])))
            dropped = arm.command(world.chain.joint_names, [ServoPoint(takes, goal, np.zeros(k))])
            assert dropped is None, dropped
            due.append((since + takes + rest_s, 'move'))
        elif what == 'joints':
            state = arm.joint_state()
            assert state is not None
            stamp, names, q, _ = state
            order = [names.index(name) for name in world.chain.joint_names]
            joints.append((stamp, q[order]))
            due.append((since + 1.0 / joints_hz, 'joints'))
        else:
            number += 1
            frame = scene.frame(number, (3, 1), world.time_s)
            seen = frame.labeled_markers[:members]
            if all(marker.params & MEASURED for marker in seen):
                points = np.array([marker.position for marker in seen])
                frames.append((world.time_s, frame.timestamp, points))
            due.append((since + 1.0 / frames_hz, 'frame'))
    joints.sort(key=lambda entry: entry[0])
    return Played(
        world,
        Stream.of(np.array([t for t, _ in joints]), np.array([q for _, q in joints])),
        np.array([t for t, _, _ in frames]),
        np.array([t for _, t, _ in frames]),
        np.array([p for _, _, p in frames]),
    )
