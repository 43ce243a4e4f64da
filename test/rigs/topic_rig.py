# SPDX-License-Identifier: Apache-2.0
"""A collection whose sensors are topics of nodes of other packages: no heartbeat, real DDS."""

import numpy as np
from rigs.collection_rig import Cell
from rigs.foreign_source import SIGMA_RAD, orientation
from rigs.ros_rig import call, clear_halt
from scipy.spatial.transform import Rotation

from remaster_ros import fit
from remaster_ros.collection.events import ConfigurationEnded
from remaster_ros.session.cells.workcell import config_path
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject

POINT, POSE = 'geometry_msgs/msg/PointStamped', 'geometry_msgs/msg/PoseStamped'
FOREIGN = {'mocap': (POSE, '/vrpn_mocap/tool/pose'), 'tracker': (POINT, '/vendor/point')}


def cell_of(folder):
    """Return the demo cell with both sensors read from topics of other packages' nodes."""
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    for old, new in (
        ('../robots', str(config_path('robots'))),
        ('optitrack/marker ', f'{FOREIGN["mocap"][1]}\n    message_type: {POSE}'),
        ('laser_tracker/marker', f'{FOREIGN["tracker"][1]}\n    message_type: {POINT}'),
        ('    single_shot: true\n    measure_service: laser_tracker/measure\n', ''),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    return path


class Collection:
    """A collection under way, and what is done to it."""

    def __init__(self, start, client, folder, candidates=5, rate=10.0):
        self.world = folder / 'world'
        self.cell = Cell(
            start, client, folder, 'all', [], candidates=candidates, cell=cell_of(folder),
            foreign=FOREIGN, rate=rate,
        )  # fmt: skip
        # Registration is over, and the first configurations are.
        self.until(lambda: self.cell.results.count('recorded') > 4, 'the first ones')

    def until(self, condition, what, timeout_s=120):
        """Wait, and see to what does not go on by itself, as a person does.

        On a machine that is far too busy for so fast a world joint_states come late and planners
        take long to start: the arm is then halted, or its run is over.
        """
        said = self.cell.said

        def turn():
            planner = said.get('pose_planner', {})
            if said.get('robot_bridge', {}).get('halted'):
                clear_halt(self.cell.client)
            elif planner.get('resuming') == 'no' and planner['state'] in ('idle', 'paused'):
                call(self.cell.client, '/remaster/collect')
            return condition()

        self.cell.until(turn, what, timeout_s)

    def spoil(self, sensor, shows, **fault):
        """Inject a fault until `shows` holds; then end it, and see the next one recorded."""
        inject(self.world, {sensor: fault})
        self.until(shows, f'{sensor} {fault}')
        inject(self.world, {})
        self.goes_on()

    def goes_on(self):
        count = self.cell.results.count('recorded')
        self.until(lambda: self.cell.results.count('recorded') > count, 'the next')

    def refused(self, reason):
        """Return a condition: one more reading is refused for this reason."""
        before = self._refusals(reason)
        return lambda: self._refusals(reason) > before

    def _refusals(self, reason):
        ended = (e for e in self.cell.events if isinstance(e, ConfigurationEnded))
        return sum(reason in e.reason for e in ended)

    def waits_for(self, words):
        return lambda: words in self.cell.recorder('waiting_for')

    def says(self, sensor, words):
        return lambda: words in self.cell.messages.get(f'topic_markers_{sensor}', '')

    def kill_source(self, sensor, shows):
        """Kill the other package's node; start it again when `shows` holds."""
        name = f'vendor_{sensor}'
        process = self.cell.nodes.pop(name)
        process.kill()
        process.wait()
        self.until(shows, f'the end of {name}')
        self.cell.nodes[name] = self.cell._begin(name)
        self.goes_on()

    def kill(self, node):
        """Kill a node and start it again."""
        self.cell.said.pop(node)
        self.cell.kill_and_start(node)
        self.goes_on()

    def finish(self):
        """See that nothing is lost, twice or wrong, and that the session can be fitted."""
        cell = self.cell
        self.until(lambda: cell.recorder('exit_status') == 'complete', 'the end', 300)
        session = read_session(cell.session)
        # On a busy machine a fault of one sensor meets a late reading of the other, or a node that
        # starts again is waited for in vain: each such configuration is said, in the plan.
        said = cell.ended(session)
        print(said)
        assert sum(said.values()) == cell.planned(), said
        lost = cell.planned() - said['recorded'] - said['partial']
        cell.check(session, lost)
        missing = 2 * cell.planned() - len(session.measurements)
        assert missing <= said['partial'] + 2 * lost, (said, cell.events)
        found = fit(session)
        error = np.abs(found.joint_offsets - cell.world.truth.joint_offsets)[found.identifiable]
        assert len(error) == 5
        assert np.all(error < 5.0 * found.joint_offsets_std[found.identifiable])
        turned = session.measurements.sensor == session.sensor_names.index('mocap')
        measured = session.measurements.orientation
        assert np.isnan(measured[~turned]).all()
        expected = orientation(cell.world, 'mocap', session.measurements.q[turned])
        turn_error = Rotation.from_quat(measured[turned]).inv() * Rotation.from_matrix(expected)
        assert np.max(turn_error.magnitude()) < 6.0 * SIGMA_RAD
        errors = found.accuracy['optimization']['post_registration_orientation']
        assert errors['after']['mean_deg'] < errors['before']['mean_deg']
        return session
