"""Causes beside errors that remember: would such errors suggest a cause as clearly by chance?

What follows from one reading to the next resembles what follows a joint angle, which does so, too.
The wander of `effects.sensor_wander` takes up a part of it; the tests of the search hold the rest
for independent. So each cause beside a wander is tested again, the weakest first, against
surrogates with the memory that the residuals show (`memory`). Those that fail are dropped.
"""

from __future__ import annotations

from dataclasses import replace

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.families import grouped
from remaster_ros.discovery.memory import Memory
from remaster_ros.discovery.screening import screen
from remaster_ros.discovery.set_aside import is_memory, remembering
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import SIGNIFICANCE, Search

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
    tested: set[object] = set()
    while sensors:
        rest = [cell for cell in solution.cells if not is_memory(cell)]
        plain = search.fit(rest, solution)
        weakest = None
        for group in grouped(rest):
            if group in tested or not EFFECTS[group[0].name].is_cause:
                continue
            others = [cell for cell in solution.cells if cell not in group]
            without = search.fit(others, solution)
            if without is None:
                continue
            gain = solution.log_evidence - without.log_evidence
            if weakest is None or gain < weakest[0]:
                weakest = gain, group, without
        if weakest is None or plain is None:
            break
        gain, group, without = weakest
        tested.add(group)
        memory = Memory.of(search.data, plain, sensors)
        screening = screen(
            search.data,
            search.catalogue,
            replace(without, noise=solution.noise),
            rng=search.rng,
            draws=DRAWS,
            errors=memory.draw,
        )
        if screening.p_value(gain) > SIGNIFICANCE:
            solution = without
    return solution
