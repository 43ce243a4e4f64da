# SPDX-License-Identifier: Apache-2.0
"""config/sros2/policy.xml allows what the nodes do, and nothing else: compared with real nodes."""

import importlib.util
import xml.etree.ElementTree as ElementTree
from fnmatch import fnmatch

import pytest
from judges import viewer_configs
from rigs.ros_rig import ROOT, node_arguments, wait_until

from remaster_ros.collection.plan_confirmation import service_name

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

POLICY = ROOT / 'config' / 'sros2' / 'policy.xml'
NODES = (
    'pose_planner',
    'robot_bridge',
    'optitrack_markers',
    'laser_tracker_markers',
    'recorder',
    'optimizer',
    'watch',
)
PLANS = '/remaster/confirm/plan_*'
OWN = {
    # As beside an arm without such a topic.
    'robot_bridge': {'simulated_clock_rate': 0.0, 'emergency_stop_topic': 'none'},
    'recorder': {'simulated_clock_rate': 0.0},
    'optitrack_markers': {'start_timeout_s': 600.0},
    'laser_tracker_markers': {'start_timeout_s': 600.0},
    'watch': {'port': 0},
}


def resolved(name, namespace, node):
    """Write a name of the policy in full, as sros2 does."""
    if name.startswith('~'):
        return f'{namespace.rstrip("/")}/{node}{name[1:]}'
    return name if name.startswith('/') else f'{namespace.rstrip("/")}/{name}'


def allowed(node):
    """Return {(what, name)} of a node's profile."""
    (profile,) = ElementTree.parse(POLICY).iterfind(f".//profile[@node='{node}']")
    found = set()
    for expressions in profile:
        for what in ('publish', 'subscribe', 'reply', 'request'):
            if expressions.get(what) == 'ALLOW':
                found |= {(what, resolved(e.text, profile.get('ns'), node)) for e in expressions}
    return found


def used(client, node):
    """Return {(what, name)} that the graph shows of a node."""
    asked = {
        'publish': client.get_publisher_names_and_types_by_node,
        'subscribe': client.get_subscriber_names_and_types_by_node,
        'reply': client.get_service_names_and_types_by_node,
        'request': client.get_client_names_and_types_by_node,
    }
    return {(what, name) for what, ask in asked.items() for name, _ in ask(node, '/')}


def test_the_policy_is_what_the_nodes_use(start, client, tmp_path):
    """A name too few and a secured node fails; one too many and the lock stands open."""
    for name in NODES:
        values = {'use_sim_time': False, **OWN.get(name, {})}
        if name in ('pose_planner', 'recorder', 'optimizer'):
            values['session'] = tmp_path / 'session'
        parameters = {f'{name}:{key}': value for key, value in values.items()}
        start(
            f'remaster_ros.nodes.{name}',
            *node_arguments(ROOT / 'config' / 'fake.yaml', **parameters),
        )
    looks = []

    def the_same_for_long():
        """All are up when what they show has not grown for 40 looks."""
        client.spin_some()
        present = dict(client.get_node_names_and_namespaces())
        looks.append({name: used(client, name) for name in NODES if name in present})
        now = looks[-1]
        up = [name for name in now if ('publish', '/remaster/status') in now[name]]
        return len(up) == len(NODES) and len(looks) > 40 and looks[-40] == now

    wait_until(the_same_for_long, 60.0, 'six nodes')
    for name in NODES:
        permitted, shown = allowed(name), looks[-1][name]
        if importlib.util.find_spec('tf2_msgs') is None:
            permitted -= {('publish', '/tf_static')}
        # There is one for each plan that waits for a confirmation; here none does.
        permitted -= {('reply', PLANS), ('request', PLANS)}
        assert shown - permitted == set(), f'{name} uses what the policy does not allow'
        assert permitted - shown == set(), f'{name} is allowed what it does not use'
    # While all of them run: RViz and Foxglove find what they are told to show.
    types = dict(client.get_topic_names_and_types())
    for topic, kind in viewer_configs.topics().items():
        assert types.get(topic) == [kind], topic


def test_plans_are_confirmed_to_the_planner_by_the_page_and_the_person():
    assert fnmatch(f'/remaster/confirm/{service_name("1a2b3c4d")}', PLANS)
    assert [node for node in NODES if ('reply', PLANS) in allowed(node)] == ['pose_planner']
    assert [node for node in NODES if ('request', PLANS) in allowed(node)] == ['watch']


@pytest.mark.parametrize('node', NODES)
def test_only_the_bridge_may_command(node):
    commands = ('publish', '/joint_trajectory_controller/joint_trajectory')
    assert (commands in allowed(node)) == (node == 'robot_bridge')
    assert ('publish', '/joint_states') not in allowed(node)
