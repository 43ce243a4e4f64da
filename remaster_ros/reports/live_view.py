# SPDX-License-Identifier: Apache-2.0
"""State of the live page: built from what the nodes publish, shown as a view. No ROS, no clock.

All texts of a view came over the network: they are clipped here, and shown as text by the page.
The commands offered by a view are only a display; the nodes that serve them decide.
"""

from __future__ import annotations

import hashlib
import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from remaster_ros.collection import events
from remaster_ros.collection.live_residuals import LiveResiduals
from remaster_ros.collection.pace import Pace, minutes_text
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports.precision_json import Precision
from remaster_ros.types import FloatArray

STOP_LABEL = 'Stop the collection'
STOP_NOTE = (
    'No emergency stop: it asks the planner over the network. In danger use the red button.'
)
SILENT_S = 3.0
"""Time without a message after which a node counts as gone, s."""
LONGEST_TEXT = 400
LONGEST_DESCRIPTION = 4000
"""Characters of a plan's description: those of this planner have some 500, behind a fold."""
MOST_NODES = 30
MOST_MESSAGES = 40
MOST_POINTS = 400
LONGEST_WAY = 200
UNDETERMINED_RAD = 0.0873
"""Std from which on an offset counts as undetermined, 5 degrees (22 mm for a prismatic joint): its
prior in the fit."""
SHOWN_COUNTS = ('phase', 'poses_done', 'poses', 'configurations_done', 'configurations')
SHOWN_PLAN = ('plan_page', 'plan_shown', 'confirmed')
_PLAN_NAME = re.compile('[0-9a-f]{8}')
PLANNER, BRIDGE, RECORDER, OPTIMIZER = 'pose_planner', 'robot_bridge', 'recorder', 'optimizer'
NODES = (PLANNER, BRIDGE, RECORDER, OPTIMIZER)


@dataclass(frozen=True)
class PlanPage:
    """Address at which the page of a plan is served, or why it is not."""

    plan: str = ''  # Fingerprint of the plan
    address: str = ''  # Relative to the live page; '' if it is not served
    trouble: str = ''  # Reason if it is not served; '' otherwise


@dataclass(frozen=True)
class FitFacts:
    """Facts of a fit other than its offsets: texts to show, unidentifiable joints, markers."""

    shown: Mapping[str, str] = field(default_factory=dict)  # Label -> text
    unidentifiable: frozenset[str] = frozenset()  # Joints whose offset is not identifiable
    # Fitted position of each marker in the tool frame, m, (3,)
    markers: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass
class _Node:
    """Last status of a node: level, message, and time of reception, s; -inf before the first."""

    level: str = ''
    message: str = ''
    heard_s: float = float('-inf')


class LiveView:
    """State of a collection as received from the ROS nodes, and the view of it for the live page.

    ``markers``: sensor -> its markers -> their positions in the tool frame, m, (3,).
    """

    def __init__(
        self, chain: SerialChain, markers: Mapping[str, Mapping[str, FloatArray]]
    ) -> None:
        self._chain, self._sensors = chain, tuple(markers)
        self.residuals = LiveResiduals(chain, markers)  # Of the markers
        self._pace = Pace()
        self._nodes = {name: _Node() for name in NODES}
        self._values: dict[str, str] = {}
        self._planner: events.PlannerState | None = None
        self._bridge: events.BridgeState | None = None
        self._recorder: events.RecorderState | None = None
        self._reports: dict[str, events.SensorReport] = {}
        self._messages: deque[tuple[float, str]] = deque(maxlen=MOST_MESSAGES)
        self._plan = ''
        self._open: dict[tuple[str, int], FloatArray] = {}
        self._q: FloatArray | None = None
        self._target: FloatArray | None = None
        self._way: FloatArray = np.empty((0, 3))
        # Registrations, sensor -> (4, 4)
        self.registration: dict[str, FloatArray] = {}
        self._precision = Precision()
        self._offsets: Mapping[str, tuple[float, float]] = {}
        self._fit = FitFacts()
        self._plan_page = PlanPage()
        # Whether the planner offers the service that confirms the next plan
        self.plan_offered = False

    # What comes in

    def take_summary(
        self, node: str, level: str, message: str, values: Mapping[str, str], now_s: float
    ) -> None:
        """Take a status of a node from /remaster/status; new nodes beyond 30 are ignored.

        ``level``: such as 'ok'; ``values``: counts and plan, kept of the planner only;
        ``now_s``: time of reception.
        """
        if node not in self._nodes and len(self._nodes) >= MOST_NODES:
            return
        self._nodes[node] = _Node(level, _clip(message), now_s)
        if node == PLANNER:
            self._values = {
                name: _clip(values.get(name, '')) for name in SHOWN_COUNTS + SHOWN_PLAN
            }
            running = self._planner is not None and self._planner.state == 'running'
            self._pace.update(self._count('configurations_done'), now_s, running=running)

    def take(self, body: events.State | events.Event, now_s: float) -> None:
        """Take a record of /remaster/events: keep a state, process or report an event.

        ``now_s``: present time, s. Reports of unknown sensors are ignored.
        """
        match body:
            case events.PlannerState():
                self._planner = body
            case events.BridgeState():
                self._bridge = body
            case events.RecorderState():
                self._recorder = body
            case events.SensorReport(sensor=sensor) if sensor in self._sensors:
                self._reports[sensor] = body
            case events.TourPlanned(description):
                self._plan = _clip(description, LONGEST_DESCRIPTION)
            case events.SolutionSettled(stamp=stamp, solution=solution) if self._q is not None:
                self._open = {(stamp, solution): self._q}
                self.residuals.settled(self._q)
            case events.ConfigurationEnded():
                self._end(body, now_s)
            case _:
                self._add_message(body, now_s)

    def _end(self, end: events.ConfigurationEnded, now_s: float) -> None:
        """Process the end of a configuration: keep its residuals if it was recorded, even in part.

        They are dropped otherwise, or if no event told before that the configuration settled.
        Any result but 'recorded' adds a message. ``now_s``: present time, s.
        """
        recorded = end.result in ('recorded', 'partial')
        q = self._open.pop((end.stamp, end.solution), None)
        registering = self._values.get('phase') == 'registration'
        self.residuals.ended(recorded=recorded and q is not None, registering=registering)
        if end.result != 'recorded':
            self._messages.append((now_s, _clip(f'configuration {end.result}: {end.reason}')))

    def _add_message(self, body: events.State | events.Event, now_s: float) -> None:
        """Add a message on a failed solution, the arm stopped or halted, or a changed set-up.

        Also if a halt is cleared; other events add none. ``now_s``: present time, s.
        """
        match body:
            case events.SolutionFailed(reason=reason):
                text = f'configuration failed: {reason}'
            case events.ArmStopped(reason=reason):
                text = f'the arm was stopped: {reason}'
            case events.ArmHalted(reason=reason):
                text = f'the arm is halted: {reason}'
            case events.HaltCleared():
                text = 'a person has cleared the halt'
            case events.SetupChanged(text=change):
                text = f'changed since the reference: {change}'
            case _:
                return
        self._messages.append((now_s, _clip(text)))

    def take_plan_page(self, page: PlanPage) -> None:
        """Take the address of a plan's page, or why it is not served."""
        self._plan_page = page

    def take_joints(self, q: FloatArray) -> None:
        """Take the arm's joint positions, rad or m, (k,); ignored if one is not finite."""
        if np.all(np.isfinite(q)):
            self._q = q

    def take_target(self, T_R_T: FloatArray) -> None:
        """Take the target pose of the tool, T_R_T, (4, 4); ignored if not finite."""
        if np.all(np.isfinite(T_R_T)):
            self._target = T_R_T

    def take_way(self, way: FloatArray) -> None:
        """Take the arm's next configurations, rad or m, (n, k), for its path in the 3-D view.

        Ignored if a value is not finite; only the first `LONGEST_WAY` are drawn.
        """
        if np.all(np.isfinite(way)):
            self._way = tool_path(self._chain, way[:LONGEST_WAY])

    def take_registration(self, sensor: str, T_R_N: FloatArray) -> None:
        """Take the registration of a sensor, T_R_N, (4, 4).

        Ignored if the sensor is unknown or a value is not finite.
        """
        if sensor in self._sensors and np.all(np.isfinite(T_R_N)):
            self.registration[sensor] = T_R_N

    def take_offsets(self, means: Mapping[str, float], stds: Mapping[str, float]) -> None:
        """Take a fit's zero-offsets and their standard deviations, joint -> rad or m.

        Ignored unless all joints have finite ones. Live residuals are computed with them from
        then on.
        """
        names = self._chain.joint_names
        values = [by_name.get(name, np.nan) for by_name in (means, stds) for name in names]
        if np.all(np.isfinite(values)):
            self._offsets = {name: (means[name], stds[name]) for name in names}
            self.residuals.use_offsets(np.array([means[name] for name in names]))

    def take_fit(self, fit: FitFacts) -> None:
        """Take further facts of the fit whose offsets were taken.

        Its markers are used for the live residuals from then on.
        """
        self._fit = fit
        self.residuals.use_markers(fit.markers)

    def take_precision(self, text: str) -> None:
        """Take the precision so far (JSON of /remaster/precision).

        Raises MsgspecError if invalid.
        """
        self._precision = msgspec.json.decode(text, type=Precision)

    # What goes out

    def plan_to_show(self) -> tuple[str, str]:
        """Return the shown plan's fingerprint and the file of its page; ('', '') if none."""
        plan, page = self._values.get('plan_shown', ''), self._values.get('plan_page', '')
        return (plan, page) if page and _PLAN_NAME.fullmatch(plan) else ('', '')

    def view(self, now_s: float) -> dict[str, Any]:
        """Return the content of the page at a time, s, in plain types for JSON.

        Messages come newest first, with their age in s.
        """
        return {
            'run': self._run(now_s),
            'halted': _clip(self._bridge.halted) if self._bridge else '',
            'changed': _clip(self._recorder.changed) if self._recorder else '',
            'nodes': self._node_rows(now_s),
            'sensors': [self._sensor_row(name) for name in self._sensors],
            'precision': self._precision_table(),
            'result': self._result(),
            'messages': [
                {'age_s': now_s - then, 'text': text} for then, text in reversed(self._messages)
            ],
            'confirmation': self._confirmation(),
            'commands': self._commands(now_s),
            'seen': self.seen(now_s),
            'scene': self._scene(),
        }

    def seen(self, now_s: float) -> str:
        """Return a mark of the state that a person must have seen before letting the arm move.

        A hash, which changes with the state of the run, a halt, a change of the set-up, the
        next plan, its confirmation, and whether the planner is heard.
        """
        silent = self._silent(PLANNER, now_s)
        state = self._planner.state if self._planner else ''
        halted = self._bridge.halted if self._bridge else ''
        changed = self._recorder.changed if self._recorder else ''
        plan = self.plan_to_show()[0], self._values.get('confirmed', '')
        what = '\0'.join((str(silent), state, halted, changed, *plan))
        return hashlib.sha256(what.encode()).hexdigest()[:16]

    def _silent(self, node: str, now_s: float) -> bool:
        """Whether a node was not heard for more than 3 s (`SILENT_S`), or never."""
        return now_s - self._nodes[node].heard_s > SILENT_S

    def _count(self, name: str) -> int:
        """Count of this name in the planner's status; 0 if it is missing or no number."""
        try:
            return int(self._values.get(name, '0'))
        except ValueError:
            return 0

    def _run(self, now_s: float) -> dict[str, Any]:
        """Return state and progress of the collection for the page.

        The state is 'silent' if the planner is; counts of configurations are 0 outside the
        phase 'collection'.
        """
        done, of = self._count('configurations_done'), self._count('configurations')
        phase = self._values.get('phase', '')
        collecting = phase == 'collection' and of > 0
        silent = self._silent(PLANNER, now_s)
        state = _clip(self._planner.state) if self._planner else ''
        message = self._nodes[PLANNER].message
        waiting = _clip(self._recorder.waiting_for) if self._recorder else ''
        plan, _, details = self._plan.partition(';')
        left_s = self._pace.left_s(of - done) if collecting and state != 'complete' else None
        return {
            'state': 'silent' if silent else state,
            'message': 'no sign of pose_planner' if silent else message,
            'waiting_for': waiting,
            'phase': phase,
            'poses_done': self._count('poses_done'),
            'poses': self._count('poses'),
            'done': done if collecting else 0,
            'of': of if collecting else 0,
            'left': minutes_text(left_s),
            'plan': _as_sentence(_clip(plan)),
            'plan_details': _as_sentence(details.strip()),
        }

    def _node_rows(self, now_s: float) -> list[dict[str, Any]]:
        """Return a row for each node: name, level, message; a silent one has level 'error'."""
        rows = []
        for name, node in self._nodes.items():
            age_s = now_s - node.heard_s
            if age_s > SILENT_S:
                seen = f'silent for {age_s:.0f} s' if np.isfinite(age_s) else 'not seen yet'
                rows.append({'name': _clip(name), 'level': 'error', 'message': seen})
            else:
                row = {'name': _clip(name), 'level': node.level, 'message': node.message}
                rows.append(row)
        return rows

    def _sensor_row(self, name: str) -> dict[str, Any]:
        """Return the state of a sensor for the page.

        With its last 400 residuals (`MOST_POINTS`) and the median of all, mm.
        """
        report = self._reports.get(name)
        ages = self._recorder.read_age_s if self._recorder else {}
        norms = 1e3 * self.residuals.norms_m(name)
        registering = self.residuals.of_registration(name) if len(norms) else 0
        return {
            'name': name,
            'ready': bool(report and report.ready),
            'hidden': bool(report and report.hidden),
            'message': _clip(report.trouble or report.message) if report else 'not seen yet',
            'read_age_s': ages.get(name),
            'registered': name in self.registration,
            'residuals_mm': _rounded(norms[-MOST_POINTS:], 3),
            'of_registration': max(0, registering - len(norms[:-MOST_POINTS])),
            'median_mm': float(np.median(norms)) if len(norms) else None,
            'corrected': self.residuals.corrected,
        }

    def _precision_table(self) -> dict[str, Any]:
        """Return the offsets' standard deviations, degrees, at the last 400 looks (`MOST_POINTS`).

        A look is a fit of the data so far. With the number of configurations and the time,
        minutes, at each; None for unknown values.
        """
        looks = self._precision.looks[-MOST_POINTS:]
        return {
            'message': _clip(self._precision.message),
            'configurations': [look.configurations for look in looks],
            'minutes': [look.minutes for look in looks],
            'std_deg': {
                name: [look.joint_std_deg.get(name) for look in looks]
                for name in self._chain.joint_names
            },
        }

    def _result(self) -> dict[str, Any]:
        """Return offsets and facts of the last fit for the page.

        Keys: 'joints', a row for each joint, [] before the first fit, and 'fit'.
        """
        return {
            'joints': [
                self._offset_row(joint, name, *self._offsets[name])
                for joint, name in enumerate(self._chain.joint_names)
                if name in self._offsets
            ],
            'fit': dict(self._fit.shown),
        }

    def _offset_row(self, joint: int, name: str, mean: float, std: float) -> dict[str, Any]:
        """Return a joint's offset and its std, deg or mm; the std is None if it is undetermined.

        ``joint``: index from 0; ``mean``, ``std``: rad or m. Undetermined: not identifiable,
        or a std of 5 degrees (`UNDETERMINED_RAD`, times ``per_radian``) or more.
        """
        as_angle = std / float(self._chain.per_radian[joint])
        known = name not in self._fit.unidentifiable and as_angle < UNDETERMINED_RAD
        if self._chain.slides[joint]:
            shown = {'unit': 'mm', 'mean_mm': round(1e3 * mean, 6)}
            return {'joint': name, **shown, 'std_mm': round(1e3 * std, 6) if known else None}
        return {
            'joint': name,
            'mean_deg': _degrees(mean),
            'std_deg': _degrees(std) if known else None,
        }

    def _confirmation(self) -> dict[str, Any] | None:
        """Return the plan shown for confirmation, with its page's address; None without a plan.

        With whether it is confirmed, and the reason if its page is not served.
        """
        plan, page = self.plan_to_show()
        if not plan:
            return None
        served = self._plan_page if self._plan_page.plan == plan else PlanPage()
        return {
            'plan': plan,
            'confirmed': self._values['confirmed'] == 'yes',
            'page': page,
            'address': served.address,
            'offered': self.plan_offered,
            'trouble': _clip(served.trouble),
        }

    def _commands(self, now_s: float) -> dict[str, dict[str, Any]]:
        """Return label, 'on' (whether enabled now) and note of each command, by its name.

        Commands: 'collect', 'pause', 'stop' (always enabled), 'fit', 'confirm'. The note of
        'collect' says why it is disabled, else that the arm moves; of 'stop' and 'confirm'
        always what they do; '' of 'pause' and 'fit'.
        """
        state = self._planner.state if self._planner else ''
        silent, confirmation = self._silent(PLANNER, now_s), self._confirmation()
        unconfirmed = self._values.get('confirmed') == 'no'
        plan = confirmation['plan'] if confirmation else ''
        why = 'the planner is silent' if silent else ''
        if not why and self._bridge and self._bridge.halted:
            why = 'the arm is halted'
        if not why and state not in ('idle', 'paused', 'stopped'):
            why = f'the collection is {state[:100]}'
        if not why and unconfirmed:
            why = f'plan {plan} is not confirmed' if plan else 'the plan is not shown yet'
        idle = state not in ('running', 'held')
        begun = self._count('configurations_done') or self._count('poses_done')
        measured = bool(self._recorder and self._recorder.observations)
        ready = bool(confirmation and confirmation['address'] and confirmation['offered'])
        return {
            'collect': {
                'label': 'Go on' if begun else 'Begin the collection',
                'on': not why,
                'note': why or 'the arm moves',
            },
            'pause': {'label': 'Pause', 'on': not silent and not idle, 'note': ''},
            'stop': {'label': STOP_LABEL, 'on': True, 'note': STOP_NOTE},
            'fit': {'label': 'Fit', 'on': idle and measured, 'note': ''},
            'confirm': {
                'label': f'Confirm plan {plan}',
                'on': ready and unconfirmed and idle and not silent,
                'note': 'Nothing moves before you begin the collection or go on.',
            },
        }

    def _scene(self) -> dict[str, Any]:
        """Return the moving part of the 3-D view: joints, target, path, sensors and points.

        The points are measured ones. In the robot base frame R, m; 'q' and 'target' are None
        before they were received.
        """
        q, target = self._q, self._target
        return {
            'q': None if q is None else _rounded(q, 6),
            # By rows.
            'target': None if target is None else _rounded(target.ravel(), 5),
            'way': _rounded(self._way, 4),
            'sensors': {name: _rounded(T[:3, 3], 3) for name, T in self.registration.items()},
            'points': {
                name: _rounded(self.residuals.points_R(name)[-MOST_POINTS:], 4)
                for name in self._sensors
            },
        }


def tool_path(chain: SerialChain, way: FloatArray, steps: int = 12) -> FloatArray:
    """Tool positions along straight lines in joint space between configurations, in R, m, (m, 3).

    ``way``: rad or m, (n, k); ``steps``: points of each line, with both ends. (0, 3) for fewer
    than two configurations.
    """
    if len(way) < 2:
        return np.empty((0, 3))
    share = np.linspace(0.0, 1.0, steps)[:, None]
    lines = [a + share * (b - a) for a, b in pairwise(way)]
    return chain.positions(np.concatenate(lines), np.zeros(3))


def _clip(text: str, longest: int = LONGEST_TEXT) -> str:
    """Text cut to a number of characters, the last one then '…'."""
    return text if len(text) <= longest else f'{text[: longest - 1]}…'


def _as_sentence(text: str) -> str:
    """Text with its first letter capital and a full stop added; '' for an empty text."""
    return f'{text[:1].upper()}{text[1:]}.' if text else ''


def _degrees(radians: float) -> float:
    """Angle in rad as degrees, to six decimals."""
    return round(float(np.degrees(radians)), 6)


def _rounded(values: FloatArray | Sequence[float], digits: int) -> Any:
    """Values as (nested) lists, rounded to a number of decimals."""
    return np.round(np.asarray(values, dtype=float), digits).tolist()
