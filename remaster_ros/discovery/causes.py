"""Which causes are named: the smallest set that explains what the offsets leave.

Forward by the evidence, one cell or a whole family (`random_effects`) at a time; after each step
whatever the evidence does not need any more is dropped, and each cell is exchanged for what
explains more in its place, since the first steps act on mixtures of causes. A family that joins
gives way to single members of its kind where these explain as much.

Cells of K kinds are tried. With the prior probability 1/K of its kind and 1/c of one of c cells of
it, the sum of all Bayes factors has the expectation 1 where nothing is there (but for noise and
variances, which are estimated); by Markov's inequality the best cell raises the log evidence by g
with a probability of at most K exp(−g). That is the p-value of a cause, and the price of a name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.random_effects import Family
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import Catalogue, screen
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import BoolArray

# Of naming something where nothing is.
SIGNIFICANCE = 0.05
NAMED = float(np.log(len(EFFECTS) / SIGNIFICANCE))
# What the evidence does not miss at odds of twenty to one is dropped; nor do these odds decide
# between two causes.
NEEDED = 3.0
# The evidence must rise by this for an exchange: equals are not exchanged again and again.
HYSTERESIS = 0.5
# Of the best by the screening, which has the noise and the variances of the set before.
SHORTLIST = 3
# Exchanges of a set that is larger would take longer than the search.
MOST_EXCHANGED = 7
# Fewer members are no family.
FEWEST_MEMBERS = 3
# A search ends after so many steps; real arms of six joints take up to ten.
MOST_STEPS = 16

FAMILIES: tuple[tuple[str, ...], ...] = tuple(
    tuple(name for name, effect in EFFECTS.items() if effect.family == family)
    for family in dict.fromkeys(effect.family for effect in EFFECTS.values() if effect.family)
)
"""Names of the effects of each family: what strikes all joints or links alike."""


class Search:
    """The search on one set of residuals.

    ``data``: the residuals; ``cells``: all that are tried; ``progress``: called with the share
    that is done.
    """

    def __init__(
        self,
        data: Residuals,
        cells: Sequence[Cell],
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        self.data, self.cells = data, tuple(cells)
        self.progress = progress
        self.families = []
        for names in FAMILIES:
            members = [c for c in cells if c.name in names and EFFECTS[c.name].in_family(c)]
            if len(members) >= FEWEST_MEMBERS:
                family = Family.of(data, f'all of {names[0]}', members)
                self.families += [family] if family is not None else []
        self._fits: dict[frozenset[Cell], Solution | None] = {}

    @cached_property
    def catalogue(self) -> Catalogue:
        """All that is tried, with its columns: most of the memory of a search; see `let_go`."""
        return Catalogue.of(self.data, self.cells)

    def let_go(self) -> None:
        """Let go of the columns of all that is tried; fits need none of them."""
        self.__dict__.pop('catalogue', None)

    def run(self) -> Solution:
        """Return the fit with the causes, families as their one cell."""
        solution = self.fit(())
        assert solution is not None
        for count in range(MOST_STEPS):
            self.progress(count / (count + 2.0))
            best = self._best(solution)
            if best is None or best.log_evidence < solution.log_evidence + NAMED:
                break
            solution = self._exchanged(self.pruned(self._split(best)))
            solution = self.dated(solution)
        return self._specific(solution)

    def again(self, data: Residuals, solution: Solution) -> tuple[Search, Solution]:
        """Return the search on other rows, and the same causes there as far as they are needed.

        What happened at one moment is dated again: the rows beside it may have been left out.
        """
        self.let_go()
        search = Search(data, self.cells, self.progress)
        families = {family.cell.name: family.cell for family in search.families}
        cells = [families.get(cell.name, cell) for cell in solution.cells]
        fitted = search.fit(cells, solution)
        if fitted is None:
            return self, solution
        return search, search.dated(search.pruned(fitted))

    def fit(self, cells: Sequence[Cell], start: Solution | None = None) -> Solution | None:
        """Fit a set; None for two cells of the same parameters, or of a sign physics excludes."""
        # A family has the parameters of its members: none of these is fitted beside it.
        of_family = {family.cell: family.parameters for family in self.families}
        names = [name for cell in cells for name in of_family.get(cell, cell.parameters)]
        if len(set(names)) < len(names) or not self.data.leaves_noise(cells):
            return None
        wanted = frozenset(cells)
        if wanted not in self._fits:
            self._fits[wanted] = solve(self.data, cells, start)
        found = self._fits[wanted]
        return None if found is None or found.unphysical() else found

    def pruned(self, solution: Solution) -> Solution:
        """Return what is left when all that the evidence does not need is dropped."""
        while solution.cells:
            rows = len(self.data)
            without = [solution.evidence_without(i, rows) for i in range(len(solution.cells))]
            least = solution.cells[int(np.argmax(without))]
            rest = self.fit([cell for cell in solution.cells if cell is not least], solution)
            if rest is None or rest.log_evidence < solution.log_evidence - NEEDED:
                break
            solution = rest
        return solution

    def in_place(
        self,
        rest: Solution,
        least: float,
        chosen: BoolArray | None = None,
        *,
        known_noise: bool = True,
    ) -> Iterator[Solution]:
        """Give fits of a set with one more cell, for the best by the screening.

        Only where the screening promises a log evidence of no less than `least`, to within what
        noise and variances that settle again may add. ``known_noise``: see `screen`.
        """
        chosen = self.catalogue.cheap if chosen is None else chosen
        score = screen(self.data, self.catalogue, rest, chosen=chosen, known_noise=known_noise)
        for index in np.argsort(-score)[:SHORTLIST]:
            if np.isfinite(score[index]) and rest.log_evidence + score[index] > least - NEEDED:
                found = self.fit((*rest.cells, self.cells[index]), rest)
                if found is not None:
                    yield found

    def without(self, solution: Solution, cell: Cell) -> Solution:
        """Return the fit without a cell, with noise and variances as they are."""
        index = solution.cells.index(cell)
        evidence = solution.evidence_without(index, len(self.data)) + np.log(cell.drawn_from)
        return solution.less(index, float(evidence))

    def dated(self, solution: Solution) -> Solution:
        """Return the fit with moments that none nearby is better than."""
        for _ in range(MOST_STEPS):
            before = [cell.moment for cell in solution.cells]
            solution = refine_moments(solution, self.cells, self.data.part, self.fit)
            if np.array_equal(before, [cell.moment for cell in solution.cells], equal_nan=True):
                break
        return solution

    def _best(self, solution: Solution) -> Solution | None:
        """Return the best fit with one cell or family more."""
        score = screen(self.data, self.catalogue, solution)
        order = np.argsort(-score)[:SHORTLIST].tolist()
        # Structure hides in the noise common to a pose, and shows when that is estimated again.
        order += [i for i in np.flatnonzero(self.catalogue.structure) if i not in order]
        cells = [self.cells[i] for i in order if np.isfinite(score[i])]
        cells += [one.cell for one in self.families if one.cell not in solution.cells]
        return _best([self.fit((*solution.cells, cell), solution) for cell in cells])

    def _split(self, solution: Solution) -> Solution:
        """Return single cells in place of a family, of its kind or any, that explain as much."""
        for family in self.families:
            if family.cell not in solution.cells:
                continue
            rest = self.fit([c for c in solution.cells if c is not family.cell], solution)
            if rest is None:
                continue
            names = {member.name for member in family.members}
            kind = self.catalogue.cheap & [c.name in names for c in self.cells]
            single = _best([self._grown(rest, kind), self._grown(rest, self.catalogue.cheap)])
            if single is not None and single.log_evidence > solution.log_evidence - NEEDED:
                solution = single
        return solution

    def _grown(self, solution: Solution, chosen: BoolArray) -> Solution:
        """Return a set with more of some cells, as long as the evidence rises."""
        while True:
            found = self.in_place(solution, solution.log_evidence, chosen, known_noise=False)
            more = _best(found)
            if more is None or more.log_evidence <= solution.log_evidence:
                return solution
            solution = more

    def _specific(self, solution: Solution) -> Solution:
        """Replace free forms by a shape of them that the evidence does not miss at these odds.

        A shape, such as that of an eccentric encoder, tells what to look for; the free form has
        it, too, and both explain the same errors.
        """
        for cell in solution.cells:
            shapes = self.catalogue.cheap & [is_special_case(other, cell) for other in self.cells]
            if shapes.any():
                least = solution.log_evidence - NEEDED
                best = _best(self.in_place(self.without(solution, cell), least, shapes))
                if best is not None and best.log_evidence > least:
                    solution = best
        return solution

    def _exchanged(self, solution: Solution) -> Solution:
        """Replace cells by what explains more in their place."""
        for _ in range(MOST_EXCHANGED):
            cells = solution.cells
            if len(cells) > MOST_EXCHANGED:
                break
            least = solution.log_evidence + HYSTERESIS
            singles = [self.without(solution, cell) for cell in cells]
            candidates = [fit for rest in singles for fit in self.in_place(rest, least)]
            best = _best(candidates)
            if best is None or best.log_evidence < solution.log_evidence + HYSTERESIS:
                break
            solution = self.pruned(best)
        return solution


def _best(fits: Iterable[Solution | None]) -> Solution | None:
    found = [fit for fit in fits if fit is not None]
    return max(found, key=lambda fit: fit.log_evidence, default=None)


def is_special_case(cell: Cell, form: Cell) -> bool:
    """Return whether a cell is one of the shapes that a free form can have."""
    return (
        form.penalty is not None
        and cell.penalty is None
        and (cell.place, cell.driver, cell.joints, cell.subject)
        == (form.place, form.driver, form.joints, form.subject)
    )


def refine_moments(
    solution: Solution,
    tried: Sequence[Cell],
    context: Context,
    fit: Callable[[Sequence[Cell], Solution], Solution | None],
) -> Solution:
    """Move what happened at one moment to the best moment and variant nearby."""
    for cell in solution.cells:
        if np.isnan(cell.moment) or (between := EFFECTS[cell.name].between) is None:
            continue
        moments = np.unique([other.moment for other in tried if other.name == cell.name])
        low = np.max(moments[moments < cell.moment], initial=-np.inf)
        high = np.min(moments[moments > cell.moment], initial=np.inf)
        rest = tuple(other for other in solution.cells if other is not cell)
        nearby = [
            other
            for other in between(context, float(low), float(high))
            if (other.place, other.joints, other.subject)
            == (cell.place, cell.joints, cell.subject)
        ]
        # All rows worked on may lie before or after what was tried on either side: then it stays.
        fits = [
            moved
            for other in nearby or [cell]
            if (moved := fit((*rest, other), solution)) is not None
        ]
        solution = _dated(fits) if fits else solution
    return solution


def _dated(fits: Sequence[Solution]) -> Solution:
    """Return the best of fits that differ in the moment of their last cell, with its std."""
    evidence = np.array([fit.log_evidence for fit in fits])
    best = fits[int(np.argmax(evidence))]
    weight = np.exp(evidence - evidence.max())
    moment = np.array([fit.cells[-1].moment for fit in fits])
    spread = np.sqrt(np.average((moment - best.cells[-1].moment) ** 2, weights=weight))
    dated = replace(best.cells[-1], moment_std=float(spread))
    return replace(best, cells=(*best.cells[:-1], dated))


def p_value(log_evidence_gain: float) -> float:
    """Return the largest probability that anything gains so much where nothing is there."""
    return float(min(1.0, len(EFFECTS) * np.exp(-log_evidence_gain)))


def grouped(cells: Sequence[Cell]) -> list[tuple[Cell, ...]]:
    """Return the cells of each cause together, in the order of their first."""
    groups: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        key: tuple[str, ...] = (cell.name, cell.driver, cell.form, cell.subject)
        cause_per = EFFECTS[cell.name].cause_per
        if cause_per != 'effect':
            key += (str(cell.joints), cell.label if cause_per == 'variant' else '')
        groups.setdefault(key, []).append(cell)
    return [tuple(group) for group in groups.values()]
