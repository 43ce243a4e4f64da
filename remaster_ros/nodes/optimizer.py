# SPDX-License-Identifier: Apache-2.0
"""Fit the session on request, or look for what else is wrong; publish the offsets, latched.

Offsets are published with their standard deviations, and only those of a fit: the ones that a
discovery refits are right together with the effects it found, which a robot does not correct.

While a collection is under way it looks at what is known so far (`PrecisionWatch`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from remaster_ros.calibration.fit import (
    COARSEST_PRECISION,
    FINEST_PRECISION,
    PRECISION,
    fit_session,
)
from remaster_ros.collection.stopping_rule import (
    StoppingGoal,
)
from remaster_ros.errors import RemasterError
from remaster_ros.nodes.parameters import declare, parameter
from remaster_ros.nodes.precision_watch import PrecisionWatch
from remaster_ros.nodes.running import RemasterNode, run
from remaster_ros.nodes.status import (
    LATCHED,
    NodeStatus,
    Summary,
)
from remaster_ros.reports.fit_json import DISCOVERY_FILE, FIT_FILE, read_fit
from remaster_ros.reports.loadable import uncertainty
from remaster_ros.reports.result_folder import prepare_folder, save_fit
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.records.plan_journal import refuse_unimported
from remaster_ros.session.records.priors_file import read_priors
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import FloatArray, Priors, Session


@dataclass(frozen=True)
class Parameters:
    """ROS parameters of the optimizer."""

    session: str = parameter('session', 'folder of the session to fit')
    out: str = parameter('fit', 'folder for fit.json, figures and report')
    discovery: str = parameter(
        'discovery', 'folder for discovery.json, figures and report of what else is wrong'
    )
    sampler: str = parameter('fast', 'which sampler', choices=('fast', 'paper'))
    chains: int = parameter(4, 'number of chains', low=2, high=64)
    precision: float = parameter(
        PRECISION,
        'wanted Monte Carlo error of every mean, in standard deviations of its parameter',
        low=FINEST_PRECISION,
        high=COARSEST_PRECISION,
    )
    prior: str = parameter('', 'YAML file of what is known before a fit; empty for nothing')
    seed: int = parameter(0, 'seed of the sampler', low=0)
    cell: str = parameter(
        '',
        'cell file: once what its poses.joint_std_deg or poses.tool_std_m states is known, no '
        'more poses to fit are visited; empty for all that are planned',
    )
    look_every: int = parameter(
        5,
        'how many configurations to fit lie between two looks at what is known so far '
        '(remaster/precision); 0 for none',
        low=0,
        high=1000,
    )
    figures: bool = parameter(True, 'write figures and the report')


class Optimizer(RemasterNode):
    """Node that fits the session, or searches it for causes, on request."""

    # It moves nothing, and no node depends on it: what fails can be called again.
    outlives_faults = True

    def __init__(self) -> None:
        super().__init__('optimizer')
        self.p = declare(self, Parameters)
        self._state, self._ending = 'waiting', False
        # Whether the last call failed: until the next one, that is this node's state.
        self._failed = False
        self._busy = threading.Lock()
        self._means = self.create_publisher(JointState, 'remaster/joint_offsets', LATCHED)
        self._stds = self.create_publisher(JointState, 'remaster/joint_offsets_std', LATCHED)
        # Groups of their own: status and clock go on while a fit takes its seconds.
        for service, work in (
            ('remaster/fit', self._fit),
            ('remaster/discover', self._discover),
        ):
            serve = partial(self._serve, work)
            group = MutuallyExclusiveCallbackGroup()
            self.create_service(Trigger, service, serve, callback_group=group)
        goal = StoppingGoal.of(read_cell(self.p.cell).poses) if self.p.cell else StoppingGoal()
        self._watch = PrecisionWatch(
            self, Path(self.p.session), goal, self.p.look_every, self._priors
        )
        self.status = NodeStatus(self, self._summary)
        self._publish_last()

    def _serve(
        self,
        work: Callable[[], tuple[Path, str]],
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Any:
        """Serve a request by a fit or a search; an error becomes the response's message.

        ``work``: does it, and returns the path of the report, which is the response's message
        on success, and the text for the node's status. Refused while another one is under way.
        """
        if not self._busy.acquire(blocking=False):
            response.message = 'a fit is under way'
            return response
        self._failed = False
        try:
            report, self._state = work()
            response.success, response.message = True, str(report)
        except Exception as error:
            response = self.failed(error, response)
            self._state, self._failed = response.message, True
        finally:
            self._busy.release()
        return response

    def _fit(self) -> tuple[Path, str]:
        """Fit the session, save the result, publish the offsets.

        Returns the path of the file to open and a text for the status, with what is
        implausible in the result; that is logged too. Raises RemasterError: the session, the
        priors or the folder cannot be used, or the data do not allow a fit.
        """
        out = Path(self.p.out)
        session = self._session()
        prepare_folder(out, FIT_FILE)
        result = fit_session(
            session,
            rng=np.random.default_rng(self.p.seed),
            sampler='paper' if self.p.sampler == 'paper' else 'fast',
            chains=self.p.chains,
            precision=self.p.precision,
            progress=self._progress,
            clock=time.perf_counter,
            priors=self._priors(),
        )
        report = save_fit(result, out, figures=self.p.figures)
        self._publish(result.joint_names, result.joint_offsets, uncertainty(result).std)
        for line in result.implausible:
            self.get_logger().warning(line)
        return report, '; '.join(('fitted', *result.implausible))

    def _session(self) -> Session:
        """Read the session to fit; raises RemasterError if it cannot be used."""
        session = read_session(self.p.session)
        refuse_unimported(session, self.p.session)
        return session

    def _priors(self) -> Priors | None:
        """Priors of the file in the parameter `prior`; None if the parameter is empty.

        Raises InputError if the file is invalid.
        """
        return read_priors(self.p.prior) if self.p.prior else None

    def _discover(self) -> tuple[Path, str]:
        """Search the session for causes, save the result; return the report's path and a summary.

        If an earlier search of this session could not tell a cause from a look-alike (another
        cause that fits nearly as well), the result also states which of the two the data
        support now, or that this is still open. Raises RemasterError: the session or the
        folder cannot be used, or the data do not allow a search.
        """
        # Imported when it is needed, as it takes a second: the node is there at once.
        from remaster_ros.discovery.decision import decisions
        from remaster_ros.discovery.discover import discover_session
        from remaster_ros.reports.found_causes import earlier_pairs
        from remaster_ros.reports.result_folder import save_discovery

        out = Path(self.p.discovery)
        session = self._session()
        prepare_folder(out, DISCOVERY_FILE)
        # Of the same session before more was measured: what was left open then?
        pairs: Sequence[tuple[Any, Any]] = ()
        earlier = out / DISCOVERY_FILE
        try:
            pairs = earlier_pairs(earlier, created=session.created) if earlier.exists() else ()
        except RemasterError as error:
            self.get_logger().warning(f'nothing is decided of an earlier search: {error}')
        found = discover_session(
            session,
            rng=np.random.default_rng(self.p.seed),
            progress=self._progress,
            clock=time.perf_counter,
        )
        names = ', '.join(effect.name for effect in found.effects)
        names = names or ('nothing' if found.verdict == 'none' else found.verdict)
        decided = decisions(found, pairs)
        words = [f'discovered: {names}', *(decision.sentence for decision in decided)]
        report = save_discovery(found, out, figures=self.p.figures, decided=decided)
        return report, '; '.join(words)

    def _progress(self, stage: str, share: float) -> None:
        """Show stage and share, 0 to 1, of a fit as the state; RemasterError if closing."""
        if self._ending:
            raise RemasterError('stopped')
        self._state = f'{stage} {100 * share:.0f} %'

    def _publish_last(self) -> None:
        """Publish the offsets of the fit.json in the folder `out`, of an earlier run.

        Nothing without such a file; a warning if it is unreadable.
        """
        path = Path(self.p.out) / FIT_FILE
        if not path.exists():
            return
        try:
            rows = read_fit(path).joint_offsets
        except RemasterError as error:
            self.get_logger().warning(f'the last fit is not published: {error}')
            return
        self._publish([row.joint for row in rows], *np.array([row.mean_and_std for row in rows]).T)

    def _publish(self, names: Sequence[str], offsets: FloatArray, std: FloatArray) -> None:
        """Publish offsets and their standard deviations by joint name, latched, with one stamp.

        ``names``: joints; ``offsets, std``: rad or m, in the order of `names`, (k,).
        """
        stamp = self.get_clock().now().to_msg()
        for publisher, values in ((self._means, offsets), (self._stds, std)):
            message = JointState(name=list(names), position=values.tolist())
            message.header.stamp = stamp
            publisher.publish(message)

    def close(self) -> None:
        """End a fit under way at its next step."""
        self._ending = True

    def _summary(self) -> Summary:
        """Summary of the node's state for diagnostics; its level is 'error' after a failed fit."""
        level = 'error' if self._failed else 'ok'
        values = {'session': self.p.session, 'out': self.p.out}
        return Summary(level, self._state, values, self._watch.state)


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal ends it or it cannot start; return its exit status."""
    # One for a fit, one for looks while measurements come in, one for the status.
    return run(Optimizer, args, threads=3)


if __name__ == '__main__':
    raise SystemExit(main())
