# SPDX-License-Identifier: Apache-2.0
"""Configurations that tell two causes apart, which explain what was measured nearly as well.

Configurations are added to those that were measured or are planned, each the one that adds the
most to the difference of the two (`rival_causes`), over all pairs and both ways round. What
depends on the way to a configuration counts as if they are visited in the order of the choice; so
joints are approached from both sides, by small and by large moves, where that decides. Time and
temperature are those at which they will be measured, as far as that is known.

Where all that the ranges allow does not tell two causes apart, nothing is measured for them, and
what would decide is said in words.
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
    apart,
    in_words,
    rivals_of,
    variances,
)
from remaster_ros.types import FloatArray, IntArray, Measurements, Priors

MOST_FURTHER = 25
"""Configurations that may be added."""
MOST_CANDIDATES = 1500
"""Configurations that are chosen from at most: about as many for each pose."""
ELBOW_STEPS = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0])
"""Held joints are tried so far from their values in the cell file, rad; one that slides by as much
as counts as that."""
DECIDED = 6.0
"""Standard deviations between two causes that decide: odds of more than 1,000 to 1 are left of
them where the true one needs three parameters more, with a reserve for a smaller size."""
HOPELESS = 2.0
"""A pair that all candidates together tell apart by less is not measured for."""
BREAK_S = 300.0
"""How long after the last reading the next ones are taken, as long as nobody knows."""


@dataclass(frozen=True)
class Separated:
    """How two causes are told apart."""

    # In words
    cause: str
    look_alike: str
    # Standard deviations between the two, by the plan alone and with what is added: of both ways
    # round the smaller
    before: float
    after: float


@dataclass(frozen=True)
class SeparatingDesign:
    """What to measure."""

    poses: tuple[PlannedPose, ...]  # To add, each with the solutions that were chosen
    pairs: tuple[Separated, ...]  # What they separate
    otherwise: tuple[str, ...]  # Sentences on pairs that no choice of configurations separates
    # Pose and solution of each visit, in the order of the choice
    order: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False)
class MeasuredSoFar:
    """What a session has of its configurations to fit, for causes that time or ways drive."""

    from_q: FloatArray  # Where the arm came from to each, rad, (n, k)
    # (n,); NaN where unknown
    stamp_s: FloatArray
    temperature_c: FloatArray
    last_q: FloatArray  # Where the arm stood last, rad, (k,)


def further_scene(scene: PlanningScene) -> PlanningScene:
    """Return a scene whose poses are also reached with the held joints elsewhere.

    Other arms' postures at the same poses separate what the plan's own do not.
    """
    chain = scene.model.chain
    margin = scene.limit_margin_rad * chain.per_radian
    low, high = chain.lower + margin, chain.upper - margin
    held = {
        joint: sorted(
            {
                float(np.clip(value + step, low[joint], high[joint]))
                for value in values
                for step in ELBOW_STEPS * chain.per_radian[joint]
            }
        )
        for joint, values in scene.inverse_kinematics.held.items()
    }
    return replace(scene, inverse_kinematics=InverseKinematics(chain, held)) if held else scene


def measured_so_far(rows: Measurements) -> tuple[tuple[PlannedPose, ...], MeasuredSoFar]:
    """Return the configurations to fit of a session by pose, and what is known of them."""
    other = rows.is_validation if rows.is_reference is None else rows.is_reference
    to_fit = np.flatnonzero(~(rows.is_validation | other))
    _, first = np.unique(rows.configuration[to_fit], return_index=True)
    kept = to_fit[first]
    kept = kept[np.argsort(rows.pose[kept], kind='stable')]
    numbers = np.unique(rows.pose[kept])
    poses = tuple(PlannedPose(np.eye(4), rows.q[kept[rows.pose[kept] == n]]) for n in numbers)
    last = rows.q[int(np.argmax(rows.stamp_s))]
    return poses, MeasuredSoFar(
        rows.from_q[kept], rows.stamp_s[kept], rows.temperature_c[kept], last
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
    most: int = MOST_FURTHER,
) -> SeparatingDesign:
    """Choose configurations that separate causes from their look-alikes.

    ``chain``: the arm; ``planned``: what is measured anyway, or was; ``candidates``: poses that
    can be added, each with the solutions that can be measured; ``sensors, marker_std_m, priors``:
    as of `DesignInformation.of`; ``causes``: that were found; ``measured``: of the configurations
    of `planned`, in their order, where they were measured: without it nothing is known of times
    and ways; ``most``: configurations that may be added.
    """
    poses = [*planned, *_thinned(candidates)]
    choice = _Choice(chain, poses, len(planned), sensors, marker_std_m, priors, measured, most)
    otherwise = []
    for cause in causes:
        for name, joints, words in cause.look_alikes:
            first, second = in_words(cause.name, cause.joints), in_words(name, joints)
            rivals = rivals_of(choice.context(), cause, (name, joints))
            if rivals is None or not choice.add(first, second, rivals):
                otherwise.append(f'{first} and {second}: {words}')
    return choice.design(tuple(otherwise))


def _thinned(candidates: Sequence[PlannedPose]) -> list[PlannedPose]:
    """Return the candidates with fewer solutions of each where there are too many."""
    count = sum(len(pose.solutions) for pose in candidates)
    step = max(1, -(-count // MOST_CANDIDATES))
    # Others of each pose, so that all kinds of solutions remain.
    thinned = [
        replace(pose, solutions=pose.solutions[index % step :: step])
        for index, pose in enumerate(candidates)
    ]
    return [pose for pose in thinned if len(pose.solutions)]


@dataclass(eq=False)
class _Choice:
    """The pairs, and the configurations to choose from."""

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
        """Return what effects depend on, for an arm that comes from where it was last."""
        context, known = nominal_context(*self._model, self._rows), self.measured
        if known is None:
            return context
        n, row, from_q = len(self.q), self._rows.configuration, self._from_q
        stamp_s = np.full(n, np.nanmax(known.stamp_s) + BREAK_S)
        stamp_s[self.done] = known.stamp_s
        last = known.temperature_c[int(np.nanargmax(known.stamp_s))]
        temperature_c = np.full(n, last)
        temperature_c[self.done] = known.temperature_c
        rows = replace(
            self._rows, from_q=from_q[row], stamp_s=stamp_s[row], temperature_c=temperature_c[row]
        )
        return replace(context, measurements=rows, timed=True)

    def add(self, first: str, second: str, rivals: Rivals) -> bool:
        """Take a pair; return False where all candidates do not tell the two apart."""
        information = self._information(rivals)
        both: tuple[Rivals, ...] = rivals, rivals.imitation(information, self.done)
        every = range(len(self.q))
        if rivals.nested:
            # The larger one explains whatever the other does: it is tested against that alone.
            both = (rivals,)
        if min(apart(self._information(one), every) for one in both) < HOPELESS:
            return False
        self._pairs.append((first, second, both))
        return True

    def _information(self, rivals: Rivals) -> DesignInformation:
        if rivals not in self._known:
            self._known[rivals] = DesignInformation.of(
                self.chain,
                self.poses,
                self.sensors,
                self.marker_std_m,
                self.priors,
                further=rivals.columns(self.context()),
            )
        return self._known[rivals]

    def design(self, otherwise: tuple[str, ...]) -> SeparatingDesign:
        """Choose."""
        before = [self._apart(both, self.done) for _, _, both in self._pairs]
        chosen = self._chosen()
        kept, order = self._kept(chosen)
        now = [*self.done, *chosen]
        return SeparatingDesign(
            kept,
            tuple(
                Separated(first, second, was, self._apart(both, now))
                for (first, second, both), was in zip(self._pairs, before, strict=True)
            ),
            otherwise,
            order,
        )

    def _apart(self, both: tuple[Rivals, ...], chosen: Sequence[int]) -> float:
        return min(apart(self._information(one), chosen) for one in both)

    def _chosen(self) -> list[int]:
        """Return the configurations that add the most, one after the other, until decided."""
        chosen: list[int] = []
        left = np.arange(len(self.done), len(self.q))
        ways = [one for _, _, both in self._pairs for one in both]
        while len(chosen) < self.most and len(left):
            now = [*self.done, *chosen]
            undecided = [one for one in ways if apart(self._information(one), now) < DECIDED]
            if not undecided:
                break
            gain = np.zeros(len(left))
            for one in undecided:
                information = self._information(one)
                before = variances(information, information.total(now)[None])[0]
                gain += np.log(before / variances(information, information.with_each(now, left)))
            best = int(left[int(np.argmax(gain))])
            chosen.append(best)
            left = left[left != best]
            self._go_on(self.q[best], left, ways)
        return chosen

    def _go_on(self, q: FloatArray, left: IntArray, ways: Sequence[Rivals]) -> None:
        """Let the arm come to all that is left from these joints, rad, (k,)."""
        if self.measured is not None:
            self._from_q[left] = q
            for one in ways:
                if one.by_the_way:
                    del self._known[one]

    def _kept(
        self, chosen: Sequence[int]
    ) -> tuple[tuple[PlannedPose, ...], tuple[tuple[int, int], ...]]:
        """Return the poses of what was chosen, and the order of the visits."""
        numbers = list(dict.fromkeys(int(self.number[index]) for index in chosen))
        mine = [[i for i in chosen if self.number[i] == number] for number in numbers]
        poses = tuple(
            PlannedPose(self.poses[number].T_R_T, self.q[which])
            for number, which in zip(numbers, mine, strict=True)
        )
        order = tuple(
            (numbers.index(int(self.number[i])), mine[numbers.index(int(self.number[i]))].index(i))
            for i in chosen
        )
        return poses, order
