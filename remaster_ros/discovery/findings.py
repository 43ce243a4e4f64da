"""What a search found, before the model with it is sampled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.memory import Memory
from remaster_ros.discovery.repeated_search import RepeatedSearch
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.selection import Selection
from remaster_ros.discovery.set_aside import SetAside, remembering
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.thinning import Thinning


@dataclass(frozen=True, eq=False)
class Findings:
    """What is found before anything is sampled; fields as in `discover.Discovery`.

    ``before`` is the fit of the session as it is, without any effect, ``found`` the one that the
    search began with (its priors let moved markers go where they are), ``structure`` what the
    search located without a cause, ``aside`` the part of that which is not in the model.
    """

    before: Estimate
    found: Estimate
    residuals: Residuals
    selection: Selection
    groups: tuple[tuple[Cell, ...], ...]
    effects: tuple[FoundEffect, ...]
    structure: tuple[FoundEffect, ...]
    untestable: Mapping[str, str]
    thinning: Thinning | None
    aside: SetAside | None
    repeated: RepeatedSearch | None

    @property
    def searched(self) -> Solution:
        """The solution with all that the search located."""
        return self.selection.chosen if self.aside is None else self.aside.searched

    def not_combined(self) -> Findings:
        """Return the same with what the search of all rows found, by itself."""
        if self.repeated is None or self.selection.before_combining is None:
            return self
        chosen = self.selection.chosen
        return replace(
            self,
            selection=replace(self.selection, solution=chosen, before_combining=None),
            repeated=self.repeated.not_combined(chosen),
        )

    def without_causes(self) -> Findings:
        """Return the same as if the search had found nothing."""
        residuals = Residuals.of(self.before)
        empty = solve(residuals, ())
        assert empty is not None
        # What is refused is the causes, not that the errors follow each other.
        sensors = remembering(self.residuals, self.searched)
        memory = Memory.of(residuals, empty, sensors) if sensors else None
        return replace(
            self,
            found=self.before,
            residuals=residuals,
            selection=Selection(empty, empty, (), None),
            groups=(),
            effects=(),
            structure=(),
            thinning=None,
            aside=SetAside(empty, empty, memory) if memory else None,
            repeated=None,
        )
