# SPDX-License-Identifier: Apache-2.0
"""Precision of a session while it is collected, and whether that is enough.

`collection.stopping_rule` decides. What it finds is on ``remaster/precision`` (JSON, latched)
and, for the planner, in the optimizer's state.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String

from remaster_ros.collection.events import EventRecord, OptimizerState, PlannerState, RecorderState
from remaster_ros.collection.stopping_rule import (
    Look,
    StoppingGoal,
    StoppingRule,
    configurations,
)
from remaster_ros.errors import RemasterError
from remaster_ros.nodes.running import RemasterNode, fault_of_this_program
from remaster_ros.nodes.status import (
    LATCHED,
    PRECISION_TOPIC,
    STATE_EVERY_S,
    listen,
)
from remaster_ros.reports.precision_json import precision_json
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Priors


class PrecisionWatch:
    """Fits the session after every `every` configurations, and publishes its precision.

    ``every``: 0 for never; ``goal``: precision that is enough; ``priors``: reads the priors.
    Attributes: ``state``: the last result, for the optimizer's state.
    """

    def __init__(
        self,
        node: RemasterNode,
        session: Path,
        goal: StoppingGoal,
        every: int,
        priors: Callable[[], Priors | None],
    ) -> None:
        self.state = OptimizerState(plan='', enough=False)
        self._node, self._folder, self._goal, self._every = node, session, goal, every
        self._priors = priors
        self._recorder: RecorderState | None = None
        self._planned = self._seen = 0
        self._looks: list[Look] = []
        self._publisher = node.create_publisher(String, PRECISION_TOPIC, LATCHED)
        if every:
            listen(node, self._on_record)
            # Of its own: a look takes tenths of a second.
            group = MutuallyExclusiveCallbackGroup()
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            node.create_timer(STATE_EVERY_S, self._step, callback_group=group, clock=steady)

    def _on_record(self, record: EventRecord) -> None:
        """Keep the recorder's state, and the planner's count of planned configurations."""
        match record.body:
            case RecorderState() as recorder:
                self._recorder = recorder
            case PlannerState(planned=planned):
                self._planned = planned

    def _step(self) -> None:
        """Fit the session if there are new observations; the text of an error goes to `state`.

        Timer callback. Nothing without a plan, for another session than the recorder's, or
        once the goal is reached; another plan begins anew. A fault of this program is only
        logged.
        """
        recorder, planned = self._recorder, self._planned
        if recorder is None or not (planned and recorder.plan and recorder.observations):
            return
        if Path(recorder.session).resolve() != self._folder.resolve():
            return
        if recorder.plan != self.state.plan:
            self._looks, self._seen = [], 0
            self.state = OptimizerState(plan=recorder.plan, enough=False)
        if self.state.enough or recorder.observations == self._seen:
            return
        self._seen = recorder.observations
        try:
            rule = StoppingRule(self._goal, planned, self._every, priors=self._priors())
            self._look(rule, recorder.plan)
        except RemasterError as error:
            self.state = OptimizerState(plan=recorder.plan, enough=False, precision=str(error))
        except Exception as error:
            # It only watches: the collection goes on to its planned end.
            self._node.get_logger().error(str(fault_of_this_program(error)))

    def _look(self, rule: StoppingRule, plan: str) -> None:
        """Fit at each count of configurations reached since the last look; publish the result.

        Ends at the first count that is enough, which is logged. ``plan``: identifier for the
        state. Raises as `read_session` and `StoppingRule.look`.
        """
        session = read_session(self._folder)
        done = configurations(session)
        for count in rule.counts[len(self._looks) :]:
            if count > done or self.state.enough:
                return
            before = self._looks[-1] if self._looks else None
            # The same draws whenever this look is repeated.
            look = rule.look(session, count, before, np.random.default_rng(count))
            self._looks.append(look)
            words, enough = rule.describe(look), rule.is_enough(look)
            if enough:
                self._node.get_logger().info(words)
            self._publisher.publish(String(data=precision_json(rule, self._looks)))
            self.state = OptimizerState(plan=plan, enough=enough, precision=words)
