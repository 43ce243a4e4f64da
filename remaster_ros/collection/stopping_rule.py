# SPDX-License-Identifier: Apache-2.0
"""End of a collection by its precision, and the cost of a higher precision.

After every few configurations the session so far is fitted, to the posterior's mode without draws,
and the standard deviations are compared with the wanted ones. The looks are at fixed numbers of
configurations, so that they follow from the session alone: a restarted optimizer comes to the same
decision.

A goal counts as reached only

- with twice as many degrees of freedom as parameters, and the poses and repeats that a search for
causes needs (`planning.pose_design.Floors`): a fit of few observations sometimes states far too
small a standard deviation, and a rule would stop at exactly such a fit;
- while the residuals show no structure (`calibration.residual_structure`): with a wrong model the
standard deviations are too small. This test is made at many looks, and spends its error rate
(`calibration.group_sequential`).
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
"""Probability of falsely claimed structure, over all looks at the residuals. The p-values are not
exact with two dozen readings and an estimated noise: with 1 % spent structure was claimed in 14 of
1,000 sessions without any."""
MOST_TESTS = 20
"""Largest number of looks with a test: more looks reduce the power without an earlier finding."""


@dataclass(frozen=True)
class StoppingGoal:
    """Precision at which a collection ends; None for one that does not matter."""

    # Root mean square of the standard deviations of the identifiable joints, rad
    joint_std_rad: float | None = None
    # Root mean square of the 3-D error of the predicted markers in the box, m
    tool_std_m: float | None = None
    box: ToolBox | None = None  # None for all measured positions of the tool

    @classmethod
    def of(cls, poses: PoseSettings) -> StoppingGoal:
        """Goal of a cell file, in rad and m; an empty one if it states none.

        Empty also for an optimal design, if a precision that counts in it (of joints, of the
        tool) is not stated.
        """
        stated = (poses.joint_std_deg, poses.tool_std_m)
        matters = (poses.tool_share < 1.0, poses.tool_share > 0.0)
        if poses.design == OPTIMAL and None in compress(stated, matters):
            # The design then aims at the precision of the Latin hypercube, which is not stated.
            return cls()
        settings = poses.settings((), 0.0)
        return cls(settings.joint_std_rad, settings.tool_std_m, settings.box)

    @property
    def stated(self) -> bool:
        """Whether there is any goal."""
        return self.joint_std_rad is not None or self.tool_std_m is not None


@dataclass(frozen=True, eq=False)
class Look:
    """Result of a fit of the session so far: precision, structure of the residuals, cost."""

    configurations: int  # Number of measured configurations to fit
    # Time from the first to the last reading of these, s; NaN if the times are unknown
    elapsed_s: float
    # Standard deviation of each joint's offset, rad or m; None if it is not identifiable. Empty
    # without a fit.
    joint_std: Mapping[str, float | None] = field(default_factory=dict)
    # As in `StoppingGoal`, rad and m; infinite where unknown
    joint_rms: float = np.inf
    tool_rms: float = np.inf
    # Degrees of freedom, and free parameters
    freedom: int = 0
    parameters: int = 0
    structure: tuple[StructureTest, ...] = ()  # Structure of the residuals, clearest first
    lacking: str = ''  # Reason why this is not enough; '' if it is, or without a goal
    # Number of further configurations to fit for the goal: 0 if it is reached, None if no number
    # suffices or none is known
    more: int | None = None
    more_s: float = np.nan  # Their time at the pace so far, s; NaN if unknown
    sliding: tuple[str, ...] = ()  # Names of the joints that slide


@dataclass(frozen=True)
class StoppingRule:
    """Rule that ends a collection once a fit of the session so far is precise enough."""

    goal: StoppingGoal  # Wanted precision
    planned: int  # Number of planned configurations to fit
    every: int  # Configurations between two looks
    floors: Floors = field(default_factory=Floors)  # Least poses and repeats
    priors: Priors | None = None  # Priors of the fit, in place of those of the session

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of configurations after which the rule looks: every `every`, and at the end."""
        return (*range(self.every, self.planned, self.every), self.planned)

    def limit(self, count: int) -> float:
        """p-value below which a look finds structure; 0 if it makes no test.

        Tests are made at most at `MOST_TESTS` looks, the last one included. ``count``: number of
        configurations at the look.
        """
        step = -(-len(self.counts) // MOST_TESTS)
        tested = self.counts[::-1][::step][::-1]
        if count not in tested:
            return 0.0
        shares = tuple(number / self.planned for number in tested)
        return p_value_limits(shares, ERROR_RATE)[tested.index(count)]

    def look(
        self, session: Session, count: int, before: Look | None, rng: np.random.Generator
    ) -> Look:
        """Fit the first `count` configurations, and return precision, structure and cost.

        ``session``: with at least as many configurations to fit; ``count``: one of `counts`;
        ``before``: previous look, whose structure stays found; None for none; ``rng``: for the
        draws of the noise. With too few data for a fit the look says so in `lacking`.
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
        """Return precision, structure and cost of a fit of `count` configurations.

        See `look`. ``before``: the last look, whose structure is kept, None for the first;
        ``elapsed_s``: time measured so far; ``pace_s``: time per configuration, for the cost;
        ``rng``: for `Precision.of`.
        """
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
        """Whether the collection may end after this look: a goal is stated, and reached."""
        return self.goal.stated and not look.lacking

    def describe(self, look: Look) -> str:
        """Result of a look in a sentence for people: structure, what is known, cost."""
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
        """Cost of the goal after a look, in configurations and minutes, for people."""
        if look.more is None:
            return 'not known what it costs'
        time = '' if np.isnan(look.more_s) else f', {look.more_s / 60:.1f} min'
        beyond = look.configurations + look.more - self.planned
        planned = f'; that is {beyond} more than planned' if beyond > 0 else ''
        return f'about {look.more} more configurations to fit{time}{planned}'

    def _structure(self, found: Estimate, count: int) -> tuple[StructureTest, ...]:
        """Significant tests of structure in the residuals, by p-value; () if none is.

        () also if this look makes no test. Significant is below `limit` divided by the number
        of tests. ``count``: number of configurations at the look.
        """
        limit = self.limit(count)
        if limit == 0.0:
            return ()
        tests = residual_structure(found.mode, found.problem.measurements).tests
        clear = [test for test in tests if test.p_value < limit / len(tests)]
        return tuple(sorted(clear, key=lambda test: test.p_value))

    def _lacking(
        self, found: Estimate, precision: Precision, structure: tuple[StructureTest, ...]
    ) -> str:
        """Reason why the goal is not reached after a look; '' if reached or none is stated.

        In this order: joints, tool, degrees of freedom (`FREEDOM_PER_PARAMETER` times the
        parameters), poses and repeats (`floors`), structure of the residuals.
        """
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
        pose = _poses_of_configurations(found)
        if not self.floors.hold(pose):
            return (
                f'a search for causes needs {self.floors.poses} poses, {self.floors.repeated} of '
                'them in two solutions'
            )
        if structure:
            return f'{structure[0].words()}, and the std is that of an arm without such errors'
        return ''


def _poses_of_configurations(found: Estimate) -> IntArray:
    """Pose of each fitted configuration, (n,), by number of the configuration."""
    measurements = found.problem.measurements
    kept = found.kept
    first = np.unique(measurements.configuration[kept], return_index=True)[1]
    return measurements.pose[kept][first]


def configurations(session: Session) -> int:
    """Number of configurations to fit in a session."""
    measurements = session.measurements
    return len(np.unique(measurements.configuration[~measurements.is_validation]))


def so_far(session: Session, count: int) -> tuple[Session, float, float]:
    """Session up to its configuration number `count` to fit, with times.

    It has the held-out rows up to then as well. The times are from the first reading to the last
    one, s, NaN if unknown, and per configuration of any kind, s.
    """
    given = session.measurements
    fitted = np.flatnonzero(~given.is_validation)
    # Rows are in the order of their measurement.
    first = np.sort(np.unique(given.configuration[fitted], return_index=True)[1])
    last = fitted[-1] + 1 if count >= len(first) else fitted[first[count]]
    part = session.select(np.arange(last))
    if not session.timed:
        return part, np.nan, np.nan
    every = [part.measurements]
    if session.references is not None:
        until = np.max(part.measurements.stamp_s)
        every.append(session.references.select(session.references.stamp_s <= until))
    stamps = np.concatenate([rows.stamp_s for rows in every])
    elapsed_s = float(np.ptp(stamps))
    # References have numbers of their own; each visit is a configuration.
    visits = sum(len(np.unique(rows.configuration)) for rows in every)
    return part, elapsed_s, elapsed_s / max(1, visits - 1)
