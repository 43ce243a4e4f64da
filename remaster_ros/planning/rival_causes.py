# SPDX-License-Identifier: Apache-2.0
"""Pairs of causes that explain the measurements nearly equally well, and their separation.

For a cause A of a stated size and a look-alike B, the separation is how well the size of A is
determined while the size of B, offsets, registrations and markers are free: the non-centrality of
the test between the two (T-optimality; Atkinson and Fedorov 1975, doi:10.1093/biomet/62.1.57),
which for models that are linear in their sizes is c-optimality of the size of A in the joint
model. With the amplitude s of A (1 as stated), the two differ by 1 / std(s) standard deviations.

Either of the two may be true, so both separations are computed: of A with the size that was found
from B, and of B, with the size that imitates that A best in the measurements, from A.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.discovery.effects.base import LARGEST_M, Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.planning.design_information import DesignInformation, ExtraColumns
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.discovery.explain import FoundEffect

AMPLITUDE = 'amplitude'
FREE_STD = 1e3
"""Standard deviation of the flat prior on an amplitude of about 1."""
APPROACH_DRIVERS = ('approach', 'last_move')
"""Drivers that depend on the previous configuration."""


@dataclass(frozen=True)
class FoundCause:
    """A cause of a discovery.json with its look-alikes."""

    name: str
    joints: tuple[int, ...]  # 1-based
    sizes: Mapping[str, float]  # Parameter -> value, in its unit
    # Name and joints of each look-alike, and a sentence on which measurements separate the two
    look_alikes: tuple[tuple[str, tuple[int, ...], str], ...]
    driver: str = ''  # '' if the name implies it

    @classmethod
    def of(cls, effect: FoundEffect) -> FoundCause:
        """Return a found effect, with those look-alikes that measurements can separate from it."""
        return cls(
            effect.name,
            effect.joints,
            {parameter.name: parameter.value for parameter in effect.parameters},
            tuple(
                (other.name, other.joints, other.separate_by)
                for other in effect.confusable_with
                if not (other.same or other.general)
            ),
            effect.driver,
        )


@dataclass(frozen=True, eq=False)
class Rivals:
    """A pair of causes: one of a stated size, and a look-alike of any size."""

    cause: tuple[Candidate, ...]
    size: FloatArray  # Parameters of the cause, in their units, (m,)
    look_alike: tuple[Candidate, ...]

    @property
    def depends_on_approach(self) -> bool:
        """Whether either cause depends on the configuration that the arm came from."""
        return any(
            name in candidate.driver
            for candidate in (*self.cause, *self.look_alike)
            for name in APPROACH_DRIVERS
        )

    @property
    def nested(self) -> bool:
        """Whether all parameters of the look-alike are also parameters of the cause."""
        names = {name for candidate in self.cause for name in candidate.parameters}
        return all(name in names for candidate in self.look_alike for name in candidate.parameters)

    def columns(self, context: Context) -> ExtraColumns:
        """Return the parameters for telling the pair apart: amplitude of the cause, look-alike.

        1 + m columns: the amplitude (1 as stated) and the m parameters of the look-alike.
        Priors: `FREE_STD` of the amplitude; of a parameter the largest plausible size of its
        effect, or what moves the markers by `LARGEST_M` (RMS). ``context``: conditions of the
        configurations.
        """
        std = []
        for candidate in self.look_alike:
            largest = candidate.largest
            shift = candidate.columns(context).displacement(context)
            std.append(np.full(candidate.size, largest) if largest else LARGEST_M / _rms(shift))
        names = [name for candidate in self.look_alike for name in candidate.parameters]
        return ExtraColumns(
            (AMPLITUDE, *names),
            partial(self._displacement, context),
            np.concatenate(([FREE_STD], *std)),
        )

    def _displacement(self, context: Context, nominal: Context) -> FloatArray:
        """Return the displacement of markers per unit of the `columns`, m, (n, 3, 1 + m).

        Computed in `context`; ``nominal``, which the caller passes, is not used.
        """
        amplitude = _shifts(context, self.cause) @ self.size
        return np.concatenate((amplitude[:, :, None], _shifts(context, self.look_alike)), axis=2)

    def imitation(self, information: DesignInformation, measured: Sequence[int]) -> Rivals:
        """Return the reversed pair: the look-alike with the size that imitates the cause best.

        ``information``: with the `columns` of this pair; ``measured``: indices of the
        configurations that are fitted. This pair is not changed; its cause of any size is the
        look-alike of the new one.
        """
        matrix = information.finite(information.total(measured))
        place = information.names.index(AMPLITUDE)
        free = np.delete(np.arange(len(matrix)), place)
        fitted = np.zeros(len(matrix))
        fitted[free] = np.linalg.solve(matrix[np.ix_(free, free)], matrix[free, place])
        natural = fitted * information.scale / information.scale[place]
        return Rivals(self.look_alike, natural[place + 1 :], self.cause)


def rivals_of(
    context: Context, cause: FoundCause, look_alike: tuple[str, tuple[int, ...]]
) -> Rivals | None:
    """Return the pair of a cause and a look-alike; None if the context lacks data for one.

    ``look_alike``: its name and joints, 1-based.
    """
    found = _found_candidates(context, cause)
    other = _largest_candidate(context, *look_alike)
    if not found or other is None:
        return None
    size = [cause.sizes[name] for candidate in found for name in candidate.parameters]
    return Rivals(found, np.array(size), (other,))


def _found_candidates(context: Context, cause: FoundCause) -> tuple[Candidate, ...]:
    """Return candidates whose parameters together are those of a found cause, each once.

    Greedy: a candidate with more parameters is taken first. 'moment' (of time) is not counted
    as a parameter. Only candidates of the cause's name and, if it has a driver, of that
    driver. () if they do not have all parameters.
    """
    found: list[Candidate] = []
    missing = {name for name in cause.sizes if name != 'moment'}
    candidates = [
        candidate
        for candidate in _candidates(context, cause.name)
        if {*candidate.parameters} <= missing and cause.driver in ('', candidate.driver)
    ]
    for candidate in sorted(candidates, key=lambda candidate: -candidate.size):
        if {*candidate.parameters} <= missing:
            found.append(candidate)
            missing -= {*candidate.parameters}
    return () if missing else tuple(found)


def _largest_candidate(context: Context, name: str, joints: tuple[int, ...]) -> Candidate | None:
    """Return the candidate of an effect and joints with the most parameters; None without any.

    ``name``: of the effect; ``joints``: those of the candidate, 1-based.
    """
    candidates = [
        candidate for candidate in _candidates(context, name) if candidate.joints == joints
    ]
    return max(
        candidates, key=lambda candidate: (candidate.size, -candidate.drawn_from), default=None
    )


def _candidates(context: Context, name: str) -> list[Candidate]:
    """Return all candidates of a named effect that this context has data for.

    Those of a change at one moment of time are left out; [] for an unknown name or
    ``unnamed``.
    """
    effect = EFFECTS.get(name)
    if effect is None or name == 'unnamed' or effect.needs(context):
        return []
    return [candidate for candidate in effect.candidates(context) if np.isnan(candidate.moment)]


def _shifts(context: Context, candidates: Sequence[Candidate]) -> FloatArray:
    """Return displacements per unit of the parameters of one or more candidates, m, (n, 3, m)."""
    return np.concatenate([c.columns(context).displacement(context) for c in candidates], axis=2)


def _rms(shift: FloatArray) -> FloatArray:
    """Return the RMS length of the displacements of each column, (m,); 1 for a column of zeros.

    ``shift``: displacements of n rows, (n, 3, m).
    """
    rms: FloatArray = np.sqrt(np.mean(np.sum(shift**2, axis=1), axis=0))
    return np.where(rms > 0.0, rms, 1.0)


def separation(information: DesignInformation, chosen: Sequence[int]) -> float:
    """Return the separation of a pair of causes by chosen configurations, in standard deviations.

    It is 1 over the standard deviation of the amplitude of the first. ``information``: with
    the columns of `Rivals.columns`; ``chosen``: indices of configurations.
    """
    return 1.0 / float(np.sqrt(variances(information, information.total(chosen)[None])[0]))


def variances(information: DesignInformation, matrices: FloatArray) -> FloatArray:
    """Return the variance of a cause's amplitude for each of n information matrices, (n,).

    With the ridge `UNKNOWN`, so that it is finite. ``information``: with the columns of
    `Rivals.columns`; ``matrices``: in its units, (n, f, f).
    """
    place = information.names.index(AMPLITUDE)
    finite = information.finite(matrices)
    unit = np.zeros((len(finite), finite.shape[1], 1))
    unit[:, place] = 1.0
    solved: FloatArray = np.linalg.solve(finite, unit)[:, place, 0] * information.scale[place] ** 2
    return solved


def in_words(name: str, joints: Sequence[int]) -> str:
    """Return a cause as text, such as "backlash of joint 4", "backlash of joints 4, 5".

    ``joints``: 1-based; without any, the name alone.
    """
    at = f' of joint{"s" * (len(joints) > 1)} {", ".join(map(str, joints))}' if joints else ''
    return f'{name.replace("_", " ")}{at}'
