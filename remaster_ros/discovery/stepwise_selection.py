"""Stepwise selection of cells: forward by the evidence, alone or in families, and backward.

A round screens all cells beside the set found so far and tries the best of them, and every
physical group as a whole (all joints compliant, all links wrong), less the members that do not
raise the evidence. The proposal of the highest evidence that passes two tests joins: its p-value
over all cells tried, and its gain on poses left out in turn. After each round, cells that no
longer raise the evidence are dropped, and each is swapped for what explains more in its place: the
first step acts on a mixture of causes. When nothing passes any more, families that imitate each
other are chosen anew, and the rounds go on from there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.cross_validation import Comparisons, worth_of
from remaster_ros.discovery.dating import refine_moments
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.families import (
    WHOLE,
    evidence_without,
    family_log_prior,
    grouped,
    relatives,
    visible,
)
from remaster_ros.discovery.proposals import SIGNIFICANCE, propose
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import Screening, screen
from remaster_ros.discovery.selection import Proposal, Selection, Step
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.substitutes import has_a_name, named_instead, regrown

DRAWS = 300
# Error of keeping a member of a family that has passed as a whole.
SIGNIFICANCE_OF_ONE = 0.05
DRAWS_OF_ONE = 200
ROUNDS = 8
FOLDS = 10
# What leaves less than this share of the held-out error out is not worth a parameter.
LEAST_GAIN = 0.01
# With noise and smoothness as they are: a cause that saves this share predicts.
NEEDED = 0.1
# Where the evidence rises by this, odds of 150 to one, the poses left out have only not to speak
# against it: their standard error is on its side.
EVIDENT = 5.0
# The evidence must rise by this for an exchange: equals are not exchanged again and again.
HYSTERESIS = 0.5
MOST_EXCHANGED = 6
MOST_MERGED = 4
# A member of a family has to raise the evidence by this: a free form of no size costs nothing.
MEMBER = 1.0
# The best noise for one cell less makes up for no greater loss of evidence.
SETTLING = 0.5
# Fits kept, each with the covariance of all its parameters.
KEPT_FITS = 48
# A cell whose removal would cost this much evidence is kept without a test by itself: of 326 whose
# cost was between this and 20 none failed one (benchmarks/RESULTS.md).
BEYOND_DOUBT = 15.0


@dataclass(eq=False)
class Search:
    """The search on one set of residuals.

    Attributes
    ----------
    data
        The residuals; fewer or more rows as a better model identifies gross errors better.
    cells
        All that are tried.
    rng
        Source of all randomness.
    judge
        Residuals and a fit to the same residuals without the rows that it shows to be gross.
    progress
        Called with the share that is done.
    """

    data: Residuals
    cells: tuple[Cell, ...]
    rng: np.random.Generator
    judge: Callable[[Residuals, Solution], Residuals]
    progress: Callable[[float], None]

    def __post_init__(self) -> None:
        self._look_at(self.data)

    def _look_at(self, data: Residuals) -> None:
        self.data = data
        self.catalogue = Catalogue.of(data, self.cells)
        fold_of_pose = self.rng.permutation(data.poses) % min(FOLDS, data.poses)
        self._left_out = Comparisons(data, fold_of_pose)
        # The last fits, the latest at the end.
        self._fits: dict[frozenset[Cell], Solution | None] = {}
        self._in_vain: set[frozenset[Cell]] = set()
        self._passed: dict[tuple[object, ...], bool] = {}

    def run(self, given: Solution | None = None) -> Selection:
        """Search until nothing passes both tests."""
        empty = self.fit(())
        assert empty is not None
        solution, steps = given or empty, []
        seen: set[tuple[Residuals, frozenset[Cell]]] = set()
        for count in range(ROUNDS):
            # What a round adds may be dropped at its end: from the same set the next would do the
            # same, and chance would have one more try at the p-values.
            state = self.data, frozenset(solution.cells)
            if state in seen:
                break
            seen.add(state)
            self.progress(count / (count + 2.0))
            screening = screen(self.data, self.catalogue, solution, rng=self.rng, draws=DRAWS)
            for proposal in propose(solution, screening, self.catalogue, self.fit, self.grown):
                candidate, step = self._tested(solution, proposal, screening)
                # What needs no more parameters than the set it replaces has only to do no worse: a
                # family of curves that stood in for a weaker cause gives way to it.
                more = len(candidate.parameters) > len(solution.parameters)
                least = LEAST_GAIN if more else 0.0
                if step.p_value <= SIGNIFICANCE and self.predicts(candidate, solution, least):
                    break
            else:
                anew = self._named_instead(solution)
                if anew is solution:
                    anew = regrown(solution, self.with_all, self.prune)
                gain = anew.log_evidence - solution.log_evidence
                if gain <= HYSTERESIS or not self.predicts(anew, solution):
                    break
                solution = self.backward_elimination(self.drop_unpredictive(anew), solution)
                continue
            steps.append(step)
            solution = self.swap(self.prune(candidate))
            solution = refine_moments(solution, self.cells, self.data.part, self.fit)
            # What joins beside structure gains about as much without: tried again at the end.
            if not all(has_a_name(cell) for cell in step.cells):
                solution = self._named_instead(solution)
            solution = self._judged(self.backward_elimination(self.drop_unpredictive(solution)))
        solution = self._named_instead(solution)
        empty = self.fit(())
        assert empty is not None
        return Selection(empty, solution, tuple(steps))

    def _named_instead(self, solution: Solution) -> Solution:
        """Return `named_instead`; what was tried in vain is not tried again."""
        if (cells := frozenset(solution.cells)) in self._in_vain:
            return solution
        found = named_instead(solution, self.fit, self.grown, HYSTERESIS)
        if found is solution:
            self._in_vain.add(cells)
        return found

    def _tested(
        self, solution: Solution, proposal: Proposal, screening: Screening
    ) -> tuple[Solution, Step]:
        """Return a proposal without its weak members, and how it does in the tests."""
        candidate, p_value = self.backward_elimination(proposal.solution), proposal.p_value
        gain = candidate.log_evidence - solution.log_evidence
        new = tuple(cell for cell in candidate.cells if cell not in solution.cells)
        if gain <= 0.0:
            p_value = 1.0
        elif len(new) == 1 and len(proposal.solution.cells) > len(solution.cells) + 1:
            # What is left of a family is judged as what it is, one cell.
            p_value = screening.p_value(float(screening.score[self.cells.index(new[0])]))
        share = self.held_out_share(solution, candidate)
        return candidate, Step(new, p_value, share, gain)

    def _judged(self, solution: Solution) -> Solution:
        """Set aside what the better model shows to be gross, and fit again without it."""
        data = self.judge(self.data, solution)
        if data is self.data:
            return solution
        self._look_at(data)
        again = self.fit(solution.cells, solution)
        return solution if again is None else self.prune(again)

    def fit(self, cells: Sequence[Cell], start: Solution | None = None) -> Solution | None:
        """Fit a set with its prior probability.

        None for two cells of the same parameters, and where so few rows agree with any parameters.
        """
        names = [name for cell in cells for name in cell.parameters]
        if len(set(names)) < len(names):
            return None
        if not self.data.leaves_noise(cells):
            return None
        # Different ways lead to one set again and again.
        wanted = frozenset(cells)
        if wanted in self._fits:
            found = self._fits.pop(wanted)
        else:
            prior = family_log_prior(cells, self.catalogue.cells)
            found = solve(self.data, cells, start, prior=prior)
        self._fits[wanted] = found
        while len(self._fits) > KEPT_FITS:
            del self._fits[next(iter(self._fits))]
        return found

    def grown(self, solution: Solution, family: tuple[str, ...]) -> Solution | None:
        """Return the set with all of a family whose members each raise the evidence.

        Also where none of them does so alone: errors of six joints may each be below the
        threshold, and far above it together.
        """
        grown = self.with_all(solution, family)
        if grown is None or len(grown.cells) < len(solution.cells) + 2:
            return None
        pruned = self.prune(grown, solution)
        return None if pruned is solution else pruned

    def with_all(self, solution: Solution, family: tuple[str, ...]) -> Solution | None:
        """Return the set with all of a family that add something to it; None where none do."""
        members = [
            cell
            for cell in self.catalogue.cells
            if cell.name in family and EFFECTS[cell.name].in_family(cell)
        ]
        present = {(cell.name, cell.joints, cell.label) for cell in solution.cells}
        others = [cell for cell in members if (cell.name, cell.joints, cell.label) not in present]
        new = visible(self.data, solution.cells, others)
        return self.fit((*solution.cells, *new), solution) if new else None

    def prune(self, solution: Solution, given: Solution | None = None) -> Solution:
        """Drop, one by one, the cells without which the evidence is higher, but the given ones.

        Those of a sign that physics excludes go first, whatever they explain.
        """
        price = np.log(3.0 * len(self.data))
        settled = True
        while solution.cells:
            unphysical = solution.unphysical()
            worth = [
                worth_of(solution, cell, where, price)
                if given is None or cell not in given.cells
                else np.inf
                for cell, where in zip(solution.cells, solution.slices(), strict=True)
            ]
            for index in unphysical:
                worth[index] = -np.inf
            # Wald's estimate of the loss chooses; the evidence itself decides.
            for index in np.argsort(worth)[:2]:
                if worth[index] > 2.0:
                    continue
                smaller = self._without(solution, index, index in unphysical, settled)
                if smaller is not None:
                    solution, settled = smaller
                    break
            else:
                if given is not None and set(solution.cells) == set(given.cells):
                    return given
                if settled:
                    return solution
                # Noise and smoothness follow what was dropped; then it is looked at again.
                solution, settled = self.fit(solution.cells, solution) or solution, True
        return solution if settled else self.fit(solution.cells, solution) or solution

    def _without(
        self, solution: Solution, index: int, unphysical: bool, settled: bool
    ) -> tuple[Solution, bool] | None:
        """Return a solution less a cell, and whether its noise is settled; None if that is worse.

        Where the evidence rises with the noise as it is, the best noise for the smaller set can
        wait; the cell is kept only by settled evidences.
        """
        evidence = evidence_without(solution, index, len(self.data), self.catalogue.cells)
        loss = solution.log_evidence - evidence
        if unphysical or loss < 0.0:
            return solution.less(index, evidence), False
        smaller = (*solution.cells[:index], *solution.cells[index + 1 :])
        again = self.fit(smaller, solution) if settled and loss < SETTLING else None
        if again is None or again.log_evidence <= solution.log_evidence:
            return None
        return again, True

    def swap(self, solution: Solution) -> Solution:
        """Replace cells, one at a time, by what explains more in their place."""
        if len(solution.cells) > MOST_EXCHANGED:
            return solution
        for _ in range(MOST_EXCHANGED):
            better = self._best_exchange(solution)
            if better is None:
                return solution
            solution = self.prune(better)
        return solution

    def _best_exchange(self, solution: Solution) -> Solution | None:
        """Return the best fit with one cell, or two, replaced by one other; None if none gains."""
        best = None
        # A family found as a whole stays whole: a part of it resembles many other causes.
        loose = [cell for cell in solution.cells if relatives(solution.cells, cell) < WHOLE]
        removed = [{cell} for cell in loose]
        if len(loose) <= MOST_MERGED:
            removed += [set(pair) for pair in itertools.combinations(loose, 2)]
        for cells in removed:
            for candidate in self.replacements(solution, cells, 3):
                limit = solution if best is None else best
                if candidate.log_evidence > limit.log_evidence + HYSTERESIS:
                    best = candidate
        return best if best is not None and self.predicts(best, solution) else None

    def drop_unpredictive(self, solution: Solution) -> Solution:
        """Drop the causes without which poses left out are predicted better."""
        for group in grouped(solution.cells):
            if len(group) == len(solution.cells):
                continue
            held = solution
            for cell in group:
                index = held.cells.index(cell)
                held = held.less(index, held.evidence_without(index, len(self.data)))
            # Other smoothness of the others cannot make up for so much.
            if self.held_out_share(held, solution) > NEEDED:
                continue
            without = self.fit(held.cells, solution)
            if without is not None and not self.predicts(solution, without):
                solution = without
        return solution

    def backward_elimination(self, solution: Solution, given: Solution | None = None) -> Solution:
        """Drop, the weakest first, the members of families that fail the tests by themselves.

        A family passes its tests as a whole. Each member has still to raise the evidence, to
        predict poses left out, and to beat itself on surrogate residuals. So has what joined a
        given solution without relatives.
        """
        price = np.log(3.0 * len(self.data))
        tested: set[Cell] = set()
        while True:
            weak = [
                (worth, index)
                for index, (cell, where) in enumerate(
                    zip(solution.cells, solution.slices(), strict=True)
                )
                if cell not in tested
                and (relatives(solution.cells, cell) > 1 or cell not in (given or solution).cells)
                and (worth := worth_of(solution, cell, where, price)) < BEYOND_DOUBT
            ]
            if not weak:
                return solution
            _, index = min(weak)
            cell = solution.cells[index]
            tested.add(cell)
            without = self.fit((*solution.cells[:index], *solution.cells[index + 1 :]), solution)
            if without is None:
                continue
            # Of one set chance is asked once.
            test = cell, frozenset(solution.cells), solution.log_evidence, without.log_evidence
            if test not in self._passed:
                self._passed[test] = self._passes(cell, without, solution)
            if not self._passed[test]:
                solution = without

    def _passes(self, cell: Cell, without: Solution, solution: Solution) -> bool:
        """Return whether a cell passes the tests of a step by itself."""
        if solution.log_evidence - without.log_evidence < MEMBER:
            return False
        if not self.predicts(solution, without):
            return False
        own = self.catalogue.which([cell])
        screening = screen(
            self.data, self.catalogue, without, rng=self.rng, draws=DRAWS_OF_ONE, chosen=own
        )
        return screening.p_value(float(screening.score[own][0])) <= SIGNIFICANCE_OF_ONE

    def replacements(self, solution: Solution, cells: set[Cell], count: int) -> list[Solution]:
        """Return fits with the best other cells in the place of these, best first."""
        rest = tuple(other for other in solution.cells if other not in cells)
        without = self.fit(rest, solution)
        if without is None:
            return []
        without = replace(without, noise=solution.noise)
        others = np.array([other not in cells for other in self.catalogue.cells])
        chosen = self.catalogue.cheap & others
        score = screen(self.data, self.catalogue, without, chosen=chosen).score
        found = []
        for index in np.argsort(-score)[:count]:
            if np.isfinite(score[index]):
                other = self.fit((*rest, self.catalogue.cells[index]), solution)
                if other is not None and not other.unphysical():
                    found.append(other)
        return sorted(found, key=lambda fit: -fit.log_evidence)

    def predicts(self, larger: Solution, smaller: Solution, least: float = 0.0) -> bool:
        """Return whether a set saves so much of the deviance of poses left out against another.

        A smaller share, by less than its standard error, will do where the evidence is clear.
        """
        share, error = self._left_out.saved(smaller, larger)
        if larger.log_evidence - smaller.log_evidence >= EVIDENT:
            share += error
        return share >= least

    def held_out_share(self, smaller: Solution, larger: Solution) -> float:
        """Return the share of the deviance of poses left out that the larger set saves."""
        return self._left_out.saved(smaller, larger)[0]
