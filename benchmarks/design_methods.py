"""Criteria and algorithms of the literature that choose poses, on the same candidates.

D: the largest determinant of the information. O1 to O5: observability indices, of the singular
values of the identification matrix (Borm and Menq 1991; Driels and Pathre 1990; Nahvi, Hollerbach
and Hayward 1994; Nahvi and Hollerbach 1996; Sun and Hollerbach 2008), here of what the poses tell
of the identifiable joints with all other parameters eliminated, so that all are in rad. DETMAX:
exchanges with excursions (Mitchell 1974). The convex relaxation is A-optimal: every subset of the
solutions of a pose has a weight from 0 to 1, one in all for a pose (Frank and Wolfe 1956, whose
tangents are lower bounds); then the configurations with the largest weights are taken. The
D-optimal relaxation weighs single configurations as if their errors were independent, as others
do by second-order cone programs (Sagnol 2011, doi:10.1016/j.jspi.2010.11.031); here by the
multiplicative algorithm, which ends at the same weights (Silvey, Titterington and Torsney 1978,
doi:10.1080/03610927808827719).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import combinations, pairwise

import numpy as np
from common import table

from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.pose_design import Floors, Goal, choose
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.planning.visit_order import fastest_order
from remaster_ros.types import FloatArray, IntArray

Criterion = Callable[[FloatArray], FloatArray]
MOST_SUBSETS = 4
"""Subsets of a pose's solutions of so many, and all of them, have weights."""
FRANK_WOLFE = 400
MULTIPLICATIVE = 2000


def compared(
    information: DesignInformation, travel: TravelTime, count: int, rng: np.random.Generator
) -> str:
    """Return the table of all methods for one number of configurations."""
    marginal = _Marginal(information)
    rows = []

    def add(name: str, chosen: Sequence[int], seconds: float) -> None:
        q = information.q[np.array(chosen)]
        padded = np.zeros((len(q) + 1, len(q) + 1))
        padded[1:, 1:] = travel.between(q)
        order = fastest_order(padded)
        spent = sum(padded[a, b] for a, b in pairwise(order)) + len(q) * travel.measuring_s
        rows.append(
            (
                name,
                len(chosen),
                len(np.unique(information.pose[np.array(chosen)])),
                f'{np.degrees(information.joint_rms(chosen)):.5f}',
                f'{information.tool_rms(chosen) * 1e3:.3f}',
                f'{spent:.0f}',
                f'{seconds:.1f}',
            )
        )

    def timed(name: str, choose_by: Callable[[], Sequence[int]]) -> None:
        started = time.process_time()
        chosen = choose_by()
        add(name, chosen, time.process_time() - started)

    in_turn = list(range(count))
    timed('Latin hypercube, as drawn', lambda: in_turn)
    for name, criterion in marginal.criteria().items():
        timed(
            f'{name}, greedy and single exchange',
            lambda c=criterion: exchanged(information, greedy(information, c, count), c),
        )
    d_optimal = marginal.criteria()['D']
    timed(
        'D, DETMAX', lambda: detmax(information, greedy(information, d_optimal, count), d_optimal)
    )
    timed(
        'D, convex relaxation of single configurations, rounded',
        lambda: np.argsort(-d_weights(information, count))[:count].tolist(),
    )
    started = time.process_time()
    weights, subsets, bound = relaxed(information, count)
    chosen = rounded(information, weights, subsets, count)
    add('A, convex relaxation, rounded', chosen, time.process_time() - started)
    for name, floors in (('A, exchange of poses', Floors(0, 0)), ('… with the floors', Floors())):
        timed(name, lambda f=floors: at_count(information, travel, f, count, rng))
    header = (
        'choice', 'configurations', 'poses', 'RMS std of joints, deg', 'tool, mm', 'fastest, s',
        'choice, s of CPU',
    )  # fmt: skip
    text = table(header, rows)
    limit = f'{np.degrees(bound):.5f} deg'
    return f'{text}\n\nNo {count} configurations reach less than {limit}, by the relaxation.'


class _Marginal:
    """Criteria of the information on the identifiable joints, each to be made small."""

    def __init__(self, information: DesignInformation) -> None:
        self._information = information
        self._places = sorted(information.identifiable.values())
        self._units = information.scale[self._places]

    def _covariances(self, matrices: FloatArray) -> FloatArray:
        """Return the covariance of the joints, rad², (n, r, r)."""
        inverse = np.linalg.inv(self._information.finite(matrices))
        joints = inverse[:, self._places][:, :, self._places]
        return joints * np.outer(self._units, self._units)

    def _singular(self, matrices: FloatArray) -> FloatArray:
        """Return the singular values of the identification matrix, 1/rad, (n, r), ascending."""
        return 1.0 / np.sqrt(np.linalg.eigvalsh(self._covariances(matrices))[:, ::-1])

    def criteria(self) -> dict[str, Criterion]:
        def of(value: Callable[[FloatArray], FloatArray]) -> Criterion:
            return lambda matrices: value(self._singular(matrices))

        return {
            'A': lambda m: np.log(np.trace(self._covariances(m), axis1=1, axis2=2)),
            'D': of(lambda s: -np.sum(np.log(s), axis=1)),
            'O1': of(lambda s: -np.mean(np.log(s), axis=1)),
            'O2': of(lambda s: -np.log(s[:, 0] / s[:, -1])),
            'O3': of(lambda s: -np.log(s[:, 0])),
            'O4': of(lambda s: -np.log(s[:, 0] ** 2 / s[:, -1])),
            'O5': of(lambda s: np.log(np.sum(1.0 / s, axis=1))),
        }


def greedy(information: DesignInformation, criterion: Criterion, count: int) -> list[int]:
    chosen: list[int] = []
    while len(chosen) < count:
        chosen.append(_best(information, criterion, chosen)[0])
    return chosen


def _best(
    information: DesignInformation, criterion: Criterion, chosen: Sequence[int]
) -> tuple[int, float]:
    """Return the best configuration to add, and the criterion with it."""
    among = np.setdiff1d(np.arange(len(information)), np.array(chosen, dtype=np.int64))
    values = criterion(information.with_each(chosen, among))
    return int(among[np.argmin(values)]), float(np.min(values))


def _value(information: DesignInformation, criterion: Criterion, chosen: Sequence[int]) -> float:
    return float(criterion(information.total(chosen)[None])[0])


def exchanged(
    information: DesignInformation, chosen: Sequence[int], criterion: Criterion
) -> list[int]:
    """Exchange single configurations until none gets better (Fedorov 1972)."""
    chosen = list(chosen)
    while True:
        before = _value(information, criterion, chosen)
        for old in list(chosen):
            rest = [index for index in chosen if index != old]
            new, value = _best(information, criterion, rest)
            if value < _value(information, criterion, chosen) - 1e-9:
                chosen = [*rest, new]
        if _value(information, criterion, chosen) > before - 1e-6:
            return chosen


def detmax(
    information: DesignInformation, chosen: Sequence[int], criterion: Criterion, most: int = 6
) -> list[int]:
    """Add up to six configurations, remove as many, while that gets better; then the reverse."""
    best = list(chosen)
    size = 1
    while size <= most:
        for steps in ((_more, _less), (_less, _more)):
            tried = list(best)
            for step in (step for step in steps for _ in range(size)):
                tried = step(information, tried, criterion)
            if _value(information, criterion, tried) < _value(information, criterion, best) - 1e-9:
                best, size = tried, 0
                break
        size += 1
    return best


def _more(information: DesignInformation, chosen: list[int], criterion: Criterion) -> list[int]:
    return [*chosen, _best(information, criterion, chosen)[0]]


def _less(information: DesignInformation, chosen: list[int], criterion: Criterion) -> list[int]:
    without = [[other for other in chosen if other != index] for index in chosen]
    values = criterion(np.array([information.total(rest) for rest in without]))
    return without[int(np.argmin(values))]


def at_count(
    information: DesignInformation,
    travel: TravelTime,
    floors: Floors,
    count: int,
    rng: np.random.Generator,
) -> Sequence[int]:
    """Return the design with the least time of at most so many configurations, by its goal."""
    reachable = information.joint_rms(range(len(information)))
    low, high = reachable, 50.0 * reachable
    found: Sequence[int] = ()
    for _ in range(9):
        goal = float(np.sqrt(low * high))
        design = choose(
            information, travel, Goal(goal, 1.0), rng, floors, exchanges=40, whole_poses=False
        )
        if design.reached and len(design.chosen) <= count:
            found, high = design.chosen, goal
        else:
            low = goal
    return found


def d_weights(information: DesignInformation, count: int) -> FloatArray:
    """Return D-optimal weights of single configurations, sum 1, (n,)."""
    alone = np.array([information.total([i]) - information.prior for i in range(len(information))])
    w = np.full(len(alone), 1.0 / len(alone))
    for _ in range(MULTIPLICATIVE):
        M = information.finite(information.prior + count * np.tensordot(w, alone, axes=1))
        w = w * (alone.reshape(len(alone), -1) @ np.linalg.inv(M).ravel())
        w /= w.sum()
    return w


def relaxed(
    information: DesignInformation, count: int
) -> tuple[FloatArray, list[IntArray], float]:
    """Return the weights of subsets of the solutions of poses, the subsets, and a bound, rad."""
    subsets: list[IntArray] = []
    for pose in np.unique(information.pose):
        mine = np.flatnonzero(information.pose == pose)
        sizes = {*range(1, min(MOST_SUBSETS, len(mine)) + 1), len(mine)}
        subsets += [np.array(part) for size in sizes for part in combinations(mine, size)]
    atoms = np.array([information.total(part) - information.prior for part in subsets])
    cost = np.array([len(part) for part in subsets], dtype=float)
    owner = np.unique(information.pose[[part[0] for part in subsets]], return_inverse=True)[1]
    places = sorted(information.identifiable.values())
    L = np.zeros((len(information.scale), len(places)))
    L[places, np.arange(len(places))] = information.scale[places]
    w = np.full(len(subsets), count / np.sum(cost))
    bound = 0.0
    for step in range(FRANK_WOLFE):
        M = information.finite(information.prior + np.tensordot(w, atoms, axes=1))
        root = np.linalg.solve(M, L)
        value = float(np.sum(L * root))
        gain = atoms.reshape(len(atoms), -1) @ (root @ root.T).ravel()
        corner = _oracle(gain, cost, owner, count)
        # The tangent at w lies below the convex criterion.
        bound = max(bound, value - float(gain @ (corner - w)))
        w = w + 2.0 / (step + 2.0) * (corner - w)
    return w, subsets, float(np.sqrt(bound / len(places)))


def _oracle(gain: FloatArray, cost: FloatArray, owner: IntArray, count: int) -> FloatArray:
    """Return the weights of the largest sum of gains: one subset a pose, `count` in all."""
    low, high = 0.0, float(np.max(gain / cost))

    def taken(price: float) -> IntArray:
        worth = gain - price * cost
        best = np.lexsort((-worth, owner))
        first = best[np.unique(owner[best], return_index=True)[1]]
        return first[worth[first] > 0.0]

    for _ in range(60):
        price = 0.5 * (low + high)
        low, high = (price, high) if cost[taken(price)].sum() > count else (low, price)
    dear, cheap = taken(high), taken(low)
    w = np.zeros(len(gain))
    w[dear] = 1.0
    more = np.zeros(len(gain))
    more[cheap] = 1.0
    spent, larger = cost[dear].sum(), cost[cheap].sum()
    share = (count - spent) / (larger - spent) if larger > spent else 0.0
    return (1.0 - share) * w + share * more


def rounded(
    information: DesignInformation, weights: FloatArray, subsets: list[IntArray], count: int
) -> list[int]:
    """Take the configurations with the largest weights."""
    total = np.zeros(len(information))
    for weight, part in zip(weights, subsets):
        total[part] += weight
    return np.argsort(-total)[:count].tolist()
