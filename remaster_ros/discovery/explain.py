"""The chosen candidates as causes: grouped by name, compared with look-alikes, in sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit

from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.walk import NEEDED, Identity, Walk, at_any_time, identity, p_value
from remaster_ros.discovery.words import (
    KIND_OF_SUBJECT,
    clock_time,
    joint_words,
    place_words,
    probability_text,
    sentence_case,
    titled,
)
from remaster_ros.types import BoolArray, FloatArray, IntArray

# A cause of at least this probability is stated as one; the odds are twenty to one.
CERTAIN = 0.95
# A look-alike of a smaller probability is not mentioned.
MENTIONED = 0.01
# Causes that are rather not there: those of at least this probability are listed, so many at most.
LISTED_FROM, MOST_LISTED = 0.05, 10
# Of the size of a part of a cause, in its standard deviations: below it a sentence leaves it out.
CLEAR = 2.0
# Columns that agree to this in every pose are the same change under two names.
SAME = 1.0 - 1e-6
# Of a matrix with ones on its diagonal.
ROUNDING = 1e-12
OTHER_FORM = 'a part or another form of a cause that is named'
NOT_IN_BEST = 'other models have it, the likeliest one has not'
"""Why a cause of a probability above one half is not named."""
CHANGED = (
    'Find what was changed at that moment: a payload put on or taken off, a setting of the '
    'controller, something that came loose. Measure before and after it in sessions of their own.'
)
"""Remedy for a cause that begins or changes in mid-session."""


class Parameter(Struct, frozen=True):
    """A parameter of an effect: posterior mean and standard deviation in its unit."""

    name: str
    value: float
    std: float
    unit: str


class LookAlike(Struct, frozen=True):
    """Another cause that models have in the place of a found one, as discovery.json has it."""

    # As of an effect
    name: str
    joints: tuple[int, ...]
    log_evidence_gain: float  # Of the look-alike in the effect's place
    separate_by: str  # Which measurements would decide
    same: bool = False  # No measurement of these markers could: the two displace every pose alike
    general: bool = False  # It is a free form, and the effect one of the shapes that it can have
    title: str = ''  # A heading for people
    probability: float | None = None  # That it is there and the effect is not; None: not known


class FoundEffect(Struct, frozen=True):
    """Cause found in a session, as discovery.json has it.

    Fields with a default are missing in files of other versions.
    """

    name: str
    joints: tuple[int, ...]
    place: str
    driver: str
    form: str
    parameters: tuple[Parameter, ...]
    p_value: float
    log_evidence_gain: float
    confusable_with: tuple[LookAlike, ...]
    cause: str
    # RMS of what it does to the marker after absorption, over the fitted rows, m; NaN: not known
    size_m: float = float('nan')
    # Of the gain on held-out poses, see `shares`; None if the cause was found by how far the
    # fit moved a marker, not in the residuals
    share: float | None = None
    # A look-alike that measurements could distinguish explains the data as well
    tied: bool = False
    # What each of its candidates amounts to, in arc minutes and millimetres with uncertainty
    sizes: tuple[str, ...] = ()
    remedy: str = ''  # What to do about it
    title: str = ''  # A heading for people, such as 'Link length of joint 2'
    in_robot_model: bool = False  # A corrected robot model holds it
    of_measurement: bool = False  # It lies in how the arm was measured and not in the arm
    # When it happened, s since the first reading, where it came at one moment and stayed
    moment_s: float | None = None
    # That it is there, whichever of its indistinguishable names it has; None in files of earlier
    # versions
    probability: float | None = None

    def sampled(
        self, result: FitResult, group: Sequence[Candidate] = (), data: Residuals | None = None
    ) -> FoundEffect:
        """Return a copy of the effect with a sampled fit's parameters and a complete sentence.

        ``result``: the sampled fit; ``group``: the effect's candidates; ``data``: the residuals
        they were fitted to. If both are given, the effect's sizes are computed anew. The
        sentence gets the sizes. If the cause is not certain, it gets a warning, and the remedy
        is put off until more poses are measured.
        """
        found = self
        index = {name: i for i, name in enumerate(result.theta_names)}
        theta, std = result.theta, result.theta_std
        parameters = tuple(
            replace(
                parameter,
                value=float(theta[index[parameter.name]]),
                std=float(std[index[parameter.name]]),
            )
            if parameter.name in index
            else parameter
            for parameter in self.parameters
        )
        if data is not None and group:
            draws = result.theta_draws.reshape(-1, len(index))
            wheres = [[index[name] for name in candidate.parameters] for candidate in group]
            sizes = tuple(
                EFFECTS[candidate.name].size(data.part, candidate, draws[:, where])
                for candidate, where in zip(group, wheres, strict=True)
            )
            size_m = _size(data, group, [result.theta[where] for where in wheres])
            found = replace(found, sizes=sizes, size_m=size_m)
        found = replace(found, parameters=parameters)
        found = replace(found, cause=with_sizes(self.cause, found._clear_sizes(group)))
        if found.is_certain:
            return found
        doubt = (
            f'Not certain: its probability is {probability_text(found.probability)}. Measure more '
            'poses before it is acted on.'
        )
        return replace(found, cause=f'{found.cause} {doubt}', remedy=_later(found.remedy))

    def _clear_sizes(self, group: Sequence[Candidate]) -> tuple[str, ...]:
        """Return the sizes of the candidates that are clearly not zero, and a count of the others.

        Clearly: a parameter of at least `CLEAR` standard deviations. All sizes if that is none
        or all of them. ``group``: the effect's candidates, in the order of its sizes.
        """
        sigmas = {
            parameter.name: abs(parameter.value) / parameter.std
            for parameter in self.parameters
            if parameter.std > 0.0
        }
        clear = tuple(
            size
            for size, candidate in zip(self.sizes, group, strict=False)
            if max((sigmas.get(name, np.inf) for name in candidate.parameters), default=np.inf)
            >= CLEAR
        )
        other_count = len(self.sizes) - len(clear)
        if not clear or not other_count:
            return self.sizes
        words = f'{other_count} more' if other_count > 1 else 'one more'
        return (*clear, f'{words} within two standard deviations of nothing')

    @property
    def sigmas(self) -> float:
        """Largest |value| / std among the parameters; infinite if none has a std above 0."""
        return clearest((parameter.value, parameter.std) for parameter in self.parameters)

    @property
    def is_certain(self) -> bool:
        """Whether the cause's probability is at least `CERTAIN`; True if it is unknown (None)."""
        return self.probability is None or self.probability >= CERTAIN

    @property
    def is_taken_out(self) -> bool:
        """Whether fits for the controller remove this effect: a certain error of the measurement.

        An uncertain one stays, as lengths and offsets that imitate it may be right.
        """
        return self.of_measurement and self.is_certain


def clearest(parameters: Iterable[tuple[float, float]]) -> float:
    """Largest |value| / std of (value, std) pairs with std > 0; infinite if there are none."""
    return max((abs(value) / std for value, std in parameters if std > 0.0), default=np.inf)


def _later(remedy: str) -> str:
    """Return a remedy put off: 'Measure more poses first. If it stays: …'; '' for ''."""
    return f'Measure more poses first. If it stays: {remedy}' if remedy else ''


def with_sizes(cause: str, sizes: Sequence[str]) -> str:
    """Return the sentence of a cause with its sizes inserted before the first full stop.

    The sentence as it is if there are no sizes.
    """
    if not sizes:
        return cause
    first, stop, remainder = cause.partition('. ')
    return f'{first.removesuffix(".")}: {"; ".join(sizes)}.{" " if stop else ""}{remainder}'


def describe(
    walk: Walk, progress: Callable[[float], None]
) -> tuple[tuple[tuple[Candidate, ...], ...], tuple[FoundEffect, ...]]:
    """Return the causes of a walk's best model: their candidates, and their descriptions.

    The largest first. Causes that may be noise correlated in time are left out. ``progress``:
    called with the share done.
    """
    data, solution = walk.data, walk.best
    groups = [group for group in grouped(walk.claimed) if not _may_be_memory(walk, group)]
    groups.sort(key=lambda group: -size_of(data, solution, group))
    parts = shares(data, groups, solution)
    effects = []
    for count, (group, share) in enumerate(zip(groups, parts, strict=True)):
        progress(count / len(groups))
        effects.append(_described(walk, group, share))
    return tuple(groups), tuple(effects)


def _may_be_memory(walk: Walk, group: tuple[Candidate, ...]) -> bool:
    """Return whether a cause may be noise correlated in time, which looks like a slow change.

    True if the cause gains no log posterior when the readings count only by the share of them
    that is independent. False if all readings are independent, or if the group is structure
    without a cause (`Effect.is_cause`).
    """
    share = walk.independent_share
    is_cause = EFFECTS[group[0].name].is_cause
    return is_cause and share < 1.0 and walk.log_gain(group, share) < 0.0


def grouped(candidates: Sequence[Candidate]) -> list[tuple[Candidate, ...]]:
    """Return the candidates that are one cause as tuples, in the order of their first members.

    Such candidates agree in name, driver, form, subject, and time of a change; and in joints
    and variant as the effect's `cause_per` demands.
    """
    groups: dict[tuple[str, ...], list[Candidate]] = {}
    for candidate in candidates:
        key: tuple[str, ...] = (
            candidate.name,
            candidate.driver,
            candidate.form,
            candidate.subject,
        )
        cause_per = EFFECTS[candidate.name].cause_per
        if cause_per != 'effect':
            key += (str(candidate.joints), candidate.label if cause_per == 'variant' else '')
        if candidate.changes is not None:
            key += (f'{candidate.moment} {candidate.ends}',)
        groups.setdefault(key, []).append(candidate)
    return [tuple(group) for group in groups.values()]


def _described(walk: Walk, group: tuple[Candidate, ...], share: float) -> FoundEffect:
    """Description of a cause for the report.

    ``group``: its candidates in the best model; ``share``: of the gain on held-out poses that
    is lost without it, see `shares`.
    """
    data, solution, first = walk.data, walk.best, group[0]
    wheres = dict(zip(solution.candidates, solution.slices(), strict=True))
    variance = np.diag(solution.covariance)
    parameters = tuple(
        Parameter(name, float(value), float(np.sqrt(square)), candidate.unit)
        for candidate in group
        for name, value, square in zip(
            candidate.parameters,
            solution.parameters[wheres[candidate]],
            variance[wheres[candidate]],
            strict=True,
        )
    )
    if first.happened:
        # Nothing tells where between two readings it was.
        elapsed = data.part.elapsed_s
        gap = elapsed[elapsed > first.moment].min() - elapsed[elapsed <= first.moment].max()
        std = float(np.hypot(first.moment_std, gap / np.sqrt(12.0)))
        parameters += (Parameter('moment', first.moment, std, 's'),)
    gain = walk.log_gain(group)
    alike = _look_alikes(walk, group, gain)
    probability = max(walk.probability_of(candidate) for candidate in group)
    if walk.independent_share < 1.0 and EFFECTS[first.name].is_cause:
        probability = min(probability, float(expit(walk.log_gain(group, walk.independent_share))))
    # No measurement distinguishes names of the same displacement: it is there under any of them.
    probability += sum(other.probability or 0.0 for other in alike if other.same)
    return FoundEffect(
        name=EFFECTS[first.name].reported_as or first.name,
        joints=_joints(group),
        place=first.place,
        driver=first.driver,
        form=first.form,
        parameters=parameters,
        p_value=p_value(gain),
        log_evidence_gain=gain,
        confusable_with=alike,
        cause=in_words(group, data.part) + _also_called(alike),
        size_m=size_of(data, solution, group),
        share=share,
        remedy=EFFECTS[first.name].remedy_of(first) if first.changes is None else CHANGED,
        title=titled(first, _joints(group)),
        in_robot_model=all(candidate.model_change is not None for candidate in group),
        of_measurement=first.of_measurement,
        moment_s=first.moment if first.happened else None,
        tied=any(
            not (other.same or other.general)
            and (other.probability or 0.0) > probability * np.exp(-NEEDED)
            for other in alike
        ),
        probability=min(1.0, probability),
    )


def _also_called(alike: Sequence[LookAlike]) -> str:
    """Return a sentence on look-alikes with exactly the same displacement; '' if none has."""
    names = [sentence_case(other.title) for other in alike if other.same]
    if not names:
        return ''
    return (
        f' Exactly the same errors come from {" or ".join(names)}: no measurement of this marker '
        'distinguishes them, and either name corrects the arm.'
    )


def _joints(group: Sequence[Candidate]) -> tuple[int, ...]:
    """Return the joints (1-based) of a group of candidates.

    In their own order if all candidates have the same, else all joints of the group, sorted.
    """
    if len({candidate.joints for candidate in group}) == 1:
        return group[0].joints
    return tuple(sorted({joint for candidate in group for joint in candidate.joints}))


def _look_alikes(walk: Walk, group: tuple[Candidate, ...], gain: float) -> tuple[LookAlike, ...]:
    """Return the other causes that models have in the place of a group, the likeliest first.

    ``gain``: log posterior gained by the group; a look-alike's gain is this plus the log ratio
    of the probabilities. One for each name and joints; causes with a probability below
    `MENTIONED` are left out.
    """
    candidate, own_chance = group[0], max(walk.probability_of(candidate) for candidate in group)
    best: dict[tuple[str, tuple[int, ...]], LookAlike] = {}
    for other, chance in walk.instead_of(group).items():
        key = (other.name, other.joints)
        if chance < MENTIONED or key == (candidate.name, _joints(group)):
            continue
        if key in best and (best[key].probability or 0.0) >= chance:
            continue
        same = len(group) == 1 and _same(walk.data, candidate, other)
        best[key] = LookAlike(
            *key,
            float(gain + np.log(chance / max(own_chance, MENTIONED))),
            separate_by(candidate, other, same),
            same,
            len(group) == 1 and candidate.is_shape_of(other),
            titled(other, other.joints),
            chance,
        )
    return tuple(sorted(best.values(), key=lambda alike: -(alike.probability or 0.0)))


def _same(data: Residuals, candidate: Candidate, other: Candidate) -> bool:
    """Return whether two candidates displace the marker alike, up to their parameters' values.

    Compared over the rows worked on, after absorption by the offsets model. False if driver or
    number of parameters differ, or if a parameter displaces nothing.
    """
    if candidate.size != other.size or candidate.driver != other.driver:
        return False
    base = data.base.reshape(3 * len(data), -1)
    spaces = []
    for columns in (data.columns([candidate]), data.columns([other])):
        flat = columns.reshape(3 * len(data), -1)
        norm = np.linalg.norm(flat, axis=0)
        if not norm.all():
            # A part of a free form that no row shows.
            return False
        flat = flat / norm
        spaces.append(np.linalg.qr(flat - base @ (base.T @ flat))[0])
    cosines = np.linalg.svd(spaces[0].T @ spaces[1], compute_uv=False)
    return bool(cosines.min() > SAME)


class LessLikely(Struct, frozen=True):
    """Cause that some models of the walk have and that is not named, with its probability.

    Its probability is below one half unless ``why`` has the reason.
    """

    name: str
    joints: tuple[int, ...]
    title: str  # A heading for people
    probability: float
    why: str = ''


class SearchRecord(Struct, frozen=True):
    """Agreement of the chains of the search for causes, as discovery.json has it.

    ``log_posterior``: of the best model of each chain, from the offsets alone and from all
    kinds of errors on; ``models``: models of a share worth mentioning; ``best_share``: of the
    best.
    """

    log_posterior: tuple[float, ...]
    models: int
    best_share: float
    less_likely: tuple[LessLikely, ...]

    @classmethod
    def of(cls, walk: Walk, named: Sequence[tuple[Candidate, ...]]) -> SearchRecord:
        """Return the record of a walk, with probable causes that are not named.

        ``named``: candidates of each named cause. Listed are at most `MOST_LISTED` other causes,
        of a probability of at least `LISTED_FROM`, the likeliest first.
        """
        taken = {at_any_time(candidate) for group in named for candidate in group}
        candidates = {
            identity(candidate): candidate
            for model in walk.models
            for candidate in walk.present(model)
        }
        best = {identity(candidate) for candidate in walk.named(walk.models[0])}

        def why(key: Identity) -> str:
            if walk.probability[key] < 0.5:
                return ''
            return OTHER_FORM if key in best else NOT_IN_BEST

        less = [
            LessLikely(
                EFFECTS[candidate.name].reported_as or candidate.name,
                candidate.joints,
                titled(candidate, candidate.joints),
                walk.probability[key],
                why(key),
            )
            for key, candidate in candidates.items()
            if at_any_time(candidate) not in taken
            and EFFECTS[candidate.name].is_cause
            and walk.probability[key] >= LISTED_FROM
        ]
        less.sort(key=lambda entry: -entry.probability)
        return cls(
            tuple(round(chain.best.value, 2) for chain in walk.chains),
            len(walk.models),
            float(walk.share[0]),
            tuple(less[:MOST_LISTED]),
        )


def size_of(data: Residuals, solution: Solution, group: Sequence[Candidate]) -> float:
    """Return the RMS displacement by a cause that the offsets model cannot absorb, m.

    Over the rows worked on. ``group``: its candidates, all in ``solution``.
    """
    wheres = dict(zip(solution.candidates, solution.slices(), strict=True))
    return _size(data, group, [solution.parameters[wheres[candidate]] for candidate in group])


def _size(data: Residuals, group: Sequence[Candidate], parameters: Sequence[FloatArray]) -> float:
    """RMS displacement by candidates that the offsets model cannot absorb, m.

    ``parameters``: values of each candidate's parameters.
    """
    shift = np.zeros((len(data), 3))
    for candidate, values in zip(group, parameters, strict=True):
        shift += data.columns([candidate]) @ values
    flat, base = shift.ravel(), data.base.reshape(3 * len(data), -1)
    residual = flat - base @ (base.T @ flat)
    return float(np.sqrt(np.sum(residual**2) / len(data)))


def separate_by(candidate: Candidate, other: Candidate, same: bool) -> str:
    """Return a text on the measurements that distinguish two causes.

    ``same``: whether both displace this marker alike, so that no measurement does.
    """
    if same:
        return (
            'no pose of this marker can: both displace it alike '
            '(another name for the same change of the kinematics)'
        )
    texts = [
        EFFECTS[c.name].separate_by.format(driver=c.driver.replace('_', ' '))
        for c in (candidate, other)
    ]
    return '; and '.join(dict.fromkeys(texts))


def in_words(group: Sequence[Candidate], context: Context) -> str:
    """Return the sentence on a cause for a technician: what errs, how, and when if at a moment.

    ``group``: its candidates. It says so if gravity may be the cause but the URDF has no
    masses.
    """
    first = group[0]
    joints = _joints(group)
    effect = EFFECTS[first.name]
    whose = the(KIND_OF_SUBJECT.get(first.place, ''), first.subject) if first.subject else ''
    subject = whose or joint_words(joints[:1] if effect.driven_by_joint else joints)
    other = f'joint {joints[1]}' if len(joints) > 1 else ''
    place = place_words(first)
    if first.joints:
        place += f' of joint {first.joints[0]}'
    if whose:
        place += f' of {whose}'
    sentence = effect.sentence_of(group).format(
        subject=subject,
        other=other,
        driver=first.driver.replace('_', ' '),
        place=place,
        when=_when(first, context),
    )
    sentence = sentence[:1].upper() + sentence[1:]
    if first.changes is not None:
        when = _when(first, context).removesuffix(',')
        changed = 'ended, or became less' if first.ends else 'began, or changed'
        sentence += f' It {changed} by so much, {when}.'
    if not context.has_gravity and first.place == 'joint_angle' and 'angle' in first.driver:
        sentence += (
            ' It may be gravity that bends the arm: without link masses in the URDF '
            'the two cannot be distinguished.'
        )
    return sentence


def _when(candidate: Candidate, context: Context) -> str:
    """Return when a candidate happened, as text; '' if not at one moment.

    By the clock if times are of the clock, since the first row, and between which
    configurations: 'at …, 12.0 min after the first reading, between configurations 40 and
    41,'.
    """
    if np.isnan(candidate.moment):
        return ''
    configuration, after = context.measurements.configuration, context.elapsed_s > candidate.moment
    before = configuration[~after][np.argmax(context.elapsed_s[~after])]
    behind = configuration[after][np.argmin(context.elapsed_s[after])]
    stamp = candidate.moment + float(context.measurements.stamp_s[0] - context.elapsed_s[0])
    clock = f'at {words}, ' if (words := clock_time(stamp)) else ''
    return (
        f'{clock}{candidate.moment / 60.0:.1f} min after the first reading, '
        f'between configurations {before} and {behind},'
    )


def shares(
    data: Residuals, groups: Sequence[tuple[Candidate, ...]], solution: Solution
) -> list[float]:
    """Return the share of the gain in mean square that is lost without each cause, (groups,).

    ``groups``: candidates of each cause, all in ``solution``. Without one cause all other
    parameters are fitted again, at the same noise and prior variances. The errors are those of
    held-out rows, or of the rows worked on if there are none. The shares need not add up to 1:
    causes that imitate each other lose little each. A share is negative if the errors are smaller
    without the cause; all are 0 if all causes together gain nothing.
    """
    rows = data.context.measurements.is_validation
    if not rows.any():
        rows = np.isin(np.arange(len(rows)), data.rows.source)
    parts = _Parts.of(data, groups, solution, rows)
    every = set(range(len(groups)))
    with_all = parts.left(every)
    gain = parts.left(set()) - with_all
    if gain <= 0.0:
        return [0.0] * len(groups)
    return [(parts.left(every - {index}) - with_all) / gain for index in every]


@dataclass(frozen=True, eq=False)
class _Parts:
    """Normal equations for fits with only some of the causes, judged by errors in some rows.

    ``H``, ``pull``: equations of the base columns and all candidates; ``gram``: products of
    their displacements and the errors in the rows to judge, m²; ``base``, ``where``: indices
    of the base columns and of each cause.
    """

    H: FloatArray
    pull: FloatArray
    gram: FloatArray
    base: IntArray
    where: list[IntArray]

    @classmethod
    def of(
        cls,
        data: Residuals,
        groups: Sequence[tuple[Candidate, ...]],
        solution: Solution,
        rows: BoolArray,
    ) -> _Parts:
        """Assemble the equations; ``rows``: mask of those to judge by, (all rows,).

        ``groups``: candidates of each cause, all in ``solution``.
        """
        p, candidates = data.base.shape[2], solution.candidates
        joined = (data.base, data.columns(candidates), data.errors[:, :, None])
        white = data.noise_model.whitened(np.concatenate(joined, axis=2), solution.noise)
        flat = white.reshape(3 * len(data), -1)
        H = flat.T @ flat
        pull = H[:-1, -1]
        H = H[:-1, :-1].copy()
        H[:p, :p] += data.base_precision
        H[p:, p:] += solution.prior_precision()
        gram = np.zeros((len(pull) + 1, len(pull) + 1))
        for block, context in data.context.blocks():
            mine = rows[block]
            columns = [
                candidate.columns(context).displacement(context) for candidate in candidates
            ]
            seen = (data.full_base[block], *columns, data.full_errors[block][:, :, None])
            flat = np.concatenate(seen, axis=2)[mine].reshape(-1, len(gram))
            gram += flat.T @ flat
        places = {
            candidate: p + np.arange(where.start, where.stop)
            for candidate, where in zip(candidates, solution.slices(), strict=True)
        }
        where = [np.concatenate([places[candidate] for candidate in group]) for group in groups]
        return cls(H, pull, gram, np.arange(p), where)

    def left(self, causes: set[int]) -> float:
        """Return the sum of squared errors in the rows to judge with only some causes, m².

        ``causes``: their indices; candidates that belong to no cause are left out, too.
        """
        chosen = np.concatenate((self.base, *(self.where[index] for index in sorted(causes))))
        H, pull = self.H[np.ix_(chosen, chosen)], self.pull[chosen]
        # In units of each parameter's own: those of rad and of m/s differ by ten decades.
        unit = np.diag(H) ** -0.5
        scaled = H * np.outer(unit, unit) + ROUNDING * np.eye(len(H))
        step = unit * cho_solve(cho_factor(scaled), unit * pull)
        fit = np.append(-step, 1.0)
        chosen = np.append(chosen, len(self.gram) - 1)
        return float(fit @ self.gram[np.ix_(chosen, chosen)] @ fit)
