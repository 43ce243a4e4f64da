# SPDX-License-Identifier: Apache-2.0
"""When enough is known to end a collection, and what more it would cost.

After every few configurations the session so far is fitted, to the posterior's mode and no draws,
and the standard deviations are held against those that are wanted. The looks are at fixed numbers
of configurations, so that they follow from the session alone: an optimizer that is started again
comes to the same.

A goal counts as reached only

- with twice as many degrees of freedom as parameters, and the poses and repeats that a search for
  causes needs (`planning.pose_design.Floors`): a fit of few observations is now and then far too
  sure of itself, and those are the fits that a rule would stop at;
- while the residuals show no structure (`calibration.residual_structure`): where the model is
  wrong its standard deviations are too small. That test is looked at again and again, and spends
  its error rate (`calibration.group_sequential`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import compress

import numpy as np

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.group_sequential import p_value_limits
from remaster_ros.calibration.precision import Precision
from remaster_ros.calibration.residual_structure import StructureTest, residual_structure
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import LEVER_M
from remaster_ros.planning.expected_sensors import ToolBox
from remaster_ros.planning.pose_design import Floors
from remaster_ros.planning.pose_settings import OPTIMAL, PoseSettings
from remaster_ros.types import IntArray, Priors, Session

FREEDOM_PER_PARAMETER = 2
ERROR_RATE = 0.005
"""Of all looks at the residuals together: structure claimed where there is none. The p-values are
not exact with two dozen readings and an estimated noise: with 1 % spent it was claimed in 14 of
1,000 sessions."""
MOST_TESTS = 20
"""Looks that test: more of them spend power, and find nothing sooner that matters."""


@dataclass(frozen=True)
class StoppingGoal:
    """Precision at which a collection ends; None for one that does not matter."""

    # Root mean square of the standard deviations of the identifiable joints, rad
    joint_std_rad: float | None = None
    # Root mean square of the 3-D error of the predicted markers in the box, m
    tool_std_m: float | None = None
    box: ToolBox | None = None  # None for wherever the tool was measured

    @classmethod
    def of(cls, poses: PoseSettings) -> StoppingGoal:
        """Return the goal of a cell file; an empty one if an optimal design's is not stated."""
        stated = (poses.joint_std_deg, poses.tool_std_m)
        matters = (poses.tool_share < 1.0, poses.tool_share > 0.0)
        if poses.design == OPTIMAL and None in compress(stated, matters):
            # The design then aims at the precision of the Latin hypercube, which is not stated.
            return cls()
        settings = poses.settings((), 0.0)
        return cls(settings.joint_std_rad, settings.tool_std_m, settings.box)

    @property
    def stated(self) -> bool:
        """Whether anything is to be reached."""
        return self.joint_std_rad is not None or self.tool_std_m is not None


@dataclass(frozen=True, eq=False)
class Look:
    """What is known after so many configurations."""

    configurations: int  # To fit, that were measured by then
    # From the first reading of the session to the last one by then, s; NaN where nothing is known
    # of the times
    elapsed_s: float
    # Of each joint, rad or m; None where it is not identifiable. Empty where there is no fit.
    joint_std: Mapping[str, float | None] = field(default_factory=dict)
    # As in `StoppingGoal`, rad and m; infinite where unknown
    joint_rms: float = np.inf
    tool_rms: float = np.inf
    # Degrees of freedom, and free parameters
    freedom: int = 0
    parameters: int = 0
    structure: tuple[StructureTest, ...] = ()  # What the residuals show by now, the clearest first
    lacking: str = ''  # Why this is not enough; '' where it is, or where nothing is to be reached
    # How many further configurations to fit the goal takes: 0 where it is reached, None where no
    # number does or none is known
    more: int | None = None
    more_s: float = np.nan  # How long they take at the pace so far, s; NaN where unknown
    sliding: tuple[str, ...] = ()  # The joints that slide


@dataclass(frozen=True)
class StoppingRule:
    """Looks at a session under way."""

    goal: StoppingGoal  # What is to be reached
    planned: int  # Configurations to fit that are planned
    every: int  # Configurations between two looks
    floors: Floors = field(default_factory=Floors)  # Least poses and repeats
    priors: Priors | None = None  # What is known before a fit, in place of what the session states

    @property
    def counts(self) -> tuple[int, ...]:
        """After how many configurations it looks."""
        return (*range(self.every, self.planned, self.every), self.planned)

    def limit(self, count: int) -> float:
        """Return below which p-value a look finds structure; 0 where it does not test."""
        step = -(-len(self.counts) // MOST_TESTS)
        tested = self.counts[::-1][::step][::-1]
        if count not in tested:
            return 0.0
        shares = tuple(number / self.planned for number in tested)
        return p_value_limits(shares, ERROR_RATE)[tested.index(count)]

    def look(
        self, session: Session, count: int, before: Look | None, rng: np.random.Generator
    ) -> Look:
        """Fit the first `count` configurations and judge them.

        Parameters
        ----------
        session
            With at least as many configurations to fit.
        count
            One of `counts`.
        before
            The look before this one: structure that was found stays found.
        rng
            Of the draws of the noise.
        """
        part, elapsed_s, pace_s = so_far(session, count)
        try:
            found = estimate(Problem.of(part, self.priors))
        except InsufficientDataError as error:
            return Look(count, elapsed_s, lacking=str(error))
        return self.judge(found, count, before, elapsed_s, pace_s, rng)

    def judge(
        self,
        found: Estimate,
        count: int,
        before: Look | None,
        elapsed_s: float,
        pace_s: float,
        rng: np.random.Generator,
    ) -> Look:
        """Judge a fit of `count` configurations, each of which has taken `pace_s`; see `look`."""
        goal, measurements = self.goal, found.problem.measurements
        counting = np.ones(len(measurements), bool)
        if goal.box is not None:
            tips = found.problem.chain.positions(measurements.q, np.zeros(3))
            counting = goal.box.holds(tips)
        precision = Precision.of(found, counting, rng)
        structure = before.structure if before is not None else ()
        if not structure:
            structure = self._structure(found, count)
        lacking = self._lacking(found, precision, structure)
        chain = found.problem.chain
        more: int | None = None
        if goal.stated:
            times = precision.times_the_data(goal.joint_std_rad, goal.tool_std_m)
            more = None if np.isinf(times) else int(np.ceil((times - 1.0) * count - 1e-9))
        return Look(
            count,
            elapsed_s,
            dict(zip(chain.joint_names, precision.joint_std, strict=True)),
            precision.joint_rms,
            precision.tool_rms,
            precision.freedom,
            precision.parameters,
            structure,
            lacking,
            more,
            np.nan if more is None else more * pace_s,
            tuple(compress(chain.joint_names, chain.slides)),
        )

    def is_enough(self, look: Look) -> bool:
        """Tell whether the collection may end after this look."""
        return self.goal.stated and not look.lacking

    def describe(self, look: Look) -> str:
        """Return what a look has found, and what more would cost, for people."""
        counted = f' ({1e3 * np.radians(LEVER_M):.2f} mm count as one)' * bool(look.sliding)
        known = (
            f'std of the offsets {np.degrees(look.joint_rms):.4f} deg{counted}, error of the '
            f'predicted markers {look.tool_rms * 1e3:.3f} mm (RMS)'
        )
        after = f'after {look.configurations} configurations'
        if look.structure:
            test = look.structure[0]
            return (
                f'{after}: {test.words()} ({test.chance}), which zero-offsets do not explain; all '
                'that is planned is measured, and discover looks for the cause'
            )
        if not self.goal.stated:
            return f'{after}: {known if look.joint_std else look.lacking}'
        if not look.lacking:
            return f'enough is known {after}: {known}; what is held out is still measured'
        return f'{after}: {look.lacking}; {self._cost(look)}'

    def _cost(self, look: Look) -> str:
        """Return what the goal costs beyond a look, for people."""
        if look.more is None:
            return 'not known what it costs'
        time = '' if np.isnan(look.more_s) else f', {look.more_s / 60:.1f} min'
        beyond = look.configurations + look.more - self.planned
        planned = f'; that is {beyond} more than planned' if beyond > 0 else ''
        return f'about {look.more} more configurations to fit{time}{planned}'

    def _structure(self, found: Estimate, count: int) -> tuple[StructureTest, ...]:
        limit = self.limit(count)
        if limit == 0.0:
            return ()
        tests = residual_structure(found.mode, found.problem.measurements).tests
        clear = [test for test in tests if test.p_value < limit / len(tests)]
        return tuple(sorted(clear, key=lambda test: test.p_value))

    def _lacking(
        self, found: Estimate, precision: Precision, structure: tuple[StructureTest, ...]
    ) -> str:
        goal, needed = self.goal, FREEDOM_PER_PARAMETER * precision.parameters
        if not goal.stated:
            return ''
        if goal.joint_std_rad is not None and precision.joint_rms > goal.joint_std_rad:
            return (
                f'the std of the offsets is {np.degrees(precision.joint_rms):.4f} deg, wanted is '
                f'{np.degrees(goal.joint_std_rad):.4f}'
            )
        if goal.tool_std_m is not None and precision.tool is None:
            return 'no configuration so far has the tool in poses.tool_box'
        if goal.tool_std_m is not None and precision.tool_rms > goal.tool_std_m:
            return (
                f'the error of the predicted markers is {precision.tool_rms * 1e3:.3f} mm, '
                f'wanted is {goal.tool_std_m * 1e3:.3f}'
            )
        if precision.freedom < needed:
            return f'{precision.freedom} degrees of freedom, needed are {needed}'
        pose = _one_each(found)
        if not self.floors.hold(pose):
            return (
                f'a search for causes needs {self.floors.poses} poses, {self.floors.repeated} of '
                'them in two solutions'
            )
        if structure:
            return f'{structure[0].words()}, and the std is that of an arm without such errors'
        return ''


def _one_each(found: Estimate) -> IntArray:
    """Return the pose of each configuration that was fitted."""
    measurements = found.problem.measurements
    kept = found.kept
    first = np.unique(measurements.configuration[kept], return_index=True)[1]
    return measurements.pose[kept][first]


def configurations(session: Session) -> int:
    """Return how many configurations to fit a session has."""
    measurements = session.measurements
    return len(np.unique(measurements.configuration[~measurements.is_validation]))


def so_far(session: Session, count: int) -> tuple[Session, float, float]:
    """Return a session up to its configuration number `count` to fit, with times.

    The session has what was held out by then as well. The times are from the first reading to the
    last one, s, NaN where nothing is known of it, and per configuration of any kind, s.
    """
    given = session.measurements
    fitted = np.flatnonzero(~given.is_validation)
    # Rows stand in the order of their measurement.
    first = np.sort(np.unique(given.configuration[fitted], return_index=True)[1])
    last = fitted[-1] + 1 if count >= len(first) else fitted[first[count]]
    part = session.select(np.arange(last))
    if not session.timed:
        return part, np.nan, np.nan
    every = [part.measurements]
    if session.references is not None:
        until = np.max(part.measurements.stamp_s)
        every.append(session.references.select(session.references.stamp_s <= until))
    stamps = np.concatenate([one.stamp_s for one in every])
    elapsed_s = float(np.ptp(stamps))
    # References have numbers of their own; each visit is a configuration.
    visits = sum(len(np.unique(one.configuration)) for one in every)
    return part, elapsed_s, elapsed_s / max(1, visits - 1)
