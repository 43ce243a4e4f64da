# SPDX-License-Identifier: Apache-2.0
"""Two hosts, one cable: the sensors on one, the rest on the other; the cable cut in the middle.

Two network namespaces joined by a veth pair stand for the hosts: NatNet stays on the first, DDS
crosses the cable by UDP alone. When half of the configurations are done the link goes down for 30
s of wall time (longer than it takes DDS to give its peers up), then up again. In the end every
planned configuration must have a reading of both sensors, once and of the right place, and the
arm must have stood still from its arrival until the cable was back.

Needs the right to make network namespaces: root, or unprivileged user namespaces (`unshare -rnm`).

Run: python test/qualification/two_hosts.py [--candidates 5] [--rate 3] [--cut 30] [--seed 0]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.simulated_clock import TAKEN
from remaster_ros.session.cells.workcell import config_path, read_cell
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.setup import make_world
from remaster_ros.simulation.world import MOTION_FILE, World

SENSORS = ('fake_optitrack', 'fake_laser_tracker', 'optitrack_markers', 'laser_tracker_markers')
REST = ('fake_robot', 'pose_planner', 'robot_bridge', 'recorder')
PATIENCE_S = 1200.0
STILL_WITHIN_S = 6.0
"""The bridge's heartbeat (3 s of wall time), the time to brake, and a busy machine."""
TOLERANCE_M = {'mocap': 0.3e-3, 'tracker': 0.15e-3}
"""Six standard deviations of the noise, and far below the distance of two configurations."""


class Hosts:
    """Two network namespaces and the cable between them."""

    def __init__(self) -> None:
        tag = f'rm{os.getpid()}'
        self.names = (f'{tag}a', f'{tag}b')
        self._ends = (f'v{tag}a', f'v{tag}b')

    def __enter__(self) -> Hosts:
        run('ip', 'link', 'add', self._ends[0], 'type', 'veth', 'peer', 'name', self._ends[1])
        for number, (name, end) in enumerate(zip(self.names, self._ends), start=1):
            run('ip', 'netns', 'add', name)
            run('ip', 'link', 'set', end, 'netns', name)
            inside = ('ip', '-n', name)
            run(*inside, 'link', 'set', 'lo', 'up')
            run(*inside, 'link', 'set', 'lo', 'multicast', 'on')
            run(*inside, 'address', 'add', f'10.77.0.{number}/24', 'dev', end)
            run(*inside, 'link', 'set', end, 'up')
            # NatNet's group by the loop inside the sensors' host, everything else by the cable.
            run(*inside, 'route', 'add', '239.255.42.99/32', 'dev', 'lo')
            run(*inside, 'route', 'add', '224.0.0.0/4', 'dev', end)
        return self

    def __exit__(self, *exception: object) -> None:
        for name in self.names:
            subprocess.run(['ip', 'netns', 'del', name], check=False)

    def cable(self, state: str) -> None:
        """Pull the cable out (``down``) or put it back (``up``)."""
        run('ip', '-n', self.names[0], 'link', 'set', self._ends[0], state)
        if state == 'up':
            # Linux forgets the routes of a link that went down.
            run('ip', '-n', self.names[0], 'route', 'add', '224.0.0.0/4', 'dev', self._ends[0])


def run(*command: str) -> None:
    """Run a command; if it fails, raise an error with its output."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'{" ".join(command)}: {done.stderr.strip()}')


def why_not() -> str:
    """Return why this machine does not let us make namespaces; '' where it does."""
    for tool in ('ip', 'unshare'):
        if shutil.which(tool) is None:
            return f'no {tool} here: install iproute2 and util-linux'
    prefix = [] if os.geteuid() == 0 else ['unshare', '-rnm']
    script = 'ip link add vrmx type veth peer name vrmy && ip link del vrmx'
    script = script if os.geteuid() == 0 else f'mount -t tmpfs none /run && {script}'
    done = subprocess.run(
        [*prefix, 'sh', '-c', script], capture_output=True, text=True, check=False
    )
    return done.stderr.strip().replace('\n', '; ') if done.returncode else ''


def become_root_of_a_namespace() -> None:
    """Start again as root of a user namespace of our own, unless we are root already."""
    if os.geteuid() != 0:
        inside = 'mount -t tmpfs none /run && exec "$@"'
        command = ['unshare', '-rnm', 'sh', '-c', inside, 'sh', sys.executable, *sys.argv]
        os.execvp(command[0], command)


@contextmanager
def nodes(
    hosts: Hosts, out: Path, world: Path, args: argparse.Namespace
) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """Run every node on its host; end them all."""
    parameters: dict[str, dict[str, Any]] = {
        **{name: {'world': str(world)} for name in (*SENSORS[:2], 'fake_robot')},
        'pose_planner': {
            'seed': args.seed,
            'session': str(out / 'session'),
            'optimization_candidates': args.candidates,
            'validation_candidates': args.candidates,
        },
        'recorder': {'session': str(out / 'session')},
    }
    running: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for host, names in zip(hosts.names, (SENSORS, REST)):
            for name in names:
                command = ['ip', 'netns', 'exec', host, sys.executable, '-m']
                command += ['remaster_ros.nodes', name, '--ros-args']
                command += ['--params-file', str(config_path('fake.yaml'))]
                if name in SENSORS:
                    # The World waits for a node that is busy; one that is cut off is not busy.
                    command += ['-r', f'{TAKEN}:=nobody_hears']
                for key, value in parameters.get(name, {}).items():
                    command += ['-p', f'{name}:{key}:={json.dumps(value)}']
                with (out / f'{name}.log').open('wb') as log:
                    running[name] = subprocess.Popen(
                        command, stdout=log, stderr=log, env=environment()
                    )
        yield running
    finally:
        for process in running.values():
            process.send_signal(signal.SIGINT)
        for process in running.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def environment() -> dict[str, str]:
    """Return the environment of the nodes: DDS by UDP alone, as between two computers."""
    return {
        **os.environ,
        'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID', '77'),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
        'PYTHONUNBUFFERED': '1',
    }


def conduct() -> None:
    """Start the collection and print the messages of planner and recorder, a JSON line each."""
    import rclpy
    from std_srvs.srv import Trigger

    from remaster_ros.nodes.status import listen

    rclpy.init()
    node = rclpy.create_node('conductor')
    said: dict[str, dict[str, str]] = {}

    def summary(name: str, message: str, values: dict[str, str]) -> None:
        said[name] = values
        # The values have a 'node' of their own: the name with its namespace.
        print(json.dumps({**values, 'node': name, 'message': message}), flush=True)

    listen(node, lambda event: None, summary)
    client = node.create_client(Trigger, '/remaster/collect')
    future = None
    while True:
        rclpy.spin_once(node, timeout_sec=0.1)
        ready = {'pose_planner', 'recorder', 'optitrack_markers', 'laser_tracker_markers'} <= {
            *said
        } and said['optitrack_markers'].get('published', '0') != '0'
        if future is None and ready and client.service_is_ready():
            future = client.call_async(Trigger.Request())
        elif future is not None and future.done() and not future.result().success:
            # The preflight found something that is not there yet.
            print(json.dumps({'node': 'collect', 'message': future.result().message}), flush=True)
            future = None
            time.sleep(1.0)


class Watch:
    """Follows the nodes through the conductor, and the arm through the hidden World."""

    def __init__(
        self,
        conductor: subprocess.Popen[str],
        running: dict[str, subprocess.Popen[bytes]],
        world: World,
    ) -> None:
        self._lines = conductor.stdout
        self._running = running
        self._world = world
        self.said: dict[str, dict[str, str]] = {}
        os.set_blocking(self._lines.fileno(), False)  # type: ignore[union-attr]

    def look(self) -> None:
        """Read the new lines of output."""
        while line := self._lines.readline():  # type: ignore[union-attr]
            if line.startswith('{'):
                values = json.loads(line)
                self.said[values['node']] = values

    def until(self, done: Any, what: str) -> None:
        """Wait until something holds."""
        deadline, printed_s = time.monotonic() + PATIENCE_S, 0.0
        while not done():
            self.look()
            ended = [name for name, process in self._running.items() if process.poll() is not None]
            if ended:
                raise SystemExit(f'{", ".join(ended)} ended while we waited for {what}')
            if halted := self.said.get('robot_bridge', {}).get('halted'):
                raise SystemExit(f'halted while we waited for {what}: {halted}')
            if time.monotonic() > deadline:
                raise SystemExit(f'waited {PATIENCE_S:g} s in vain for {what}: {self.said}')
            if time.monotonic() - printed_s > 10.0:
                printed_s = time.monotonic()
                print(f'  waiting for {what}: {self.progress()}', flush=True)
            time.sleep(0.1)

    def progress(self) -> str:
        """Return how far the planner is, and the last message of every node."""
        planner = self.said.get('pose_planner', {})
        done, planned = planner.get('configurations_done'), planner.get('configurations')
        messages = {name: values['message'] for name, values in self.said.items()}
        return f'{done} of {planned} configurations; {messages}'

    def share(self) -> float:
        """Return the share of the planned configurations that is done."""
        planner = self.said.get('pose_planner', {})
        planned = int(planner.get('configurations', '0') or 0)
        return int(planner.get('configurations_done', '0')) / planned if planned else 0.0

    def standing(self, seconds: float) -> tuple[float, int]:
        """Watch the arm; return when it last moved, s after now, and how many commands it got."""
        motions = self._world.folder / MOTION_FILE
        begin, last_moved = time.monotonic(), 0.0
        before = len(motions.read_text().splitlines())
        while (elapsed := time.monotonic() - begin) < seconds:
            if self._world.is_moving(self._world.now()):
                last_moved = elapsed
            self.look()
            time.sleep(0.02)
        return last_moved, len(motions.read_text().splitlines()) - before


def judge(folder: Path, world: World, planned: int) -> list[str]:
    """Return what is wrong with the session; nothing if all is there, once, and right."""
    session = read_session(folder)
    m = session.measurements
    faults = []
    seen = list(zip(m.configuration.tolist(), m.sensor.tolist()))
    if len(set(seen)) != len(seen):
        faults.append(f'{len(seen) - len(set(seen))} duplicates')
    if len(set(seen)) != 2 * planned:
        faults.append(f'{2 * planned - len(set(seen))} of {2 * planned} observations missing')
    if session.exit_status != 'complete':
        faults.append(f'exit status {session.exit_status}')
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    for index, name in enumerate(session.sensor_names):
        rows = m.sensor == index
        expected = world.truth.without_noise(chain, name, m.q[rows])
        worst = np.linalg.norm(m.position[rows] - expected, axis=1).max()
        if worst > TOLERANCE_M[name]:
            faults.append(f'{name}: a reading {worst * 1e3:.2f} mm from where the marker was')
    return faults


def main() -> int:
    """Run it once; return 0 where everything held."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--candidates', type=int, default=5)
    parser.add_argument('--rate', type=float, default=3.0, help='world time over wall time')
    parser.add_argument('--cut', type=float, default=30.0, help='s of wall time')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, help='keep the logs and the session here')
    parser.add_argument('--conduct', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.conduct:
        conduct()
    if reason := why_not():
        print(f'no network namespaces here: {reason}', file=sys.stderr)
        return 3
    become_root_of_a_namespace()
    # A termination cleans up too: namespaces outlive the processes in them.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit('terminated'))
    with tempfile.TemporaryDirectory(prefix='two_hosts_') as temporary:
        out = args.out or Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        folder = Path(temporary) / 'world'
        world = make_world(folder, read_cell('demo'), args.seed, args.rate)
        with Hosts() as hosts, nodes(hosts, out, folder, args) as running:
            command = ['ip', 'netns', 'exec', hosts.names[1], sys.executable, __file__]
            with subprocess.Popen(
                [*command, '--conduct'], stdout=subprocess.PIPE, text=True, env=environment()
            ) as conductor:
                try:
                    watch = Watch(conductor, running, world)
                    watch.until(lambda: watch.share() >= 0.5, 'half of the configurations')
                    hosts.cable('down')
                    before = watch.share()
                    moved_s, commands = watch.standing(args.cut)
                    print(
                        f'cut for {args.cut:g} s: {commands} commands (a stop is one), the arm '
                        f'stood still after {moved_s:.1f} s; {watch.progress()}',
                        flush=True,
                    )
                    after = watch.share()
                    hosts.cable('up')
                    watch.until(
                        lambda: watch.said.get('recorder', {}).get('exit_status') == 'complete',
                        'the session to be complete',
                    )
                    planned = int(watch.said['pose_planner']['configurations'])
                finally:
                    conductor.kill()
        faults = judge(out / 'session', world, planned)
        # The motion under way may end, or be stopped, within the heartbeat; nothing may follow.
        if commands > 2 or moved_s > STILL_WITHIN_S:
            faults.append(f'the arm moved during the cut: {commands} commands')
        print(
            f'{planned} configurations, {before:.0%} done at the cut, {after:.0%} at its end: '
            + ('; '.join(faults) or 'nothing lost, nothing twice, nothing wrong')
        )
        return int(bool(faults))


if __name__ == '__main__':
    sys.exit(main())
