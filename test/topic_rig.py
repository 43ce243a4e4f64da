"""A collection whose sensors are topics of nodes of other packages: no heartbeat, real DDS."""

import numpy as np
from collection_rig import Cell
from foreign_source import SIGMA_RAD, orientation
from ros_rig import call
from scipy.spatial.transform import Rotation

from remaster_ros import fit
from remaster_ros.collection.events import ConfigurationEnded
from remaster_ros.session.workcell import config_path
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

    def __init__(self, start, client, folder, candidates=5):
        self.world = folder / 'world'
        self.cell = Cell(
            start, client, folder, 'all', [], candidates=candidates, cell=cell_of(folder),
            foreign=FOREIGN,
        )  # fmt: skip
        # Registration is over, and the first configurations are.
        self.cell.until(lambda: self.cell.results.count('recorded') > 4, 'the first ones')

    def spoil(self, sensor, shows, **fault):
        """Inject a fault until `shows` holds; then end it, and see the next one recorded."""
        inject(self.world, {sensor: fault})
        self.cell.until(shows, f'{sensor} {fault}')
        inject(self.world, {})
        self.goes_on()

    def goes_on(self):
        count = self.cell.results.count('recorded')
        self.cell.until(lambda: self.cell.results.count('recorded') > count, 'the next')

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
        self.cell.until(shows, f'the end of {name}')
        self.cell.nodes[name] = self.cell._begin(name)
        self.goes_on()

    def kill(self, node):
        """Kill a node and start it again; a person sees to what does not go on by itself."""
        self.cell.said.pop(node)
        self.cell.kill_and_start(node)
        said, count = self.cell.said, self.cell.results.count('recorded')

        def again():
            # A planner that takes long to start on a busy machine: the arm was stopped.
            if said['robot_bridge']['halted']:
                call(self.cell.client, '/remaster/clear_halt')
            planner = said.get('pose_planner', {})
            stands = planner.get('resuming') == 'no' and planner['state'] in ('idle', 'paused')
            if stands and not said['robot_bridge']['halted']:
                call(self.cell.client, '/remaster/collect')
            return self.cell.results.count('recorded') > count

        self.cell.until(again, f'what follows the kill of {node}')

    def finish(self):
        """See that nothing is lost, twice or wrong, and that the session can be fitted."""
        cell = self.cell
        session = cell.complete()
        cell.check(session)
        partial = {
            (e.stamp, e.solution)
            for e in cell.events
            if isinstance(e, ConfigurationEnded) and e.result == 'partial'
        }
        assert 2 * cell.planned() - len(session.measurements) == len(partial)
        found = fit(session)
        error = np.abs(found.joint_offsets - cell.world.truth.joint_offsets)[found.identifiable]
        assert len(error) == 5
        assert np.all(error < 5.0 * found.joint_offsets_std[found.identifiable])
        turned = session.measurements.sensor == session.sensor_names.index('mocap')
        measured = session.measurements.orientation
        assert np.isnan(measured[~turned]).all()
        expected = orientation(cell.world, 'mocap', session.measurements.q[turned])
        apart = Rotation.from_quat(measured[turned]).inv() * Rotation.from_matrix(expected)
        assert np.max(apart.magnitude()) < 6.0 * SIGMA_RAD
        errors = found.accuracy['optimization']['post_registration_orientation']
        assert errors['after']['mean_deg'] < errors['before']['mean_deg']
        return session
