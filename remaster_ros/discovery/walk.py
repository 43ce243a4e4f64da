# SPDX-License-Identifier: Apache-2.0
"""The models visited by the walk, each at its own noise and background, and averages over them.

Beside the causes a model has a background: kinds of errors as random effects (`random_effects`),
each with a variance that the restricted likelihood gives. A kind that the data do not show has no
variance and is left out.

A cause is in a model as a block, or as a member of the background that stands out of it: by the
ratio of the densities at nothing before and after the data (Savage & Dickey; Dickey 1971, Ann.
Math. Stat. 42). The share of a model is its posterior weight among all models visited
(renormalised; George & McCulloch 1997, Statistica Sinica 7); what is reported is an average by
these shares.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.special import log_expit, logsumexp

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import changed_at, gaps
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.sensor_wander import EFFECT as SENSOR_WANDER
from remaster_ros.discovery.evidence import System
from remaster_ros.discovery.random_effects import Family, kinds
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Covariances, Solution
from remaster_ros.discovery.surface import (
    KIND_ODDS,
    LEVELS_M,
    NOTHING,
    Model,
    Pool,
    State,
    Surface,
    Walker,
    blocks_of,
)
from remaster_ros.discovery.thinning import FEWEST_TO_SEARCH
from remaster_ros.types import FloatArray, IntArray

# Variant of a kind that is one free form, with a variance of its own.
ALONE = 'alone'
# Share of the displacement by a wave that a curve of the same joint has, from which on the wave is
# a part of the curve.
PART_OF_A_CURVE = 0.9
# Rounds of a chain at most, each with noise and background of the one before; steps of a round at
# most; steps without a better model after which a round ends, and so many more for each block.
ROUNDS, STEPS, PATIENCE, PATIENCE_EACH = 8, 300, 40, 5
# Share of a session's time within which a step may have been sooner or later than a walk has it
# that had no row beside it, which the offsets alone leave as gross: two of its moments.
DATED_TO = 0.05
# Log of the least evidence for a kind of the background that pays no odds (Akaike 1974).
PRICE = 1.0
# A log posterior that rises by less is settled.
SETTLED = 0.1
# Odds of twenty to one decide between two causes; so many kinds of errors are tried that the best
# of them gains `NAMED` at a probability of one in twenty where nothing is there (Markov).
NEEDED = 3.0
NAMED = float(np.log(len(EFFECTS) / 0.05))
# Models that are evaluated in the end at most, the log posterior below the best at which none is,
# and the share below which none is kept.
MOST_MODELS, NEGLIGIBLE, LEAST_SHARE = 24, 7.0, 1e-3
# Gaps about a moment at which something came in which other changes are tried, too: a fourth of
# those between two moments at which changes are, in a session of a hundred configurations.
NEAREST = 4
# Exchanges of each block of the best model that are looked at.
MOST_EXCHANGED = 8
# Blocks of a best model of which each pair is exchanged, those that it would lose least by leaving
# out, and causes that are tried as the first of the two in their place. All pairs of both would
# cost more than the walk; without any, two causes that stand for two others stay (`triple-4` of
# benchmarks/bench_discovery.py, 8 nats), with these they cost a tenth of it.
WEAKEST, MOST_FIRST = 4, 20


Identity = tuple[str, tuple[int, ...], str, str, str, str]
"""Identity of a cause: name, joints, place, driver, subject, and if it begins or ends."""


def identity(candidate: Candidate) -> Identity:
    """Return the key of a candidate's cause, equal for candidates of the same cause.

    Name, joints, place, driver, subject, and whether a change in mid-session 'begins' or 'ends'
    ('' for no change). Candidates that differ only in moment, order or axis have the same key.
    """
    change = '' if candidate.changes is None else 'ends' if candidate.ends else 'begins'
    return (
        candidate.name,
        candidate.joints,
        candidate.place,
        candidate.driver,
        candidate.subject,
        change,
    )


def at_any_time(candidate: Candidate) -> Identity:
    """Return a candidate's identity with 'at any time' in place of '', 'begins' or 'ends'."""
    return *identity(candidate)[:-1], 'at any time'


def _claims(candidate: Candidate) -> Identity:
    """Return the key by which a candidate's cause is looked up in `Walk.probability`.

    `identity` for a change in mid-session. For any other cause `at_any_time`, as it also counts
    as present in models in which it begins or ends in mid-session.
    """
    return at_any_time(candidate) if candidate.changes is None else identity(candidate)


def at_other_moments(
    candidate: Candidate, context: Context, low: float, high: float
) -> list[Candidate]:
    """Return the candidate's cause at every gap between configurations from `low` to `high`.

    In s since the first row; gaps count that overlap this interval. [] for a candidate that does
    not happen at one moment.
    """
    between, changes = EFFECTS[candidate.name].between, EFFECTS[candidate.name].changes
    if candidate.changes is not None and changes is not None:
        found = [
            variant
            for gap in gaps(context, low, high)
            for variant in changed_at(candidate.changes, changes, gap)
        ]
        return [variant for variant in found if variant.ends == candidate.ends]
    if not candidate.happened or between is None:
        return []
    return [
        replace(other, drawn_from=candidate.drawn_from)
        for other in between(context, low, high)
        if (other.place, other.joints, other.subject)
        == (candidate.place, candidate.joints, candidate.subject)
    ]


def p_value(log_evidence_gain: float) -> float:
    """Upper bound on the probability of such a gain in log evidence in pure noise.

    Candidates of K kinds are tried. With the prior probability 1/K of its kind and 1/c of one
    of c candidates of it, the sum of all Bayes factors has the expectation 1 in pure noise; by
    Markov's inequality the best raises the log evidence by g with a probability of at most K
    exp(-g). At most 1.
    """
    return float(min(1.0, len(EFFECTS) * np.exp(-log_evidence_gain)))


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Set of candidate causes (blocks) fitted with its own noise and background variances.

    These maximise the restricted likelihood. The background are families of random effects:
    all errors of one kind, with one variance.
    """

    data: Residuals
    model: Model
    value: float  # Log posterior
    candidates: tuple[Candidate, ...]  # Weights of its blocks and of the kinds of the background
    eta: FloatArray  # Noise and variances, as `System` has them
    noise: Noise
    factors: Mapping[object, float]  # Precision of the weights of each kind, by key
    families: tuple[Family, ...]  # Kinds of the background
    blocks: tuple[tuple[Candidate, int], ...]  # Candidates that are its blocks, with their levels
    # Mean and covariance of base coefficients and all weights
    estimate: tuple[FloatArray, FloatArray]

    @cached_property
    def std(self) -> dict[Candidate, float]:
        """Prior standard deviation of the weights of each family of random effects, m."""
        return {
            family.candidate: (
                self.factors[family.candidate.key] + (family.candidate.largest or np.inf) ** -2.0
            )
            ** -0.5
            for family in self.families
        }

    @cached_property
    def where(self) -> dict[Candidate, slice]:
        """Slice of each candidate's weights in `estimate`, behind the p base coefficients."""
        p = self.data.base.shape[2]
        edges = p + np.cumsum([0, *(candidate.size for candidate in self.candidates)])
        return {
            candidate: slice(int(a), int(b))
            for candidate, a, b in zip(self.candidates, edges[:-1], edges[1:], strict=True)
        }

    def log_factor(self, where: IntArray, std: FloatArray) -> float:
        """Return the log Bayes factor for some weights not being zero (Savage & Dickey).

        Prior density at zero over posterior density there. ``where``: indices of the weights
        in `estimate`; ``std``: their prior standard deviations, (len(where),).
        """
        mean, covariance = self.estimate
        weights, spread = mean[where], covariance[np.ix_(where, where)]
        root, wrong = dpotrf(spread, lower=1)
        if wrong:
            worth = weights @ np.linalg.solve(spread, weights) + np.linalg.slogdet(spread)[1]
        else:
            worth = np.sum(dtrtrs(root, weights, lower=1)[0] ** 2)
            worth += 2.0 * np.sum(np.log(np.diag(root)))
        return float(0.5 * worth - np.sum(np.log(std)))

    def log_factor_of_kind(self, family: Family) -> float:
        """Return the log Bayes factor for a family of random effects, all its weights together."""
        part = self.where[family.candidate]
        std = np.full(family.candidate.size, self.std[family.candidate])
        return self.log_factor(np.arange(part.start, part.stop), std)

    @cached_property
    def members(self) -> list[tuple[Family, Candidate, IntArray, FloatArray]]:
        """Members (candidates) of the background's families of random effects, with their weights.

        (family, member, indices of its weights in `estimate`, matrix that turns its weights into
        its parameters, (parameters, weights)).
        """
        found = []
        for family in self.families:
            start = self.where[family.candidate].start
            for member, mapping in zip(family.members, family.maps, strict=True):
                stop = start + mapping.shape[1]
                found.append((family, member, np.arange(start, stop), mapping))
                start = stop
        return found

    @cached_property
    def by_itself(self) -> dict[Candidate, float]:
        """Log Bayes factor of each candidate in the background, for nonzero weights of its own."""
        return {
            member: self.log_factor(where, np.full(len(where), self.std[family.candidate]))
            for family, member, where, _ in self.members
        }

    @cached_property
    def standing_out(self) -> dict[Candidate, float]:
        """Probability that each candidate in the background is a cause, given the model.

        The product of two: that its family of random effects is present, and that it stands out
        as one of m causes of this family, at prior odds of 1 to m. Candidates with the same
        `identity` are one cause and have the same probability. Those of a sign that physics
        excludes are no such cause: 0.
        """
        return {
            member: 0.0 if self._is_excluded(member, where, mapping) else self._chances[member]
            for _, member, where, mapping in self.members
        }

    @property
    def is_physical(self) -> bool:
        """Whether no block, and nothing that stands out of the background, has an excluded sign.

        Beside a background with such a member, the cause of that name that ends or begins in
        mid-session would have the sign that is allowed, and stand for the rest of the session.
        """
        mean = self.estimate[0]
        starts = [self.where[weights].start for weights in self.candidates[: len(self.blocks)]]
        if any(
            block.size == 1 and block.sign * mean[start] < 0.0
            for (block, _), start in zip(self.blocks, starts, strict=True)
        ):
            return False
        return not self.excluded

    @cached_property
    def excluded(self) -> set[Candidate]:
        """Candidates of the families of which a member stands out with an excluded sign."""
        return {
            family.candidate
            for family, member, where, mapping in self.members
            if self._is_excluded(member, where, mapping)
            and self._chances[member] >= 0.5
            # Itself, and not by another axis of the same cause.
            and self.by_itself[member] > np.log(member.drawn_from)
        }

    def _is_excluded(self, member: Candidate, where: IntArray, mapping: FloatArray) -> bool:
        """Return whether the parameter of a candidate in the background has an impossible sign.

        ``where``, ``mapping``: as in `members`. False for a candidate of several parameters.
        """
        parameters = mapping @ self.estimate[0][where]
        return member.size == 1 and member.sign * float(parameters[0]) < 0.0

    @cached_property
    def _chances(self) -> dict[Candidate, float]:
        """As `standing_out`, whatever the signs."""
        found = {}
        for family in self.families:
            mine = [entry for entry in self.members if entry[0] is family]
            causes: dict[Identity, list[tuple[Candidate, IntArray]]] = {}
            for _, member, where, _ in mine:
                causes.setdefault(identity(member), []).append((member, where))
            price = np.log(KIND_ODDS / len(LEVELS_M))
            kind = float(log_expit(self.log_factor_of_kind(family) + price))
            count = max(len(causes), max(member.drawn_from for member in family.members))
            for parts in causes.values():
                where = np.concatenate([part for _, part in parts])
                factor = self.log_factor(where, np.full(len(where), self.std[family.candidate]))
                chance = np.exp(kind + log_expit(factor - np.log(count)))
                for member, _ in parts:
                    found[member] = float(chance)
        return found


def evaluated(
    pool: Pool, families: Sequence[Family], model: Model, start: Evaluated | None = None
) -> Evaluated | None:
    """Fit a model at the noise and background variances that maximise its likelihood.

    ``families``: kinds of errors that are the background, as random effects; ``model``: (index
    of a block in ``pool``, level: index of its prior size in `LEVELS_M`) each; ``start``: fit
    at whose variances the search begins, None for a first guess. None if the columns of the
    model cannot be distinguished.
    """
    candidates = [pool.blocks[block].weights(level) for block, level in model]
    system = System.of(pool.data, [*candidates, *(family.candidate for family in families)])
    if system is None:
        return None
    try:
        eta = system.most_likely(
            {} if start is None else start.factors, None if start is None else start.noise
        )
        value = system.marginal(eta) + pool.prior(model) + log_price(families)
        # Nearly every model is asked for it, and the equations are at hand.
        estimate = system.estimate(eta)
    except np.linalg.LinAlgError:
        return None
    return Evaluated(
        pool.data, model, float(value), system.candidates, eta, system.noise(eta),
        system.factors(eta), tuple(families),
        tuple((pool.blocks[block].candidate, level) for block, level in model), estimate,
    )  # fmt: skip


def _has_few_poses(data: Residuals) -> bool:
    """Return whether the rows worked on have fewer poses than `FEWEST_TO_SEARCH`."""
    poses = np.unique(data.context.measurements.pose[data.rows.source])
    return len(poses) < FEWEST_TO_SEARCH


def background(data: Residuals, candidates: Sequence[Candidate]) -> list[Family]:
    """Return the families of random effects that models may have in addition to single causes.

    One for each kind of error. Families of one cause only are left out, except free forms
    (splines). [] for a session of so few poses that it shows only the variance of the noise.
    """
    if _has_few_poses(data):
        return []
    # What comes alone is no kind: a variance of its own would be a cause without its price.
    return [
        family
        for family in kinds(data, candidates)
        if family.members[0].penalty is not None
        or len({identity(member) for member in family.members}) > 1
    ]


def by_form(data: Residuals, families: Sequence[Family]) -> list[Family]:
    """Return families of random effects, those of free forms split into one for each member.

    Free forms are members with a penalty, such as splines; other families are unchanged.
    """
    found = []
    for family in families:
        if family.members[0].penalty is None:
            found.append(family)
            continue
        for member in family.members:
            name = ' '.join(map(str, member.key))
            form = Family.of(data, name, [member], alike=family.members)
            assert form is not None
            found.append(replace(form, candidate=replace(form.candidate, variant=ALONE)))
    return found


def log_price(families: Sequence[Family]) -> float:
    """Return the log prior odds of a background, a set of families of random effects.

    log(`KIND_ODDS`) for each effect among them, except lengths and tilts; for each family of one
    free form, as made by `by_form`, also the log prior odds of a single cause.
    """
    forms = [family.members[0] for family in families if family.candidate.variant == ALONE]
    each = -sum(np.log(form.drawn_from * len(LEVELS_M)) for form in forms)
    paid = {
        family.members[0].name for family in families if family.members[0].model_change is None
    }
    return float(each + len(paid) * np.log(KIND_ODDS))


@dataclass(frozen=True, eq=False)
class Chain:
    """Result of one Metropolis chain: its best model, and the models visited."""

    best: Evaluated  # Its best model
    visited: Mapping[Model, float]  # Log posterior of the models of its last round


class Walk:
    """Metropolis chains over sets of causes for some residuals, and the models they visited.

    Attributes
    ----------
    models
        Models of a share worth mentioning, the largest first.
    share
        Posterior weight of each, (models,).
    """

    def __init__(
        self,
        data: Residuals,
        candidates: Sequence[Candidate],
        rng: np.random.Generator,
        progress: Callable[[float], None] = lambda share: None,
        start: Evaluated | None = None,
    ) -> None:
        self.data, self.rng = data, rng
        self.families = background(data, candidates)
        # The same with a variance for each free form: one smoothness for all may fit none of them.
        self.by_form = by_form(data, self.families)
        # What may change in mid-session. Of few poses one alone may lie before a moment.
        changes = [candidate for candidate in candidates if candidate.changes is not None]
        changes = [] if _has_few_poses(data) else changes
        candidates = [candidate for candidate in candidates if candidate.changes is None]
        self._changing = [*{c.changes.key: c.changes for c in changes if c.changes}.values()]
        of_background = {member.key for entry in self.families for member in entry.members}
        singles = [
            candidate
            for candidate in candidates
            if candidate.penalty is None or candidate.key not in of_background
        ]
        tried = {candidate.key for candidate in singles}
        dated: dict[object, Candidate] = {}
        for candidate, _ in () if start is None else start.blocks:
            # Rows that were not worked on before may tell of another moment.
            reach = DATED_TO * float(np.ptp(data.context.elapsed_s))
            variants = at_other_moments(
                candidate, data.part, candidate.moment - reach, candidate.moment + reach
            )
            dated |= {
                entry.key: entry for entry in (candidate, *variants) if entry.key not in tried
            }
        self.pool = Pool(data, blocks_of(data, [*singles, *dated.values()]))
        self._last_surface: Surface | None = None
        self._known: dict[Model, Evaluated | None] = {}
        # Models whose kinds of the background have been chosen anew.
        self._wholes: dict[Model, Evaluated | None] = {}
        empty = self._whole((), None)
        assert empty is not None
        self.empty = empty
        bare = evaluated(self.pool, [], ())
        assert bare is not None
        self.bare = bare
        self.chains = []
        if start is not None:
            self.chains.append(self._chain(self._again(start), hot=False, before=start))
            progress(1.0)
        else:
            for index, first in enumerate((self.bare, self.empty)):
                self.chains.append(self._chain(first, hot=index > 0))
                progress(0.5 * (index + 1))
        better = self._pair_for_pair()
        if better is not None:
            self.chains.append(self._chain(better, hot=False))
        better = self._form_for_shapes()
        if better is not None:
            self.chains.append(self._chain(better, hot=False))
        changed = [*self._with_steps(), *self._with_changes(changes)] if start is None else []
        if self._refined() or changed:
            first = max([self._best_found, *changed], key=lambda entry: entry.value)
            self.chains.append(self._chain(first, hot=False))
        if changed and self._refined():
            self.chains.append(self._chain(self._best_found, hot=False))
        self._weigh()
        # As large as the columns of the pool.
        self._last_surface = None

    @property
    def _best_found(self) -> Evaluated:
        """Best model of all chains so far."""
        return max((chain.best for chain in self.chains), key=lambda model: model.value)

    def _form_for_shapes(self) -> Evaluated | None:
        """Return a model better than all so far, in which a free form replaces fixed shapes.

        The free form is a spline with a variance of its own, such as a joint's error curve; the
        shapes are blocks of effects with thousands of candidates (`Effect.many`) at its place and
        driver, such as gear waves. A chain never leaves several of these in one move. None if no
        such replacement is better.
        """
        start = best = self._best_found
        for form in self.by_form:
            member = form.members[0]
            shapes = {
                block
                for block, _ in start.model
                if EFFECTS[self.pool.blocks[block].candidate.name].many
                and self.pool.blocks[block].candidate.is_shape_of(member)
            }
            if not shapes or form in start.families:
                continue
            model = tuple(entry for entry in start.model if entry[0] not in shapes)
            found = self._physical([*start.families, form], model, start)
            if found is not None and found.value > best.value:
                best = found
        return None if best is start else best

    def _pair_for_pair(self) -> Evaluated | None:
        """Return a model better than all so far, by exchanging two blocks of a chain's best model.

        Two of the blocks lost least are exchanged for two others, which may imitate them:
        single moves of a chain would lead through models that are too unlikely. None if no
        exchange is better.
        """
        found = []
        for best in [chain.best for chain in self.chains]:
            state = State.of(self._surface(best.noise, best.std), best.model)
            weakest = np.argsort(state.losses)[:WEAKEST].tolist()
            gain, model = 0.0, best.model
            for entry, other in itertools.combinations(sorted(weakest, reverse=True), 2):
                reduced_state = state.without(entry).without(other)
                for block, level in self._likeliest(reduced_state):
                    more = reduced_state.with_block(block, level)
                    index = np.unravel_index(np.argmax(more.gains), more.gains.shape)
                    value = more.value + more.gains[index] - state.value
                    if value > gain + SETTLED:
                        exchanged = more.with_block(int(index[0]), int(index[1]))
                        if exchanged.is_physical:
                            gain, model = value, exchanged.key
            if model != best.model:
                found.append(self._refitted(model, best, new_background=True))
        better = max(found, key=lambda entry: entry.value, default=None)
        if better is None or better.value < self._best_found.value + SETTLED:
            return None
        return better

    def _likeliest(self, state: State) -> list[tuple[int, int]]:
        """Return (block, level) of the causes that gain most if added to a state, best first.

        For each cause (`identity`) its best block. At most `MOST_FIRST` causes.
        """
        gain = state.gains.max(axis=1)
        causes: dict[Identity, int] = {}
        for block in np.argsort(-gain).tolist():
            if len(causes) == MOST_FIRST or not np.isfinite(gain[block]):
                break
            causes.setdefault(identity(self.pool.blocks[block].candidate), block)
        return [(block, int(np.argmax(state.gains[block]))) for block in causes.values()]

    def _with_steps(self) -> list[Evaluated]:
        """Return models with the likeliest step added, dated between the moments tried.

        A step dated a few configurations wrong explains less than what imitates it (a sensor
        that wanders or drifts), and no chain has it; at its own moment it may explain more. Each
        best model of a chain is tried with its background, and without the wander of sensors.
        [] if no step is likely: none that changes the log posterior by more than -`NEEDED`.
        """
        found = []
        for best in {chain.best.model: chain.best for chain in self.chains}.values():
            for families in self._backgrounds(best):
                std = {entry.candidate: best.std[entry.candidate] for entry in families}
                surface = self._surface(best.noise, std)
                gain = State.of(surface, best.model).gains.max(axis=1)
                # Of each cause the likeliest moment of those tried.
                likeliest: dict[Identity, int] = {}
                for index in np.argsort(-gain).tolist():
                    candidate = self.pool.blocks[index].candidate
                    if gain[index] <= -NEEDED:
                        break
                    if candidate.happened and candidate.changes is None:
                        likeliest.setdefault(identity(candidate), index)
                if not likeliest:
                    continue
                tried = [block.candidate for block in self.pool.blocks]
                for index in likeliest.values():
                    self.pool.extend(blocks_of(self.data, self._beside(tried[index], tried)))
                surface.extend()
                gains = State.of(surface, best.model).gains.copy()
                steps = [
                    entry.candidate.happened and identity(entry.candidate) in likeliest
                    for entry in self.pool.blocks
                ]
                gains[~np.array(steps)] = -np.inf
                step, level = np.unravel_index(np.argmax(gains), gains.shape)
                model = tuple(sorted((*best.model, (int(step), int(level)))))
                entry = self._physical(families, model, best)
                found += [] if entry is None else [entry]
        return found

    def _backgrounds(self, best: Evaluated) -> list[tuple[Family, ...]]:
        """Return the families of a model, and those without the wander of sensors, if it has it.

        The wander imitates whatever happens at a moment.
        """
        steady = tuple(
            entry for entry in best.families if entry.members[0].name != SENSOR_WANDER.name
        )
        return [best.families, steady][: 1 + (len(steady) < len(best.families))]

    def _beside(self, candidate: Candidate, tried: Sequence[Candidate]) -> list[Candidate]:
        """Return a candidate's cause at the gaps near its moment, up to the next moments tried.

        Those that are in the pool are left out. ``tried``: candidates of all effects, with the
        moments that were tried.
        """
        moments = np.unique([entry.moment for entry in tried if entry.name == candidate.name])
        low = np.max(moments[moments < candidate.moment], initial=-np.inf)
        high = np.min(moments[moments > candidate.moment], initial=np.inf)
        return [
            other
            for other in at_other_moments(candidate, self.data.part, float(low), float(high))
            if other.key not in self.pool.place
        ]

    def _with_changes(self, changes: Sequence[Candidate]) -> list[Evaluated]:
        """Add likely changes in mid-session to the pool; return models with the best one added.

        ``changes``: candidates that begin or end at a moment. A change is likely if, added to the
        best model of a chain or in place of one of its blocks, it changes the log posterior by
        more than -`NEEDED`. Each best model is tried with its background, and without the wander
        of sensors, which imitates any change; it returns with the change that gains most when
        added, if that is in the pool. [] if no change is likely.
        """
        blocks, found = blocks_of(self.data, changes), []
        for best in [chain.best for chain in self.chains] if blocks else []:
            mine = [self.pool.blocks[block] for block, _ in best.model]
            levels = tuple((i, level) for i, (_, level) in enumerate(best.model))
            pool = Pool(self.data, [*mine, *blocks])
            for families in self._backgrounds(best):
                std = {entry.candidate: best.std[entry.candidate] for entry in families}
                state = State.of(Surface(pool, best.noise, std), levels)
                gains = state.gains[len(mine) :]
                gain = gains.max(axis=1)
                for position in range(len(mine)):
                    other = state.without(position)
                    there = other.gains[len(mine) :].max(axis=1) + other.value - state.value
                    gain = np.maximum(gain, there)
                likely = [blocks[i] for i in np.flatnonzero(gain > -NEEDED).tolist()]
                self.pool.extend(
                    [entry for entry in likely if entry.candidate.key not in self.pool.place]
                )
                if not likely:
                    continue
                index, level = np.unravel_index(np.argmax(gains), gains.shape)
                added = self.pool.place.get(blocks[index].candidate.key)
                if added is not None:
                    model = tuple(sorted((*best.model, (added, int(level)))))
                    entry = self._physical(families, model, best)
                    found += [] if entry is None else [entry]
        return found

    def _refined(self) -> bool:
        """Add candidates near those of the best model to the pool; True if there are new ones.

        For a cause that happened at a moment: the same cause at the gaps between the moments
        tried before and after it, and, in the gaps nearest to it, the changes of every cause
        that may change. For another cause: those that `Effect.finer` yields. The standard
        deviations of the moments are computed anew.
        """
        best = self._best_found
        context, tried = self.data.part, [block.candidate for block in self.pool.blocks]
        added = False
        waiting: dict[object, Candidate] = {}
        for position, (block, _) in enumerate(best.model):
            candidate = self.pool.blocks[block].candidate
            if not candidate.happened:
                finer = EFFECTS[candidate.name].finer
                nearby = [] if finer is None else [*finer(context, candidate)]
                waiting |= {
                    entry.key: entry for entry in nearby if entry.key not in self.pool.place
                }
                continue
            added = added or bool(waiting)
            self.pool.extend(blocks_of(self.data, [*waiting.values()]))
            waiting = {}
            first = len(self.pool.blocks)
            self.pool.extend(blocks_of(self.data, self._beside(candidate, tried)))
            surface = self._surface(best.noise, best.std)
            reduced_state = State.of(surface, best.model[:position] + best.model[position + 1 :])
            spread = self._spread_of_moments(reduced_state, candidate)
            for i, entry in enumerate(self.pool.blocks):
                # A chain that follows may date it otherwise.
                if identity(entry.candidate) == identity(candidate):
                    self.pool.blocks[i] = replace(
                        entry, candidate=replace(entry.candidate, moment_std=spread)
                    )
            self._known.clear()
            self._wholes.clear()
            added = added or len(self.pool.blocks) > first
        added = added or bool(waiting)
        self.pool.extend(blocks_of(self.data, [*waiting.values()]))
        happened = [
            candidate
            for block, _ in best.model
            if (candidate := self.pool.blocks[block].candidate).happened
        ]
        near_these = {
            change.key: change
            for candidate in happened
            for change in self._changes_near(candidate.moment)
            if change.key not in self.pool.place
        }
        self.pool.extend(blocks_of(self.data, [*near_these.values()]))
        return added or bool(near_these)

    def _spread_of_moments(self, state: State, candidate: Candidate) -> float:
        """Return the standard deviation of the moment at which a cause happened, s.

        About the likeliest of all moments tried; each counts by its posterior weight if added
        to ``state``, and by its distance to its neighbours.
        """
        same = [
            (block.candidate.moment, state.gains[index].max())
            for index, block in enumerate(self.pool.blocks)
            if identity(block.candidate) == identity(candidate)
            and block.candidate.variant == candidate.variant
        ]
        at, gain = np.array(sorted(same)).T
        weight = np.exp(gain - gain.max())
        if len(at) > 1:
            weight = weight * np.maximum(np.gradient(at), 0.0)
        middle = at[np.argmax(gain)]
        return float(np.sqrt(np.average((at - middle) ** 2, weights=weight)))

    def _changes_near(self, moment: float) -> list[Candidate]:
        """Return changes of all causes that may change, in the `NEAREST` gaps about a moment, s.

        What changes at one moment looks like several steps there, and the moments tried of
        changes lie further apart than those of steps.
        """
        context = self.data.part
        found = gaps(context)
        nearest = found[np.argsort(np.abs(found.mean(axis=1) - moment))[:NEAREST]]
        return [
            change
            for candidate in self._changing
            if (changes := EFFECTS[candidate.name].changes) is not None
            for gap in nearest
            for change in changed_at(candidate, changes, gap)
        ]

    def _again(self, start: Evaluated) -> Evaluated:
        """Fit the best model of an earlier walk to this walk's residuals.

        ``start``: that model, whose blocks are found in the pool by the keys of their
        candidates; blocks that are not in it are left out. `empty` if it cannot be fitted.
        """
        place, levels = self.pool.place, {}
        for candidate, level in start.blocks:
            if candidate.key in place:
                levels[place[candidate.key]] = level
        again = self._whole(tuple(sorted(levels.items())), start)
        return self.empty if again is None else again

    def _shown(self, found: Evaluated) -> Evaluated:
        """Return a model without the families of random effects whose evidence is too small.

        Too small: a log Bayes factor of at most the price (`log_price`, at least `PRICE`). The
        worse half of these is taken out at a time, and the model fitted again, so that one of
        two families that imitate each other stays. Then those go of which a member stands out
        with a sign that physics excludes.
        """
        while True:
            worth = [
                found.log_factor_of_kind(family) - max(PRICE, -log_price([family]))
                for family in found.families
            ]
            if min(worth, default=0.0) > 0.0:
                worth = [
                    -np.inf if family.candidate in found.excluded else value
                    for family, value in zip(found.families, worth, strict=True)
                ]
            hidden = sorted(value for value in worth if value <= 0.0)
            if not hidden:
                return found
            most = hidden[(len(hidden) - 1) // 2]
            shown = [f for f, value in zip(found.families, worth, strict=True) if value > most]
            fewer = evaluated(self.pool, shown, found.model, found)
            if fewer is None:
                return found
            found = fewer

    def _surface(self, noise: Noise, background: Mapping[Candidate, float]) -> Surface:
        """Return the surface for a noise and a background, with all blocks of the pool.

        ``background``: prior std of the weights of each family of random effects, m. It is the
        last surface if that is for the same; else a new one that takes over the memory of the
        last, which must not be used any more.
        """
        last = self._last_surface
        if last is None or not last.has(noise, background):
            last = self._last_surface = Surface(self.pool, noise, background, last)
        last.extend()
        return last

    def evaluate(self, model: Model, start: Evaluated) -> Evaluated | None:
        """Fit a model with the families of random effects of ``start``, at its own noise.

        The search for the noise begins at that of ``start``. None if it cannot be fitted, or is
        not physical. A model evaluated before is not fitted again: that result is returned.
        """
        if model not in self._known:
            self._known[model] = self._physical(start.families, model, start)
        return self._known[model]

    def _physical(
        self, families: Sequence[Family], model: Model, start: Evaluated
    ) -> Evaluated | None:
        """Return `evaluated` of a model; None also if something has a sign physics excludes."""
        found = evaluated(self.pool, families, model, start)
        return found if found is not None and found.is_physical else None

    def _chain(self, current: Evaluated, hot: bool, before: Evaluated | None = None) -> Chain:
        """Run a chain in rounds, each at the noise and background of the best model so far.

        ``current``: model to begin at; ``hot``: begin at a raised temperature; ``before``:
        earlier model whose noise and background the first round has. The chain ends if a round
        finds nothing better, even with the families of the background chosen anew.
        """
        new_background = current is self.bare or before is not None
        for index in range(ROUNDS):
            noise, std = current.noise, current.std
            if before is not None and index == 0:
                known = {candidate.key: value for candidate, value in before.std.items()}
                every = (*self.families, *self.by_form)
                noise = before.noise
                std = {
                    f.candidate: known[f.candidate.key] for f in every if f.candidate.key in known
                }
            surface = self._surface(noise, std)
            walker = Walker(State.of(surface, current.model), self.rng)
            self._run(walker, hot)
            best = max(walker.seen, key=lambda model: walker.seen[model])
            found = self._refitted(best, current, new_background)
            if current is not self.bare and found.value < current.value + SETTLED:
                if new_background:
                    break
                # Kinds that were not shown beside other blocks may be now.
                new_background = True
                found = self._refitted(current.model, current, new_background)
                if found.value < current.value + SETTLED:
                    break
            current, hot = found, False
        offset = current.value - walker.seen.get(current.model, walker.seen[best])
        visited = {model: value + offset for model, value in walker.seen.items()}
        return Chain(current, visited)

    def _run(self, walker: Walker, hot: bool) -> None:
        """Make steps of a chain until no better state was found for a while, or `STEPS`.

        ``hot``: with the temperature lowered over the first steps.
        """
        best, since = -np.inf, 0
        for step in range(STEPS):
            walker.step(min(1.0, 0.3 + step / (0.5 * STEPS)) if hot else 1.0)
            since += 1
            if walker.state.value > best + SETTLED:
                best, since = walker.state.value, 0
            if since > PATIENCE + len(walker.state.model) * PATIENCE_EACH:
                break

    def _whole(self, model: Model, start: Evaluated | None) -> Evaluated | None:
        """Fit a model with the families of random effects of its background chosen anew.

        Tried are one variance for all free forms (splines) of an effect, and one for each of
        them; the better is returned, without families of too little evidence. ``start``: where
        the search for the noise begins. None if the model cannot be fitted, or is not physical. A
        model fitted here before is not fitted again: that result is returned.
        """
        if model not in self._wholes:
            tried = [
                self._shown(found)
                for families in (self.families, self.by_form)
                if (found := evaluated(self.pool, families, model, start)) is not None
            ]
            self._wholes[model] = max(
                (found for found in tried if found.is_physical),
                key=lambda result: result.value,
                default=None,
            )
        return self._wholes[model]

    def _refitted(self, model: Model, before: Evaluated, new_background: bool) -> Evaluated:
        """Fit a model at its own noise, and move causes that stand out of its background to it.

        They become single causes (blocks) as long as that raises the log posterior.
        ``before``: model with noise to begin at, and returned if ``model`` cannot be fitted;
        ``new_background``: choose the families of random effects anew.
        """
        best = None if new_background else self.evaluate(model, before)
        if best is None:
            # Beside another background a model may be physical.
            best = self._whole(model, before)
        if best is None:
            return before
        self._known[model] = best
        while True:
            more = self._swapped(best)
            if more is None or more.value <= best.value:
                return best
            best = more

    def _swapped(self, found: Evaluated) -> Evaluated | None:
        """Return a model with background members that stand out added as single causes (blocks).

        At the level nearest to their size. None if none stands out, or if the model cannot be
        fitted.
        """
        have = {
            name
            for block, _ in found.model
            for name in self.pool.blocks[block].candidate.parameters
        }
        more = []
        for _, member, where, mapping in found.members:
            block = self.pool.place.get(member.key)
            if block is None or found.standing_out[member] < 0.5 or have & {*member.parameters}:
                continue
            moved = self.data.columns([member]) @ (mapping @ found.estimate[0][where])
            size = np.sqrt(np.sum(moved**2) / len(self.data))
            distance = np.abs(np.log(LEVELS_M / max(size, NOTHING)))
            distance = np.where(self.pool.allowed[block], distance, np.inf)
            more.append((block, int(np.argmin(distance))))
        return self.evaluate(tuple(sorted({*found.model, *more})), found) if more else None

    def _weigh(self) -> None:
        """Set `models` and `share` from the models visited, the likely ones at their own noise."""
        pooled: dict[Model, float] = {}
        for chain in self.chains:
            for model, value in chain.visited.items():
                pooled[model] = max(value, pooled.get(model, -np.inf))
        for chain in self.chains:
            known = self._known.get(chain.best.model)
            if known is None or known.value < chain.best.value:
                # With its own background; candidates may have been dated since.
                again = self._physical(chain.best.families, chain.best.model, chain.best)
                self._known[chain.best.model] = again
        pooled |= {
            model: evaluation.value
            for model, evaluation in self._known.items()
            if evaluation is not None
        }
        start = self._best_found
        for model, value in self._exchanges(start).items():
            pooled[model] = max(value, pooled.get(model, -np.inf))
        order = sorted(pooled, key=lambda model: -pooled[model])[:MOST_MODELS]
        models = [
            evaluation
            for model in order
            if pooled[model] > start.value - NEGLIGIBLE
            and (evaluation := self.evaluate(model, start)) is not None
        ]
        models.sort(key=lambda evaluation: -evaluation.value)
        values = np.array([evaluation.value for evaluation in models])
        share = np.exp(values - logsumexp(values))
        count = int(np.sum(share > LEAST_SHARE))
        self.models = models[:count]
        self.share = share[:count] / share[:count].sum()

    @cached_property
    def independent_share(self) -> float:
        """Share of the readings that count as independent, by the autocorrelation of errors.

        With the correlation r of successive errors of a sensor and marker, (1 - r) / (1 + r)
        (Bartlett 1946). Errors: what the best model leaves, with a sensor's wander added. 1 if
        r may be chance.
        """
        data, best, m = self.data, self.best, self.data.part.measurements
        residuals = data.left(best)
        for candidate, where in zip(best.candidates, best.slices(), strict=True):
            if candidate.name == SENSOR_WANDER.name:
                residuals = residuals + data.columns([candidate]) @ best.parameters[where]
        order = np.lexsort((data.part.elapsed_s, data.part.marker, data.part.sensor))
        rows, other = order[:-1], order[1:]
        follows = (
            (data.part.sensor[rows] == data.part.sensor[other])
            & (data.part.marker[rows] == data.part.marker[other])
            # Errors of one pose have a part in common all the same.
            & (m.pose[rows] != m.pose[other])
        )
        rows, other = rows[follows], other[follows]
        squares = np.sum(residuals[rows] ** 2) * np.sum(residuals[other] ** 2)
        if not squares:
            return 1.0
        r = float(np.sum(residuals[rows] * residuals[other]) / np.sqrt(squares))
        return 1.0 if r < 2.0 / np.sqrt(3.0 * len(rows)) else (1.0 - r) / (1.0 + r)

    def log_gain(self, causes: Sequence[Candidate], share: float = 1.0) -> float:
        """Return the loss in log posterior of the best model by leaving out some of its causes.

        ``causes``: candidates, of which at least one is in it; ``share``: share of the readings
        that are independent, by which the log Bayes factor is multiplied.
        """
        best, mine = self.models[0], {identity(candidate) for candidate in causes}
        wheres, stds, price = [], [], 0.0
        for block, level in best.model:
            pool_block = self.pool.blocks[block]
            if identity(pool_block.candidate) in mine:
                part = best.where[pool_block.weights(level)]
                wheres.append(np.arange(part.start, part.stop))
                stds.append(np.full(pool_block.size, LEVELS_M[level]))
                price += pool_block.log_prior
        for family, member, where, _ in best.members:
            if identity(member) in mine:
                wheres.append(where)
                stds.append(np.full(len(where), best.std[family.candidate]))
                price -= np.log(member.drawn_from) if not price else 0.0
        return share * best.log_factor(np.concatenate(wheres), np.concatenate(stds)) + float(price)

    @cached_property
    def solutions(self) -> list[tuple[Solution, float]]:
        """Each of `models` as a solution in its candidates' parameters, with its share."""
        other_solutions = [self.solution(model) for model in self.models[1:]]
        return [*zip([self.best, *other_solutions], self.share.tolist(), strict=True)]

    @cached_property
    def best(self) -> Solution:
        """Model of the largest share, as a solution."""
        return self.solution(self.models[0])

    def _exchanges(self, best: Evaluated) -> dict[Model, float]:
        """Return models that differ from the best one in one block and are nearly as likely.

        With their log posterior at the best one's noise. A chain visits few of them, and
        look-alikes are among these.
        """
        found: dict[Model, float] = {}
        state = State.of(self._surface(best.noise, best.std), best.model)
        for position in range(len(best.model)):
            reduced_state = state.without(position)
            order = np.argsort(-reduced_state.gains, axis=None)[:MOST_EXCHANGED]
            for block, level in zip(
                *np.unravel_index(order, reduced_state.gains.shape), strict=True
            ):
                if (
                    reduced_state.value + reduced_state.gains[block, level]
                    > state.value - NEGLIGIBLE
                ):
                    other = reduced_state.with_block(int(block), int(level))
                    found[other.key] = best.value + other.value - state.value
        return found

    def probability_of(self, candidate: Candidate) -> float:
        """Return the probability that a candidate's cause is present, by all models.

        At any moment, order or axis; 0 if no model has it. A cause of the whole session also
        counts in models in which it begins or ends.
        """
        return self.probability.get(_claims(candidate), 0.0)

    @cached_property
    def claimed(self) -> list[Candidate]:
        """Candidates of `best` that are reported: causes of a probability of at least 1/2.

        The probability includes that of look-alikes. Left out are fixed shapes (such as gear
        waves) that are part of a free form among them, and candidates of the same cause by
        another axis that explain less.
        """
        found = []
        best = self.models[0]
        named = self.named(best)
        blocks = {identity(self.pool.blocks[block].candidate) for block, _ in best.model}
        for candidate in named:
            if any(self._is_part(candidate, form) for form in named):
                continue
            if identity(candidate) in blocks and candidate in best.standing_out:
                # The same cause by another axis or direction, which the background has.
                continue
            if candidate in best.standing_out and best.by_itself[candidate] < 0.0:
                mine = [cause for cause in named if identity(cause) == identity(candidate)]
                if candidate is not max(mine, key=lambda cause: best.by_itself.get(cause, np.inf)):
                    continue
            chance = self.probability_of(candidate)
            if chance >= 0.5 or chance + sum(self.instead_of([candidate]).values()) >= 0.5:
                # A member may be a part of a block.
                found += [
                    cause
                    for cause in self.best.candidates
                    if cause not in found and {*cause.parameters}.issuperset(candidate.parameters)
                ]
        return found

    def _is_part(self, candidate: Candidate, form: Candidate) -> bool:
        """Return whether a candidate, such as a gear wave, is part of a free form (a spline).

        True if its effect has thousands of candidates (`Effect.many`), it is one of the form's
        shapes, and the form reproduces nearly all of its displacement.
        """
        if not (EFFECTS[candidate.name].many and candidate.is_shape_of(form)):
            return False
        both = [
            self.data.columns([cause]).reshape(3 * len(self.data), -1)
            for cause in (candidate, form)
        ]
        residual = both[0] - both[1] @ np.linalg.lstsq(both[1], both[0], rcond=None)[0]
        return bool(np.sum(residual**2) < (1.0 - PART_OF_A_CURVE) * np.sum(both[0] ** 2))

    def instead_of(self, group: Sequence[Candidate]) -> dict[Candidate, float]:
        """Return candidates that other models have in place of some causes, with probabilities.

        Counted are models without any cause of ``group``; of these, the candidates that the
        best model does not have. {} if every model has a cause of the group.
        """
        mine = {_claims(candidate) for candidate in group}
        best = {identity(candidate) for candidate in self.named(self.models[0])}
        found: dict[Identity, float] = {}
        candidates: dict[Identity, Candidate] = {}
        for model, share in zip(self.models, self.share, strict=True):
            named = {identity(candidate): candidate for candidate in self.named(model)}
            if mine & {*named, *map(at_any_time, named.values())}:
                continue
            for key in named.keys() - best:
                candidates.setdefault(key, named[key])
                found[key] = found.get(key, 0.0) + float(share)
        return {candidates[key]: chance for key, chance in found.items()}

    @cached_property
    def probability(self) -> dict[Identity, float]:
        """Probability of each cause that some model has, by the keys `identity` and `at_any_time`.

        A cause counts as a single cause (block), or as a member of the background with its
        probability of standing out.
        """
        found: dict[Identity, float] = {}
        for model, share in zip(self.models, self.share, strict=True):
            present: dict[Identity, float] = {}
            for candidate, chance in self.present(model).items():
                for key in (identity(candidate), at_any_time(candidate)):
                    present[key] = max(chance, present.get(key, 0.0))
            for key, chance in present.items():
                found[key] = found.get(key, 0.0) + float(share) * chance
        return found

    def present(self, model: Evaluated) -> dict[Candidate, float]:
        """Return the probability that each candidate of a model is a cause, given the model.

        1 for its blocks, `Evaluated.standing_out` for members of its background.
        """
        blocks = {self.pool.blocks[block].candidate: 1.0 for block, _ in model.model}
        have = {name for candidate in blocks for name in candidate.parameters}
        out = {
            member: chance
            for member, chance in model.standing_out.items()
            if not have.issuperset(member.parameters)
        }
        return blocks | out

    def named(self, model: Evaluated) -> list[Candidate]:
        """Return the candidates of a model that are causes with a probability of at least 1/2."""
        return [candidate for candidate, chance in self.present(model).items() if chance >= 0.5]

    def solution(self, model: Evaluated) -> Solution:
        """Return a model as a solution, in the parameters of its candidates.

        The candidates are those of its blocks and of its background. Of one that is in both,
        the parameters are the sum: its size is not shrunk by the variance of its family.
        """
        p = self.data.base.shape[2]
        mean, covariance = model.estimate
        parts: list[tuple[Candidate, slice, FloatArray, FloatArray, float]] = []
        for block, level in model.model:
            entry = self.pool.blocks[block]
            where = model.where[entry.weights(level)]
            parts.append((entry.candidate, where, entry.map, entry.scale, LEVELS_M[level] ** -2.0))
        scales = {
            member: scale
            for family in model.families
            for member, scale in zip(family.members, family.scales, strict=True)
        }
        for family, member, places, mapping in model.members:
            where = slice(int(places[0]), int(places[-1]) + 1)
            parts.append(
                (member, where, mapping, scales[member], model.std[family.candidate] ** -2.0)
            )
        # A member may be a part of a block: both are parameters of the larger.
        candidates: list[Candidate] = []
        having: dict[str, list[Candidate]] = {}
        for candidate, *_ in sorted(parts, key=lambda part: -part[0].size):
            larger = having.get(candidate.parameters[0], [])
            if not any(set(entry.parameters).issuperset(candidate.parameters) for entry in larger):
                candidates.append(candidate)
                for name in candidate.parameters:
                    having.setdefault(name, []).append(candidate)
        candidates.sort(key=lambda candidate: candidate.penalty is not None)
        names = [name for candidate in candidates for name in candidate.parameters]
        row = {name: p + i for i, name in enumerate(names)}
        to = np.zeros((p + len(names), len(mean)))
        to[:p, :p] = np.eye(p)
        variance = np.zeros(len(names))
        for candidate, where, mapping, scale, precision in parts:
            rows = np.array([row[name] for name in candidate.parameters])
            to[rows, where] += mapping
            variance[rows - p] += 1.0 / (precision * scale)
        every = to @ mean
        edges = np.cumsum([0, *(candidate.size for candidate in candidates)])
        smooth = np.array([candidate.penalty is not None for candidate in candidates], dtype=bool)
        ridge = np.where(np.repeat(smooth, np.diff(edges)), 0.0, 1.0 / variance)
        smoothness = np.where(smooth, 1.0 / variance[edges[:-1]], np.nan)

        def covariances() -> tuple[FloatArray, FloatArray]:
            full = to @ covariance @ to.T
            return full, full

        return Solution(
            tuple(candidates),
            every[p:],
            every[:p],
            model.noise,
            smoothness,
            ridge,
            Covariances(covariances),
            model.value,
        )
