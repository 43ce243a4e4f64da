"""Causes beside errors that remember: would such errors suggest a cause as clearly by chance?

What follows from one reading to the next resembles what follows a joint angle, which does so, too.
The wander of `effects.sensor_wander` takes up a part of it; the tests of the search hold the rest
for independent. So causes beside a wander are tested again, the weakest first, against
surrogates with the memory that the residuals show (`memory`), until one passes: what explains more
would pass, too. Those that fail are dropped.
"""

from __future__ import annotations

from dataclasses import replace

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.families import grouped
from remaster_ros.discovery.memory import Memory
from remaster_ros.discovery.proposals import SIGNIFICANCE
from remaster_ros.discovery.screening import screen
from remaster_ros.discovery.set_aside import is_memory, remembering
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search

DRAWS = 200


def withstanding_memory(search: Search, solution: Solution) -> Solution:
    """Return a solution without the causes that its memory suggests by chance.

    Parameters
    ----------
    search
        Which found the solution.
    solution
        Returned as it is where no errors remember.
    """
    sensors = remembering(search.data, solution)
    while sensors:
        rest = [cell for cell in solution.cells if not is_memory(cell)]
        plain, without = search.fit(rest, solution), _without_weakest(search, solution)
        if plain is None or without is None:
            break
        screening = screen(
            search.data,
            search.catalogue,
            replace(without, noise=solution.noise),
            rng=search.rng,
            draws=DRAWS,
            errors=Memory.of(search.data, plain, sensors).draw,
        )
        gain = solution.log_evidence - without.log_evidence
        if screening.p_value(gain) <= SIGNIFICANCE:
            break
        solution = without
    return solution


def _without_weakest(search: Search, solution: Solution) -> Solution | None:
    """Return the solution without the cause that explains least; None where it has none."""
    smaller = [
        search.fit([cell for cell in solution.cells if cell not in group], solution)
        for group in grouped(solution.cells)
        if EFFECTS[group[0].name].is_cause
    ]
    return max(
        (fit for fit in smaller if fit is not None),
        key=lambda fit: fit.log_evidence,
        default=None,
    )
