# SPDX-License-Identifier: Apache-2.0
"""Choice of configurations that separate causes from look-alikes, which fit nearly equally well.

Configurations are added to those measured or planned, each the one that increases the separation
of the two (`rival_causes`) most, over all pairs in both directions. The configuration before each
counts as in the order of the choice; so joints are approached from both sides, by small and by
large moves, if that matters. Time and temperature are those at which the configurations will be
measured, as far as they are known.

If no configurations within the ranges separate two causes, none is measured for them, and a
sentence says what would separate them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from remaster_ros.discovery.effects.context import Context
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.linear_algebra import one_thread
from remaster_ros.planning.candidates import PlannedPose, PlanningScene
from remaster_ros.planning.design_information import DesignInformation, nominal_context
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.planning.rival_causes import (
    FoundCause,
    Rivals,
    in_words,
    rivals_of,
    separation,
    variances,
)
from remaster_ros.types import FloatArray, IntArray, Measurements, Priors

MOST_ADDED = 25
"""Most configurations that are added to a session."""
MOST_CANDIDATES = 1500
"""Most candidate configurations, about equally many of each pose."""
ELBOW_STEPS = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0])
"""Additions to the values of held joints in the cell file, rad; of a prismatic joint in
`SerialChain.per_radian`."""
DECIDED = 6.0
"""Separation at which two causes are decided, in standard deviations: odds of more than 1,000 to 1
even if the true one has three parameters more, with a reserve for a smaller size."""
HOPELESS = 2.0
"""Separation by all candidates together below which none is measured for a pair."""
BREAK_S = 300.0
"""Assumed time from the last reading of a session to the next ones, s."""


@dataclass(frozen=True)
class SeparatedPair:
    """The separation of a cause from a look-alike."""

    cause: str  # As text
    look_alike: str  # As text
    # Separation in standard deviations by the plan alone and with the additions, the smaller of
    # both directions
    before: float
    after: float


@dataclass(frozen=True)
class SeparatingDesign:
    """Configurations to measure, and the separations that they give."""

    poses: tuple[PlannedPose, ...]  # To add, each with its chosen solutions
    pairs: tuple[SeparatedPair, ...]  # Of the pairs that they separate
    otherwise: tuple[str, ...]  # Sentences on pairs that no configurations separate
    # Pose and solution of each visit, in the order of the choice
    order: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False)
class MeasuredSoFar:
    """Conditions of the configurations of a session, for causes driven by time or moves."""

    from_q: FloatArray  # Previous configuration of each, rad, (n, k)
    # (n,); NaN if unknown
    stamp_s: FloatArray
    temperature_c: FloatArray
    last_q: FloatArray  # Last configuration of the arm, rad, (k,)


def scene_with_other_elbows(scene: PlanningScene) -> PlanningScene:
    """Return a scene whose poses are also reached with the held joints at other values.

    Those of the cell file plus `ELBOW_STEPS`, within the limits; the same scene if no joint is
    held. Other postures of the arm at a pose separate causes that the posture of the plan does
    not.
    """
    chain = scene.model.chain
    margin = scene.limit_margin_rad * chain.per_radian
    low, high = chain.lower + margin, chain.upper - margin
    elbows = {
        joint: sorted(
            {
                float(np.clip(value + step, low[joint], high[joint]))
                for value in values
                for step in ELBOW_STEPS * chain.per_radian[joint]
            }
        )
        for joint, values in scene.inverse_kinematics.held.items()
    }
    return replace(scene, inverse_kinematics=InverseKinematics(chain, elbows)) if elbows else scene


def measured_so_far(rows: Measurements) -> tuple[tuple[PlannedPose, ...], MeasuredSoFar]:
    """Return the configurations to fit of a session by pose, and their conditions.

    Validation and reference rows are left out, one row for each configuration is kept. T_R_T of
    the poses is the identity: only their solutions count.
    """
    not_fitted = rows.is_validation if rows.is_reference is None else rows.is_reference
    to_fit = np.flatnonzero(~(rows.is_validation | not_fitted))
    _, first = np.unique(rows.configuration[to_fit], return_index=True)
    fitted = to_fit[first]
    fitted = fitted[np.argsort(rows.pose[fitted], kind='stable')]
    numbers = np.unique(rows.pose[fitted])
    poses = tuple(PlannedPose(np.eye(4), rows.q[fitted[rows.pose[fitted] == n]]) for n in numbers)
    last = rows.q[int(np.argmax(rows.stamp_s))]
    return poses, MeasuredSoFar(
        rows.from_q[fitted], rows.stamp_s[fitted], rows.temperature_c[fitted], last
    )


@one_thread
def separate(
    chain: SerialChain,
    planned: Sequence[PlannedPose],
    candidates: Sequence[PlannedPose],
    sensors: Sequence[ExpectedSensor],
    marker_std_m: float,
    causes: Sequence[FoundCause],
    priors: Priors,
    measured: MeasuredSoFar | None = None,
    most: int = MOST_ADDED,
) -> SeparatingDesign:
    """Choose configurations that separate causes from their look-alikes.

    ``chain``: the arm; ``planned``: poses that were or will be measured anyway; ``candidates``:
    poses that may be added, with their joint solutions; ``sensors, marker_std_m, priors``: as of
    `DesignInformation.of`; ``causes``: with their look-alikes; ``measured``: conditions of the
    configurations of `planned`, in their order; without it times and moves are unknown; ``most``:
    largest number of added configurations.
    """
    poses = [*planned, *_thinned(candidates)]
    choice = _Choice(chain, poses, len(planned), sensors, marker_std_m, priors, measured, most)
    not_separable = []
    for cause in causes:
        for name, joints, sentence in cause.look_alikes:
            first, second = in_words(cause.name, cause.joints), in_words(name, joints)
            rivals = rivals_of(choice.context(), cause, (name, joints))
            if rivals is None or not choice.add(first, second, rivals):
                not_separable.append(f'{first} and {second}: {sentence}')
    return choice.design(tuple(not_separable))


def _thinned(candidates: Sequence[PlannedPose]) -> list[PlannedPose]:
    """Return candidates with only every n-th solution of each pose, some `MOST_CANDIDATES` in all.

    The first of them differs from pose to pose; poses left without any are omitted. All are
    returned if there are no more than that.
    """
    count = sum(len(pose.solutions) for pose in candidates)
    step = max(1, -(-count // MOST_CANDIDATES))
    # Different solutions of each pose, so that all kinds remain.
    thinned = [
        replace(pose, solutions=pose.solutions[index % step :: step])
        for index, pose in enumerate(candidates)
    ]
    return [pose for pose in thinned if len(pose.solutions)]


@dataclass(eq=False)
class _Choice:
    """Choice of configurations that separate pairs of a cause and a look-alike."""

    chain: SerialChain
    poses: Sequence[PlannedPose]  # Planned ones first, `given` of them
    given: int
    sensors: Sequence[ExpectedSensor]
    marker_std_m: float
    priors: Priors
    measured: MeasuredSoFar | None
    most: int
    _pairs: list[tuple[str, str, tuple[Rivals, ...]]] = field(default_factory=list)
    _known: dict[Rivals, DesignInformation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = [len(pose.solutions) for pose in self.poses]
        self.q = np.concatenate([pose.solutions for pose in self.poses])
        self.number = np.repeat(np.arange(len(self.poses)), counts)
        self.place = np.concatenate([np.arange(count) for count in counts])
        self.done = list(range(sum(counts[: self.given])))
        self._model = nominal_model(self.chain, self.q, self.sensors, self.priors)
        self._rows = expected_measurements(self._model[0], self.q, self.number, self.sensors)
        self._from_q = np.full(self.q.shape, np.nan)
        if self.measured is not None:
            self._from_q[:] = self.measured.last_q
            self._from_q[self.done] = self.measured.from_q

    def context(self) -> Context:
        """Return the context of effects at all configurations, planned ones and candidates.

        Without `measured` there are no times and previous configurations. With it candidates
        are `BREAK_S` after the last reading, at its temperature, and come from the arm's last
        configuration, or from that chosen last.
        """
        context, measured = nominal_context(*self._model, self._rows), self.measured
        if measured is None:
            return context
        n, row, from_q = len(self.q), self._rows.configuration, self._from_q
        stamp_s = np.full(n, np.nanmax(measured.stamp_s) + BREAK_S)
        stamp_s[self.done] = measured.stamp_s
        last = measured.temperature_c[int(np.nanargmax(measured.stamp_s))]
        temperature_c = np.full(n, last)
        temperature_c[self.done] = measured.temperature_c
        rows = replace(
            self._rows, from_q=from_q[row], stamp_s=stamp_s[row], temperature_c=temperature_c[row]
        )
        return replace(context, measurements=rows, timed=True)

    def add(self, first: str, second: str, rivals: Rivals) -> bool:
        """Add a pair of causes to be separated; return whether it was added.

        It is not if the separation by all configurations is below `HOPELESS`. ``first,
        second``: cause and look-alike as text.
        """
        information = self._information(rivals)
        both: tuple[Rivals, ...] = rivals, rivals.imitation(information, self.done)
        every = range(len(self.q))
        if rivals.nested:
            # The cause can imitate any nested look-alike: only this direction is tested.
            both = (rivals,)
        if min(separation(self._information(pair), every) for pair in both) < HOPELESS:
            return False
        self._pairs.append((first, second, both))
        return True

    def _information(self, rivals: Rivals) -> DesignInformation:
        """Return the information of all configurations with the columns of a pair of causes.

        Computed at the first call for a pair, and kept for later ones.
        """
        if rivals not in self._known:
            self._known[rivals] = DesignInformation.of(
                self.chain,
                self.poses,
                self.sensors,
                self.marker_std_m,
                self.priors,
                extra=rivals.columns(self.context()),
            )
        return self._known[rivals]

    def design(self, otherwise: tuple[str, ...]) -> SeparatingDesign:
        """Choose the configurations that separate the added pairs best; return the design.

        One by one until all pairs are separated by `DECIDED` or `most` are chosen; with each
        pair's separation before and after. ``otherwise``: sentences on pairs that were not
        added.
        """
        separations = [self._separation(both, self.done) for _, _, both in self._pairs]
        chosen = self._most_separating()
        added, order = self._as_poses(chosen)
        measured_indices = [*self.done, *chosen]
        return SeparatingDesign(
            added,
            tuple(
                SeparatedPair(
                    first, second, separation_before, self._separation(both, measured_indices)
                )
                for (first, second, both), separation_before in zip(
                    self._pairs, separations, strict=True
                )
            ),
            otherwise,
            order,
        )

    def _separation(self, both: tuple[Rivals, ...], chosen: Sequence[int]) -> float:
        """Return the smallest separation of a pair, over its one or two directions.

        ``both``: the pair, and the reversed one unless it is nested; ``chosen``: indices of
        the configurations measured.
        """
        return min(separation(self._information(pair), chosen) for pair in both)

    def _most_separating(self) -> list[int]:
        """Return the indices of the configurations that separate the pairs best, one by one.

        Until all pairs are separated by `DECIDED`, or `most` are chosen. Each is the candidate
        with the largest sum, over the undecided pairs, of the log ratio of the amplitude's
        variance before and with it.
        """
        chosen: list[int] = []
        remaining = np.arange(len(self.done), len(self.q))
        directions = [pair for _, _, both in self._pairs for pair in both]
        while len(chosen) < self.most and len(remaining):
            measured_indices = [*self.done, *chosen]
            undecided = [
                pair
                for pair in directions
                if separation(self._information(pair), measured_indices) < DECIDED
            ]
            if not undecided:
                break
            gain = np.zeros(len(remaining))
            for pair in undecided:
                information = self._information(pair)
                separations = variances(information, information.total(measured_indices)[None])[0]
                gain += np.log(
                    separations
                    / variances(information, information.with_each(measured_indices, remaining))
                )
            best = int(remaining[int(np.argmax(gain))])
            chosen.append(best)
            remaining = remaining[remaining != best]
            self._approach_from(self.q[best], remaining, directions)
        return chosen

    def _approach_from(
        self, q: FloatArray, remaining: IntArray, directions: Sequence[Rivals]
    ) -> None:
        """Set the previous configuration of all remaining candidates to q, rad or m, (k,).

        The kept information of pairs that depend on it is dropped, to be computed anew.
        Nothing without `measured`. ``remaining``: indices; ``directions``: all pairs.
        """
        if self.measured is not None:
            self._from_q[remaining] = q
            for pair in directions:
                if pair.depends_on_approach:
                    del self._known[pair]

    def _as_poses(
        self, chosen: Sequence[int]
    ) -> tuple[tuple[PlannedPose, ...], tuple[tuple[int, int], ...]]:
        """Return the poses of chosen configurations, and the order of the visits.

        ``chosen``: indices, in their order; the order has pose and solution of each, from 0.
        """
        numbers = list(dict.fromkeys(int(self.number[index]) for index in chosen))
        members = [[i for i in chosen if self.number[i] == number] for number in numbers]
        poses = tuple(
            PlannedPose(self.poses[number].T_R_T, self.q[which])
            for number, which in zip(numbers, members, strict=True)
        )
        order = tuple(
            (
                numbers.index(int(self.number[i])),
                members[numbers.index(int(self.number[i]))].index(i),
            )
            for i in chosen
        )
        return poses, order
