# SPDX-License-Identifier: Apache-2.0
"""The node behind the live page, on real DDS: what comes in, what a button does, what stays in."""

import http.client
import json
import re
from pathlib import Path

import pytest
from rigs.ros_rig import found, node_arguments, wait_until
from worlds.played_collection import CHAIN, T_R_N

pytestmark = [pytest.mark.ros, pytest.mark.timeout(900)]


PLAN_HEAD = (
    '<!doctype html><meta name="generator" content="remaster plan">'
    '<meta name="plan" content="{}"><p>a plan'
)


class Page:
    def __init__(self, start, client, tmp_path):
        self.client = client
        self.process = start('remaster_ros.nodes.watch', *node_arguments(port=0, fit=tmp_path))
        line = self.process.stdout.readline()
        self.file = Path(re.fullmatch(r'live page: open (.*)\n', line)[1])
        address = re.search(r'http://([\d.:]+)/#token=([\w-]{43})', self.file.read_text())
        self.host, self.token = address.groups()

    def ask(self, path, body=None):
        """Return status and content, while the test's own node goes on."""
        connection = http.client.HTTPConnection(self.host, timeout=900)
        headers = {'Authorization': f'Bearer {self.token}'}
        if body is not None:
            headers['Origin'] = f'http://{self.host}'
        connection.request('GET' if body is None else 'POST', path, body, headers)
        self.client.spin_some()
        for _ in range(20):
            self.client.spin_some()
        response = connection.getresponse()
        content = json.loads(response.read())
        connection.close()
        return response.status, content

    def view(self):
        return self.ask('/view')[1]['view'] or {}


@pytest.fixture
def page(start, client, tmp_path):
    return Page(start, client, tmp_path)


def test_what_is_published_is_shown_and_nonsense_is_left_out(page, client):
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
    from visualization_msgs.msg import MarkerArray

    from remaster_ros.nodes.messages import transform_message
    from remaster_ros.nodes.status import EVENTS, LATCHED, RELIABLE

    names, q, nan = list(CHAIN.joint_names), [0.1] * 7, float('nan')

    def publisher(kind, topic, qos=RELIABLE):
        return client.create_publisher(kind, topic, qos)

    joints = publisher(JointState, 'joint_states')
    means = publisher(JointState, 'remaster/joint_offsets', LATCHED)
    stds = publisher(JointState, 'remaster/joint_offsets_std', LATCHED)
    registration = publisher(TransformStamped, 'remaster/registration', LATCHED)
    solutions = publisher(JointTrajectory, 'remaster/joint_solutions')
    target = publisher(PoseStamped, 'remaster/target_pose')
    events = publisher(String, EVENTS)
    markers = []
    client.create_subscription(MarkerArray, 'remaster/markers', markers.append, RELIABLE)

    def shown():
        # Of each kind what makes no sense: too few, no numbers, no rotation, no JSON.
        joints.publish(JointState(name=names, position=[]))
        joints.publish(JointState(name=names, position=[nan] * 7))
        joints.publish(JointState(name=names, position=q))
        target.publish(PoseStamped())
        events.publish(String(data='{"version": 1'))
        way = JointTrajectory(joint_names=names)
        way.points = [JointTrajectoryPoint(positions=[0.4] * 7)]
        solutions.publish(way)
        way.points = [JointTrajectoryPoint(positions=[0.4] * 6)]
        solutions.publish(way)
        zero = TransformStamped(child_frame_id='tracker')
        zero.transform.rotation.w = 0.0
        registration.publish(zero)
        registration.publish(transform_message('base_link', 'mocap', T_R_N))
        means.publish(JointState(name=names, position=[0.01] * 7))
        stds.publish(JointState(name=names, position=[nan] * 7))
        stds.publish(JointState(name=names, position=[1e-4] * 7))
        client.spin_some()
        view = page.view()
        if not view:
            return False
        done = view['scene']['q'] and view['scene']['way'] and view['result']['joints']
        return done and view['sensors'][0]['registered'] and markers

    wait_until(shown, 30.0, 'the view')
    view = page.view()
    assert [sensor['registered'] for sensor in view['sensors']] == [True, False]
    assert view['result']['joints'][6]['std_deg'] == pytest.approx(0.0057, abs=1e-4)
    spaces = {marker.ns for marker in markers[-1].markers}
    assert {'arm', 'way'} <= spaces
    assert {m.header.frame_id for m in markers[-1].markers} == {'base_link'}
    assert page.process.poll() is None


def test_buttons_call_the_services_and_nothing_else(page, client):
    from std_srvs.srv import Trigger

    called = []

    def serve(name):
        def answer(request, response):
            called.append(name)
            response.success, response.message = name != 'pause', f'{name}: asked'
            return response

        client.create_service(Trigger, f'remaster/{name}', answer)

    status, content = page.ask('/command/stop', '')
    assert (status, content['done']) == (200, False)
    assert 'nobody offers' in content['message']
    for name in ('collect', 'pause', 'stop', 'clear_halt'):
        serve(name)
    wait_until(lambda: page.ask('/command/stop', '')[1]['done'], 20.0, 'the services')
    called.clear()
    assert page.ask('/command/pause', '')[1] == {'done': False, 'message': 'pause: asked'}
    status, answer = page.ask('/view')
    body = {'view': answer['number'], 'seen': answer['view']['seen']}
    assert page.ask('/command/collect', json.dumps(body))[1]['done']
    assert page.ask('/command/collect', json.dumps({**body, 'seen': 'other'}))[0] == 409
    assert page.ask('/command/clear_halt', '')[0] == 404
    assert called == ['pause', 'collect']


def test_a_plan_is_confirmed_by_its_own_service(page, client, tmp_path):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from std_srvs.srv import Trigger

    from remaster_ros.nodes.status import RELIABLE, TOPIC

    status, called = client.create_publisher(DiagnosticArray, TOPIC, RELIABLE), []
    file = tmp_path / 's.plan.html'

    def serve(plan):
        def answer(request, response):
            called.append(plan)
            response.success, response.message = True, 'confirmed'
            return response

        client.create_service(Trigger, f'remaster/confirm/plan_{plan}', answer)

    def shown(plan):
        """Publish as the planner does; return what the page has of the plan."""
        values = {'plan_page': str(file), 'plan_shown': plan, 'confirmed': 'no'}
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        planner = DiagnosticStatus(name='pose_planner', values=pairs)
        status.publish(DiagnosticArray(status=[planner]))
        client.spin_some()
        return page.view().get('confirmation') or {}

    def confirm(answer):
        body = {'view': answer['number'], 'seen': answer['view']['seen']}
        return page.ask('/command/confirm', json.dumps(body))

    for plan in ('00000001', '00000002'):
        serve(plan)
    # Not there yet; then of another plan; then no page of a plan at all.
    wait_until(lambda: shown('00000001').get('trouble'), 30.0, 'that the page is missing')
    for text in (PLAN_HEAD.format('00000002'), '<p>00000001'):
        file.write_text(text)
        wait_until(lambda: not shown(''), 20.0, 'that there is none')
        wait_until(lambda: shown('00000001').get('trouble'), 20.0, 'that it is refused')
        assert shown('00000001')['address'] == ''
    file.write_text(PLAN_HEAD.format('00000001'))
    wait_until(lambda: not shown(''), 20.0, 'that there is none')
    wait_until(lambda: shown('00000001').get('address'), 20.0, 'the page of the plan')
    old = page.ask('/view')[1]
    wait_until(lambda: confirm(page.ask('/view')[1])[1]['done'], 20.0, 'the confirmation')
    assert set(called) == {'00000001'}
    # Another one is next: what was seen before is no longer asked for, of neither plan.
    wait_until(lambda: shown('00000002').get('plan') == '00000002', 20.0, 'the other plan')
    called.clear()
    assert confirm(old)[0] == 409
    assert called == []


def test_the_token_is_for_this_user_alone(page, client):
    from rcl_interfaces.msg import Log
    from rcl_interfaces.srv import GetParameters, ListParameters

    from remaster_ros.nodes.status import LATCHED

    assert page.file.stat().st_mode & 0o077 == 0
    assert page.file.parent.stat().st_mode & 0o077 == 0
    logged = []
    client.create_subscription(Log, '/rosout', logged.append, LATCHED)
    caller = client.create_client(ListParameters, 'watch/list_parameters')
    found(caller)

    def result(caller, request):
        future = caller.call_async(request)
        wait_until(lambda: client.spin_some() or future.done(), 20.0, 'parameters')
        return future.result()

    names = result(caller, ListParameters.Request()).result.names
    assert 'port' in names
    caller = client.create_client(GetParameters, 'watch/get_parameters')
    found(caller)
    values = result(caller, GetParameters.Request(names=names)).values
    assert page.token not in str(values)
    assert page.token not in str(logged)


def test_a_place_that_cannot_be_served_is_refused_in_one_line(start, page, tmp_path):
    for values in ({'port': page.host.split(':')[1]}, {'address': '0.0.0.0'}):
        process = start(
            'remaster_ros.nodes.watch', *node_arguments(fit=tmp_path, **values), '-r', '__ns:=/b'
        )
        out, err = process.communicate(timeout=900)
        assert process.returncode == 2
        assert (out, err.count('\n')) == ('', 1)
        assert err.startswith('error: live page: ')
