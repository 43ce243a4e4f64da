# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on fake hardware: start all nodes, collect, fit, and print the results.

Nodes are processes with real DDS and real sockets; the fakes share a hidden World, whose truth is
compared with the estimate only at the end.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from remaster_ros.compensation.export import APPLY_FOLDER
from remaster_ros.compensation.file import COMPENSATION_FILE, read_compensation
from remaster_ros.demo.conductor import Conductor
from remaster_ros.demo.configuration_times import ConfigurationTimes
from remaster_ros.demo.processes import NodeProcesses, free_ports
from remaster_ros.demo.tables import print_hidden, print_offsets, print_times, true_errors
from remaster_ros.errors import DeviceError, InputError, RemasterError
from remaster_ros.nodes.launching import CORE, SENSORS
from remaster_ros.nodes.opening_file import opening_path, page_name
from remaster_ros.nodes.running import report
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.reports.fit_json import read_fit
from remaster_ros.session.cells.workcell import Workcell, config_path, read_cell
from remaster_ros.session.files import cannot_write, make_folder, undone_on_failure
from remaster_ros.session.records.reader import HEADER, read_session
from remaster_ros.session.records.session_journal import is_complete
from remaster_ros.session.yaml_records import to_plain
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.setup import make_world

ANSWER_WALL_S, WORK_WALL_S = 120.0, 3600.0
"""Most time of a node to answer or to be ready, and to fit, s. On an idle computer they take a
second and half a minute; the limits allow for 40 processes per processor."""
STANDS_WALL_S = 1800.0
"""Time without a new configuration after which a collection has failed, s."""
CLEARING_CALLS = 2
"""Calls that clear a halt: two if the arm is reported elsewhere than it was commanded."""
AFTERWARDS = 5
"""Candidate poses of each split with the correction on: with all their solutions one or two dozen
configurations, of which `remaster verify` needs ten."""
TO_FIT, MOST_CANDIDATES = 4, 60
"""Least number of poses to fit, and most candidates drawn to get them: a fit needs three, and from
the true positions of the sensors one less may be visible than from the rough ones."""
REPORTS_HZ, FRAMES_HZ = 125.0, 120.0
"""Rates of joint states and frames of an arm with dynamics, Hz."""
LAST_MESSAGES = 50
"""Most messages under way from nodes that have ended."""
TRACKER, OF_TRACKER = 'tracker', ('fake_laser_tracker', 'laser_tracker_markers')
"""Name of the laser tracker in the cells of the demo, and its nodes."""
READY = {'state': 'ready'}
BEFORE_SESSION = {'log', 'ros_home', 'session'}
"""Contents of the folder of a demo that was interrupted before its session began."""


def enough_candidates(cell: Workcell, seed: int, asked: int) -> int:
    """Return the number of candidates of each split that leaves `TO_FIT` poses to fit.

    The smallest such number from `asked` on; `asked` itself if `MOST_CANDIDATES` are not
    enough: the planner says why then. ``seed``: of the planned tour.
    """
    scene = cell.planning_scene(cell.chain())
    for count in range(asked, MOST_CANDIDATES + 1):
        if TourPlanner(scene, {'optimization': count}, seed).usable_to_fit >= TO_FIT:
            return count
    return asked


class Keyboard:
    """Lines that a person types at the terminal."""

    @property
    def is_there(self) -> bool:
        """Whether standard input is a terminal."""
        return sys.stdin is not None and sys.stdin.isatty()

    def line(self) -> str | None:
        """Return a line typed since the last call, in lower case, without waiting; None if none.

        'f' if the terminal is closed.
        """
        ready, _, _ = select.select([sys.stdin], [], [], 0.0)
        # A closed terminal gives an empty line: nobody to ask.
        return (sys.stdin.readline() or 'f').strip().lower() if ready else None


class Demo:
    """One run of the demo, from the start of its nodes to the printed results.

    ``stopping``: filled by signals, checked between all steps.
    """

    def __init__(self, node: Conductor, stopping: list[int]) -> None:
        self.node, self.p, self._stopping = node, node.p, stopping
        self.console, self._keyboard = Console(quiet=self.p.quiet), Keyboard()
        # Last reason to resume that was printed.
        self._printed_reason = ''
        # Parsed first, so that an error comes before anything is written.
        self.requests = [EffectSpec.parse(text) for text in self.p.hide.split(',') if text]
        cell = read_cell(self.p.cell)
        chain = cell.chain()
        if self.p.apply and chain.slides.any():
            sliding = chain.joint_names[int(np.argmax(chain.slides))]
            raise InputError(
                f"apply: joint '{sliding}' slides, and no node corrects what such an arm is "
                'commanded; leave it out'
            )
        self.candidates = enough_candidates(cell, self.p.seed, self.p.candidates)
        if self.candidates > self.p.candidates:
            self.console.print(
                f'{self.candidates} candidate poses in place of {self.p.candidates}, of which too '
                f'few can be reached with seed {self.p.seed}'
            )
        # Nodes of a sensor that the cell does not have.
        self._absent = set() if TRACKER in cell.sensors else set(OF_TRACKER)
        self.hidden = Path(tempfile.mkdtemp(prefix='remaster_world_'))
        try:
            with undone_on_failure():
                self.out = output_folder(Path(self.p.out))
                self.world = make_world(
                    self.hidden,
                    cell,
                    self.p.seed,
                    self.p.rate,
                    self.requests,
                    self.candidates,
                    self.p.dynamics,
                )
        except BaseException:
            shutil.rmtree(self.hidden, ignore_errors=True)
            raise
        self.session, self.fit = self.out / 'session', self.out / 'fit'
        self.discovery, self.corrected = self.out / 'discovery', self.out / 'corrected'
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.processes = NodeProcesses(
            self.out / 'log',
            {
                'PYTHONUNBUFFERED': '1',
                # Halts of the fake arm must not be stored with those of real arms.
                'ROS_HOME': str((self.out / 'ros_home').resolve()),
            },
        )

    def run(self) -> bool:
        """Collect, fit, print; return whether the collection is complete.

        Raises DeviceError if a node fails or does not answer, KeyboardInterrupt after a signal.
        """
        self.console.print(f'hidden world drawn with seed {self.p.seed}; starting the nodes')
        self.console.print(
            'the fake arm moves without a Cartesian speed limit (real.yaml: 0.25 m/s)'
        )
        self._start()
        self._wait(self._ready, ANSWER_WALL_S, 'the nodes to come up')
        self._trigger('remaster/collect', 'pose_planner')
        complete = self._collect()
        try:
            results = self._estimate()
        except DeviceError as error:
            if complete:
                raise
            raise DeviceError(
                f'the arm was halted, and what was measured until then is not fitted ({error}): '
                f'remaster demo --out {self.out} goes on'
            ) from None
        times, file = self.node.times, None
        if self.p.apply and complete:
            file = self._apply()
        if self.p.watch:
            self._stay()
        self.processes.stop()
        print_times(self.console, times)
        # The truth is opened after all estimating processes have ended.
        print_offsets(self.console, read_fit(self.fit / 'fit.json'), self.world.truth)
        if self.requests:
            discovery = read_discovery(self.discovery / 'discovery.json')
            print_hidden(self.console, discovery, self.world.truth)
        if file is not None:
            self._print_applied(file)
        hidden = to_plain(self.world.truth)
        if self.world.dynamics is not None:
            hidden['dynamics'] = to_plain(self.world.dynamics)
        (self.out / 'truth.yaml').write_text(yaml.safe_dump(hidden))
        self.console.print(f'session: {self.session}')
        for label, folder, data in results:
            self.console.print(f'{label}: {folder / ("report.html" if self.p.figures else data)}')
        if not complete:
            self._say(f'the arm was halted on its way: remaster demo --out {self.out} goes on')
        return complete

    def _estimate(self) -> list[tuple[str, Path, str]]:
        """Fit the session and, if there are `requests`, look for causes.

        Returns label, folder and file of each result. Raises DeviceError if a service refuses.
        """
        if self.p.moving_s:
            return self._estimate_moving()
        self.console.print('fitting')
        self._trigger('remaster/fit', 'optimizer', timeout_s=WORK_WALL_S)
        results = [('report', self.fit, 'fit.json')]
        if self.requests:
            self.console.print('looking for causes')
            self._trigger('remaster/discover', 'optimizer', timeout_s=WORK_WALL_S)
            results.append(('causes', self.discovery, 'discovery.json'))
        return results

    def _estimate_moving(self) -> list[tuple[str, Path, str]]:
        """Import the motion from the session's bag, and fit it with the poses at standstill.

        Returns as `_estimate`. Raises DeviceError if one of the commands fails.
        """
        # The recorder has closed the bag with the session.
        moving, figures = self.out / 'moving', [] if self.p.figures else ['--no-figures']
        bag = str(self.session / 'bag')
        session = ['--proof', str(self.session), '--out', str(moving)]
        self._remaster('import', '--moving', bag, '--cell', self.p.cell, *session)
        self._remaster('fit', str(moving), '--out', str(self.fit), *figures)
        return [('report', self.fit, 'fit.json')]

    def _remaster(self, *arguments: str) -> None:
        """Run a command of `remaster`, and print what it says; raise DeviceError if it fails."""
        done = self._run(*arguments)
        self.console.print(done.stdout.strip(), soft_wrap=True, markup=False, highlight=False)
        if done.returncode:
            raise DeviceError(f'remaster {arguments[0]}: {done.stderr.strip()}')

    def _run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Print and run a command of `remaster`; return the finished process with its output.

        Nothing is raised if it fails.
        """
        self.console.print(f'remaster {" ".join(arguments)}', soft_wrap=True)
        return subprocess.run(
            [sys.executable, '-m', 'remaster_ros.cli.main', *arguments],
            capture_output=True,
            text=True,
            check=False,
        )

    def _apply(self) -> Path:
        """Collect other poses with the bridge's correction; return the file of the correction.

        That of the discovery if causes were looked for and it wrote one, else that of the fit.
        Raises DeviceError as `_wait`, and if collecting is refused.
        """
        file = self.discovery / APPLY_FOLDER / COMPENSATION_FILE
        if not (self.requests and file.exists()):
            file = self.fit / APPLY_FOLDER / COMPENSATION_FILE
        self.console.print(f'correcting by {file}, and visiting other poses')
        self.processes.stop(CORE)
        # Their last messages are outdated.
        for _ in range(LAST_MESSAGES):
            self._executor.spin_once(timeout_sec=0.01)
        for name in CORE:
            self.node.summaries.pop(name, None)
        self.node.times = ConfigurationTimes(self.p.rate)
        self._start_core(self.corrected, self.p.seed + 1, AFTERWARDS, AFTERWARDS, str(file))
        self._wait(self._ready, ANSWER_WALL_S, 'the nodes to come up')
        self._trigger('remaster/collect', 'pose_planner')
        self._collect()
        return file

    def _print_applied(self, file: Path) -> None:
        """Print the verdict of `remaster verify` on the corrected poses, and the true errors.

        ``file``: compensation.json by which the bridge corrected. The true errors are the mean
        distances of the tool from where it was wanted, mm, with and without the correction.
        """
        done = self._run('verify', str(self.corrected), '--compensation', str(file))
        self.console.print((done.stdout or done.stderr).strip())
        before, after = true_errors(
            read_session(self.corrected), read_compensation(file).compensator, self.world.truth
        )
        self.console.print(
            f'opened truth: on these poses the tool was {after:.3f} mm from where it was wanted, '
            f'and would have been {before:.3f} mm without the correction (mean, without noise; '
            'base and marker fitted to each)'
        )

    def _start(self) -> None:
        """Start all nodes on the fake devices, with free ports; with `watch` the live page too."""
        common = config_path('fake.yaml')
        command_port, data_port, tracker_port = free_ports(
            socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM
        )
        ports = {'command_port': command_port, 'data_port': data_port}
        world = str(self.hidden)
        fast = bool(self.p.dynamics)
        values: dict[str, dict[str, Any]] = {
            'fake_robot': {'world': world, **({'joint_state_rate': REPORTS_HZ} if fast else {})},
            'fake_optitrack': {'world': world, **ports, **({'rate': FRAMES_HZ} if fast else {})},
            'fake_laser_tracker': {'world': world, 'port': tracker_port},
            'optitrack_markers': {**ports, 'cell': self.p.cell},
            'laser_tracker_markers': {'port': tracker_port, 'cell': self.p.cell},
        }
        for name, overrides in values.items():
            if name not in self._absent:
                self.processes.start(name, common, overrides)
        size = self.candidates
        held_out = self.p.held_out_candidates or size
        self._start_core(self.session, self.p.seed, size, held_out)
        if self.p.watch:
            self.processes.start('watch', common, {'cell': self.p.cell, 'fit': str(self.fit)})
            name = page_name(self.node.context.get_domain_id(), '/watch')
            self.console.print(f'live page: open {opening_path(name)}', soft_wrap=True)

    def _start_core(
        self, session: Path, seed: int, size: int, held_out: int, compensation: str = ''
    ) -> None:
        """Start the nodes of a collection (`CORE`), and return at once.

        ``session``: its folder; ``seed``: of the planner; ``size, held_out``: candidate poses
        to fit and to validate; ``compensation``: file by which the bridge corrects, '' for
        none.
        """
        rate, cell = {'simulated_clock_rate': self.p.rate}, {'cell': self.p.cell}
        # A fit of the corrected poses by an operator must not overwrite the first one.
        suffix = f'_of_{session.name}' if compensation else ''
        discovery = f'{self.discovery}{suffix}'
        overrides: dict[str, dict[str, Any]] = {
            'pose_planner': {
                **cell,
                'seed': seed,
                'session': str(session),
                'discovery': discovery,
                'optimization_candidates': size,
                'validation_candidates': held_out,
                'reference_every': self.p.reference_every,
                'moving_s': self.p.moving_s,
            },
            'robot_bridge': {**cell, **rate, 'compensation': compensation},
            'recorder': {**cell, **rate, 'session': str(session)},
            'optimizer': {
                'session': str(session),
                'out': f'{self.fit}{suffix}',
                'discovery': discovery,
                'seed': self.p.seed,
                'figures': self.p.figures,
            },
        }
        for name in CORE:
            self.processes.start(name, config_path('fake.yaml'), overrides[name])

    def _spin(self) -> None:
        """Handle messages for 0.1 s at most; restart nodes that were killed.

        Raises KeyboardInterrupt after a signal, DeviceError as `NodeProcesses.check`.
        """
        self._executor.spin_once(timeout_sec=0.1)
        if self._stopping:
            raise KeyboardInterrupt
        for name in self.processes.check():
            # The last summary of the killed process is outdated.
            self.node.summaries.pop(name, None)
            self.console.print(f'{name} was killed, and is started again')

    def _stay(self) -> None:
        """Keep the nodes running for the live page until a signal."""
        self.console.print('the live page stays until Ctrl-C')
        with suppress(KeyboardInterrupt):
            while True:
                self._spin()
        self._stopping.clear()

    def _wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until a condition holds; raise DeviceError after the timeout.

        ``timeout_s``: s of wall time; ``what``: what is waited for, for the message. Messages
        are handled meanwhile. Raises KeyboardInterrupt after a signal.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                states = {name: s['message'] for name, s in self.node.summaries.items()}
                raise DeviceError(f'waited {timeout_s:g} s in vain for {what}; {states}')
            self._spin()

    def _ready(self) -> bool:
        """Whether all nodes are up, the robot reports and all sensors of the cell measure.

        By the last summaries of the nodes.
        """
        summaries = self.node.summaries
        return (
            summaries.keys() >= {*CORE, *SENSORS} - self._absent
            and summaries['pose_planner']['robot'] == 'heard'
            and summaries.get('laser_tracker_markers', READY)['state'] == 'ready'
            and summaries['optitrack_markers']['published'] != '0'
        )

    def _collect_again(self) -> None:
        """Call /remaster/collect, as an operator would, until it succeeds.

        Raises DeviceError if it does not within `ANSWER_WALL_S`.
        """
        deadline = time.monotonic() + ANSWER_WALL_S
        while True:
            try:
                self._trigger('remaster/collect', 'pose_planner')
                return
            except DeviceError:
                if time.monotonic() > deadline:
                    raise
            for _ in range(10):
                self._spin()

    def _trigger(self, service: str, server: str, timeout_s: float = ANSWER_WALL_S) -> None:
        """Call a service until it answers, also if its node is killed meanwhile.

        ``server``: name of the node; after its restart the service is called again;
        ``timeout_s``: s of wall time.

        Raises DeviceError if the request is refused, or there is no answer in time.
        """
        future, process = None, self.processes.pid(server)

        def done() -> bool:
            nonlocal future, process
            if self.processes.pid(server) != process:
                future, process = None, self.processes.pid(server)
            # The service of a dead node remains visible for a while; its summary does not.
            if future is None and server in self.node.summaries:
                future = self.node.call(service)
            return future is not None and future.done()

        self._wait(done, timeout_s, f'an answer of {service}')
        response = future.result()  # type: ignore[union-attr]
        if not response.success:
            raise DeviceError(f'{service}: {response.message}')

    def _collect(self) -> bool:
        """Wait for the end of the collection, with a progress bar; print times of measuring.

        Returns True, or False if it ended with a halted arm. Pauses are resumed as an operator
        would. Raises DeviceError if nothing is measured for `STANDS_WALL_S`.
        """
        columns = (
            TextColumn('{task.description}'),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=self.console, transient=False) as progress:
            task = progress.add_task('registering the sensors', total=None)
            done, since_wall = '', time.monotonic()
            while not self._is_complete():
                planner = self.node.summaries.get('pose_planner', {})
                if planner.get('phase') == 'collection' and planner.get('configurations') != '0':
                    progress.update(
                        task,
                        description='visiting configurations',
                        total=int(planner.get('configurations', 0)),
                        completed=int(planner.get('configurations_done', 0)),
                    )
                self._resume_if_paused()
                if halted := self.node.summaries.get('robot_bridge', {}).get('halted'):
                    progress.stop()
                    if not self._wait_for_operator(halted):
                        return False
                    progress.start()
                    since_wall = time.monotonic()
                if planner.get('configurations_done', '') != done:
                    done, since_wall = planner.get('configurations_done', ''), time.monotonic()
                elif time.monotonic() - since_wall > STANDS_WALL_S:
                    states = {name: s['message'] for name, s in self.node.summaries.items()}
                    raise DeviceError(f'nothing was measured for {STANDS_WALL_S:g} s; {states}')
                self._spin()
        self.console.print(self.node.planned)
        measuring = [
            f'{key.removeprefix("waited_s_")} {value} s'
            for key, value in self.node.summaries['recorder'].items()
            if key.startswith('waited_s_')
        ]
        self.console.print(
            f'the arm stood still for measuring: {", ".join(measuring)} (world time, sum of all '
            'configurations; a sensor that measures beside a faster one counts only beyond it)'
        )
        return True

    def _is_complete(self) -> bool:
        """Whether collection and session are complete; raise DeviceError if the planner failed."""
        planner = self.node.summaries.get('pose_planner', {})
        if planner.get('state') == 'failed':
            raise DeviceError(f'the planner gave up: {planner["message"]}')
        closed = self.node.summaries.get('recorder', {}).get('exit_status')
        return planner.get('state') == 'complete' and closed == 'complete'

    def _resume_if_paused(self) -> None:
        """Call /remaster/collect if a pause or a killed planner waits for an operator.

        In the demo nothing has to be inspected. Nothing while the arm is halted. With the live
        page an operator may be there: unless the setup has changed, a message is printed
        instead.
        """
        summaries = self.node.summaries
        planner, bridge = (summaries.get(name, {}) for name in ('pose_planner', 'robot_bridge'))
        if planner.get('state') == 'idle' and planner.get('resuming') == 'no':
            # A killed planner waits for an operator.
            self._collect_again()
        if planner.get('state') != 'paused' or bridge.get('halted'):
            self._printed_reason = ''
            return
        changed, asks = (
            summaries.get('recorder', {}).get('changed'),
            bridge.get('asks_for_collect'),
        )
        if changed or (asks and not self.p.watch):
            self._say(f'changed since the reference: {changed}' if changed else f'paused: {asks}')
            self._say('going on, as /remaster/collect does')
            self._collect_again()
        elif (why := asks or planner['message']) != self._printed_reason:
            self._say(f'paused: {why}; the live page, or /remaster/collect, goes on')
            self._printed_reason = why

    def _wait_for_operator(self, halted: str) -> bool:
        """Wait for a person to end a halt, at the terminal or on the live page.

        Returns whether the collection goes on: not if the person wants a fit, or nobody is
        there. If only the live page can end the halt, what was measured is fitted meanwhile.
        Raises DeviceError if nobody is there and nothing was measured. ``halted``: why, as the
        bridge states it.
        """
        done = self.node.summaries.get('pose_planner', {}).get('configurations_done', '0')
        self._say(f'the arm is halted: {halted}. {done} configurations were measured')
        asks = self._keyboard.is_there
        if asks:
            self._say(
                'Enter goes on, as /remaster/clear_halt and /remaster/collect do; f and Enter '
                'fits what was measured; Ctrl-C ends the demo'
            )
        elif not self.p.watch:
            if done == '0':
                raise DeviceError('nobody is at the terminal, and there is nothing to fit')
            self._say('nobody is at the terminal: what was measured is fitted')
            return False
        else:
            self._say('the live page goes on; what was measured is fitted meanwhile')
            try:
                self._estimate()
            except DeviceError as error:
                self._say(str(error))
        while self.node.summaries.get('robot_bridge', {}).get('halted'):
            self._spin()
            line = self._keyboard.line() if asks else None
            if line is None:
                continue
            if line.startswith('f'):
                return False
            self._clear_halt()
        return True

    def _clear_halt(self) -> None:
        """Clear the halt, and go on with the collection, as an operator does.

        `CLEARING_CALLS` times at most; a refusal is printed, and the halt may remain.
        """
        for _ in range(CLEARING_CALLS):
            try:
                self._trigger('remaster/clear_halt', 'robot_bridge')
            except DeviceError as error:
                self._say(str(error))
                continue
            # The next summary shows that the halt is over.
            self.node.summaries.pop('robot_bridge', None)
            self._collect_again()
            return

    def _say(self, text: str) -> None:
        """Print a message for the operator; to stderr with the option quiet."""
        if self.p.quiet:
            print(text, file=sys.stderr)
        else:
            self.console.print(text, soft_wrap=True)

    def close(self) -> None:
        """End all processes of nodes, and remove the folder of the hidden World."""
        self.processes.stop()
        shutil.rmtree(self.hidden, ignore_errors=True)


def output_folder(path: Path) -> Path:
    """Make the output folder of the demo, with its subfolder log, and return it.

    A folder that exists may be empty, or that of an interrupted demo: with an unfinished
    session, or, before the session began, with only logs. Raises InputError if it holds other
    files or cannot be written.
    """
    session = path / 'session'
    try:
        make_folder(path)
        if (session / HEADER).exists():
            unfinished = not is_complete(session)
        else:
            unfinished = {entry.name for entry in path.iterdir()} <= BEFORE_SESSION
        if not unfinished:
            raise InputError(
                f'{path} is not empty, and holds no unfinished session; give --out a new folder'
            )
        make_folder(path / 'log')
    except OSError as error:
        raise cannot_write(path, error) from None
    return path


def main(args: list[str] | None = None) -> int:
    """Run the demo; return its exit status.

    0 for a complete collection, 1 for one that ended with a halted arm, 130 after a signal; see
    `running.report` for errors.
    """
    # Messages stay on this machine, and do not reach other demos.
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda signum, frame: stopping.append(signum))
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    demo = None
    try:
        demo = Demo(Conductor(), stopping)
        return 0 if demo.run() else 1
    except KeyboardInterrupt:
        print('stopped; what was recorded so far can be read', file=sys.stderr)
        return 130
    except RemasterError as error:
        return report(error)
    finally:
        if demo is not None:
            demo.close()
        rclpy.try_shutdown()
