# SPDX-License-Identifier: Apache-2.0
"""Two causes that explain what was measured nearly as well: by how much they would differ.

Of a cause A of a stated size and a look-alike B, what counts is how well the size of A is
determined while B has any size, and so have offsets, registrations and markers: the
non-centrality of the test between the two (T-optimality; Atkinson and Fedorov 1975,
doi:10.1093/biomet/62.1.57), which for models that are linear in their sizes is c-optimality of the
size of A in the joint model. With the amplitude s of A (1 as stated), 1 / std(s) is by how many
standard deviations the two differ.

Which of the two is true is not known, so both are asked: A of the size that was found against B,
and B of the size with which it imitates that A best in what was measured against A.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from remaster_ros.discovery.effects.base import LARGEST_M, Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.planning.design_information import DesignInformation, FurtherColumns
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.discovery.explain import FoundEffect

AMPLITUDE = 'amplitude'
FREE_STD = 1e3
"""Of the prior on an amplitude of about 1: nothing is known beforehand."""
BY_THE_WAY = ('approach', 'last_move')
"""Drivers that depend on the configuration before."""


@dataclass(frozen=True)
class FoundCause:
    """A cause as discovery.json has it."""

    # What it is; joints 1-based
    name: str
    joints: tuple[int, ...]
    sizes: Mapping[str, float]  # Parameter -> value, in its unit
    # Name, joints and, in words, which measurements separate it from each
    look_alikes: tuple[tuple[str, tuple[int, ...], str], ...]
    driver: str = ''  # What drives it, where its name leaves that open; ''

    @classmethod
    def of(cls, effect: FoundEffect) -> FoundCause:
        """Return an effect that was found with the look-alikes that can be separated from it."""
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
    """A cause of a stated size, and another of any size."""

    # Cells of the one and their parameters, (m,)
    found: tuple[Cell, ...]
    size: FloatArray
    other: tuple[Cell, ...]  # Cells of the other

    @property
    def by_the_way(self) -> bool:
        """Whether what they differ in depends on the configuration before."""
        return any(
            name in cell.driver for cell in (*self.found, *self.other) for name in BY_THE_WAY
        )

    @property
    def nested(self) -> bool:
        """Whether the other is a part of the one."""
        own = {name for cell in self.found for name in cell.parameters}
        return all(name in own for cell in self.other for name in cell.parameters)

    def columns(self, context: Context) -> FurtherColumns:
        """Return the amplitude of the one and the parameters of the other."""
        std = []
        for cell in self.other:
            largest = cell.largest
            shift = cell.columns(context).displacement(context)
            std.append(np.full(cell.size, largest) if largest else LARGEST_M / _rms(shift))
        names = [name for cell in self.other for name in cell.parameters]
        return FurtherColumns(
            (AMPLITUDE, *names),
            partial(self._displacement, context),
            np.concatenate(([FREE_STD], *std)),
        )

    def _displacement(self, context: Context, nominal: Context) -> FloatArray:
        one = _shifts(context, self.found) @ self.size
        return np.concatenate((one[:, :, None], _shifts(context, self.other)), axis=2)

    def imitation(self, information: DesignInformation, measured: Sequence[int]) -> Rivals:
        """Return the other way round: the other of the size that imitates the one best.

        ``information``: with `columns`; ``measured``: the configurations on which it does.
        """
        matrix = information.finite(information.total(measured))
        place = information.names.index(AMPLITUDE)
        rest = np.delete(np.arange(len(matrix)), place)
        fitted = np.zeros(len(matrix))
        fitted[rest] = np.linalg.solve(matrix[np.ix_(rest, rest)], matrix[rest, place])
        natural = fitted * information.scale / information.scale[place]
        return Rivals(self.other, natural[place + 1 :], self.found)


def rivals_of(
    context: Context, cause: FoundCause, look_alike: tuple[str, tuple[int, ...]]
) -> Rivals | None:
    """Return a cause and a look-alike; None where this context shows not both of them."""
    found = _found_cells(context, cause)
    other = _largest_cell(context, *look_alike)
    if not found or other is None:
        return None
    size = [cause.sizes[name] for cell in found for name in cell.parameters]
    return Rivals(found, np.array(size), (other,))


def _found_cells(context: Context, cause: FoundCause) -> tuple[Cell, ...]:
    """Return the cells that have the parameters of a cause between them; none without all."""
    found: list[Cell] = []
    left = {name for name in cause.sizes if name != 'moment'}
    cells = [
        cell
        for cell in _cells(context, cause.name)
        if {*cell.parameters} <= left and cause.driver in ('', cell.driver)
    ]
    for cell in sorted(cells, key=lambda cell: -cell.size):
        if {*cell.parameters} <= left:
            found.append(cell)
            left -= {*cell.parameters}
    return () if left else tuple(found)


def _largest_cell(context: Context, name: str, joints: tuple[int, ...]) -> Cell | None:
    """Return the variant of an effect with the most parameters, the most usual of these."""
    # What has no name is of any kind: its joints alone do not tell which.
    cells = [cell for cell in _cells(context, name) if cell.joints == joints]
    return max(cells, key=lambda cell: (cell.size, -cell.drawn_from), default=None)


def _cells(context: Context, name: str) -> list[Cell]:
    effect = EFFECTS.get(name)
    if effect is None or name == 'unnamed' or effect.needs(context):
        return []
    return [cell for cell in effect.cells(context) if np.isnan(cell.moment)]


def _shifts(context: Context, cells: Sequence[Cell]) -> FloatArray:
    return np.concatenate([c.columns(context).displacement(context) for c in cells], axis=2)


def _rms(shift: FloatArray) -> FloatArray:
    """Return the root mean square of each column's displacement, (m,)."""
    rms: FloatArray = np.sqrt(np.mean(np.sum(shift**2, axis=1), axis=0))
    return np.where(rms > 0.0, rms, 1.0)


def apart(information: DesignInformation, chosen: Sequence[int]) -> float:
    """Return by how many standard deviations two causes differ with chosen configurations."""
    return 1.0 / float(np.sqrt(variances(information, information.total(chosen)[None])[0]))


def variances(information: DesignInformation, matrices: FloatArray) -> FloatArray:
    """Return the variance of the amplitude with information (n, f, f), (n,)."""
    place = information.names.index(AMPLITUDE)
    finite = information.finite(matrices)
    unit = np.zeros((len(finite), finite.shape[1], 1))
    unit[:, place] = 1.0
    solved: FloatArray = np.linalg.solve(finite, unit)[:, place, 0] * information.scale[place] ** 2
    return solved


def in_words(name: str, joints: Sequence[int]) -> str:
    """Return a cause in a few words."""
    at = f' of joint{"s" * (len(joints) > 1)} {", ".join(map(str, joints))}' if joints else ''
    return f'{name.replace("_", " ")}{at}'
