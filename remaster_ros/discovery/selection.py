"""What a search for causes found, and in which steps."""

from __future__ import annotations

from dataclasses import dataclass

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.solution import Solution


@dataclass(frozen=True, eq=False)
class Step:
    """One cell set that joined: with what p-value, held-out gain and evidence."""

    cells: tuple[Cell, ...]
    p_value: float
    held_out_share: float
    log_evidence_gain: float


@dataclass(frozen=True, eq=False)
class Proposal:
    """A set one step on, with the p-value of the step."""

    solution: Solution
    p_value: float


@dataclass(frozen=True, eq=False)
class Selection:
    """The outcome: the fit without and with the cells, and how they were found.

    Attributes
    ----------
    empty, solution
        Fit of the offsets model alone, and with the cells of the model that is returned.
    steps
        What joined, in order.
    before_combining
        Where the solution has the cells of several searches, what the search of all rows found.
    """

    empty: Solution
    solution: Solution
    steps: tuple[Step, ...]
    before_combining: Solution | None = None

    @property
    def chosen(self) -> Solution:
        """What the search of all rows found."""
        return self.solution if self.before_combining is None else self.before_combining
