# SPDX-License-Identifier: Apache-2.0
"""Inspections of an arm, in place of a collection and in a session of their own.

/remaster/verify: is the correction of the bridge in use? /remaster/check: has the arm changed?
When the recorder has closed the session, the verb of that name evaluates it in another process: no
estimation runs in the process that announces poses, and a later evaluation of the same session
gives the same verdict.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rclpy.node import Node
from std_msgs.msg import String

from remaster_ros.collection.events import SHORT, BridgeState
from remaster_ros.compensation.checking import SMALLEST_M
from remaster_ros.errors import InputError
from remaster_ros.nodes.background import Background
from remaster_ros.nodes.parameters import parameter
from remaster_ros.nodes.status import LATCHED
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cells.workcell import Workcell

Inspection = Literal['verify', 'check']
KINDS: tuple[Inspection, ...] = ('verify', 'check')
VERDICT = 'remaster/verdict'
LONGEST_WALL_S = 600.0
"""Most time of an evaluation, which takes seconds."""


@dataclass(frozen=True)
class InspectionParameters:
    """ROS parameters of inspections."""

    compensation: str = parameter(
        '',
        'compensation.json that remaster/verify is about (the one of robot_bridge), and by which '
        'the arm was right for remaster/check; empty for neither',
    )
    check_poses: str = parameter(
        'check.csv',
        'configurations of remaster/check, as `remaster plan CELL --check FILE` writes them',
    )
    history: str = parameter(
        'checks.jsonl', 'all checks of this arm so far; remaster/check adds to it'
    )
    smallest_mm: float = parameter(
        1e3 * SMALLEST_M,
        'change at the tool that matters to remaster/check',
        unit='mm',
        low=0.001,
        high=100.0,
    )


class Inspections:
    """Plans the visits of inspections (verify, check), and starts their evaluation."""

    def __init__(
        self,
        node: Node,
        session: Path,
        p: InspectionParameters,
        cell: Workcell,
        tours: TourPlanner,
    ) -> None:
        self._log, self._session, self._p = node.get_logger(), session, p
        self._cell, self._tours = cell, tours
        self._publisher = node.create_publisher(String, VERDICT, LATCHED)
        self._background = Background(node)
        self._evaluating = False
        self.verdict = self.trouble = ''

    @property
    def page(self) -> Path:
        """Path of the HTML page with the trend of all checks, next to the session's folder."""
        session = self._session.absolute()
        return session.with_name(f'{session.name}.check.html')

    def refusal(self, kind: Inspection, bridge: BridgeState | None) -> str:
        """Return why an inspection cannot begin, with the remedy; '' if it can.

        ``bridge``: its last state, None if none has come. Reasons: no or an invalid
        compensation.json, or no bridge. For the kind verify also: a joint slides, or the
        bridge corrects by another file than this planner's, or by none (by SHA-256).
        """
        # Imported when needed, since the import is slow.
        from remaster_ros.compensation.file import read_compensation

        file = self._p.compensation
        if not file:
            return (
                f'{kind} needs the parameter compensation of pose_planner: the compensation.json '
                'that the arm is judged by'
            )
        try:
            sha256 = read_compensation(file).sha256
        except InputError as error:
            return str(error)
        chain = self._tours.model.chain
        if kind == 'verify' and chain.slides.any():
            return (
                f"joint '{chain.joint_names[int(np.argmax(chain.slides))]}' slides, and "
                'robot_bridge corrects no such arm: measure ten poses through what does, and run '
                '`remaster verify`'
            )
        if bridge is None:
            return 'no sign of robot_bridge: is it running in this ROS domain?'
        if kind == 'verify' and bridge.correction != sha256:
            has = f'checksum {bridge.correction[:SHORT]}' if bridge.correction else 'none'
            return (
                f'robot_bridge corrects by another file ({has}) than {file} '
                f'({sha256[:SHORT]}): start it with the same parameter compensation'
            )
        return ''

    def tour(self, kind: Inspection) -> tuple[Callable[[], Tour], str]:
        """Return a function that plans the visits, and a message to show before the arm moves.

        ``kind``: verify (new poses, with the correction off and on) or check (the
        configurations of the table `check_poses`). Raises InputError if that table is invalid,
        or a configuration in it is in collision or too near to a joint limit.
        """
        if kind == 'check':
            # Imported when needed, since the import is slow.
            from remaster_ros.compensation.check_visits import read_visits

            visits = read_visits(Path(self._p.check_poses), self._cell, self._tours.model.chain)
            tour, seconds = self._tours.check(visits.q), visits.seconds(self._tours.travel)
            too_long = visits.too_long(seconds)
            return lambda: tour, '; '.join(
                [
                    f'{len(visits.q)} configurations follow, some {seconds:.0f} s by straight '
                    'lines',
                    *([too_long] if too_long else []),
                    f'smallest change that is found, at a noise of {1e3 * visits.noise_m:.2g} mm '
                    f'per axis: {", ".join(visits.expected())}',
                    f'the verdict comes on /{VERDICT}',
                ]
            )
        return self._tours.verification, (
            'ten poses follow, each with the correction off and on; the verdict comes on '
            f'/{VERDICT}'
        )

    def evaluate(self, kind: Inspection) -> None:
        """Start the evaluation of the session that the recorder has closed, at most once.

        Returns at once; the verdict is in `verdict` and on `VERDICT`, or `trouble` says why there
        is none.
        """
        if not self._evaluating:
            self._evaluating = True
            command = [kind, str(self._session), '--json']
            if kind == 'verify':
                command += ['--compensation', self._p.compensation]
            else:
                command += ['--baseline', self._p.compensation, '--history', self._p.history]
                command += ['--smallest-mm', repr(self._p.smallest_mm), '--out', str(self.page)]
            self._background.submit(lambda: _output_of_verb(command), self._on_answer)

    def _on_answer(self, answer: str | Exception) -> None:
        """Log the evaluation's verdict with its warnings, and publish its JSON output.

        ``answer``: that output, or the exception of the evaluation: then there is no verdict,
        and the error is logged and kept as `trouble`.
        """
        if isinstance(answer, Exception):
            self.trouble = f'not judged: {answer}'
            self._log.error(self.trouble)
            return
        content = json.loads(answer)
        self.verdict = f'{content["verdict"]}: {content["text"]}'
        self._log.info(self.verdict)
        for warning in content.get('warnings', ()):
            self._log.warning(warning)
        self._publisher.publish(String(data=answer))

    def answer(self) -> tuple[bool, str]:
        """Return whether there is a verdict, and the verdict, or why there is none (yet)."""
        return bool(self.verdict), self.verdict or self.trouble or 'it is being judged'

    def close(self) -> None:
        """End without waiting for a verdict."""
        self._background.close(0.0)


def _output_of_verb(command: list[str]) -> str:
    """Return the output of a verb of the command line, without white space around it.

    ``command``: verb and arguments. Raises InputError with the last line of its stderr if its exit
    status is not 0, `subprocess.TimeoutExpired` after `LONGEST_WALL_S`.
    """
    done = subprocess.run(
        [sys.executable, '-m', 'remaster_ros.cli.main', *command],
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_WALL_S,
    )
    if done.returncode:
        raise InputError((done.stderr.strip() or f'status {done.returncode}').splitlines()[-1])
    return done.stdout.strip()
