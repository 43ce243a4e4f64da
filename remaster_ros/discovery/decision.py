"""Decision between two causes that could be mistaken for each other, by further measurements.

Both are fitted beside everything else that was found, one in the place of the other. The
difference of their log evidence are the odds; with both as likely beforehand, they are also stated
as the standard deviations that a normal error has to have for it to be as rare (one-sided).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from msgspec import Struct
from scipy.special import ndtri_exp

from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS, effects_of
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.walk import NEEDED
from remaster_ros.discovery.words import called
from remaster_ros.linear_algebra import one_thread

Answer = Literal['cause', 'look_alike', 'open', 'neither']


class Named(Struct, frozen=True):
    """Name and joints (1-based) of a cause."""

    name: str
    joints: tuple[int, ...]

    def __str__(self) -> str:
        """Return the cause in a few words."""
        return called(self.name, self.joints)


class Decision(Struct, frozen=True):
    """Decision between a cause and its look-alike, as discovery.json has it."""

    # As they were before
    cause: Named
    look_alike: Named
    # ``cause`` or ``look_alike``; ``open`` where odds of twenty to one are not reached;
    # ``neither`` where the search names none of the two
    answer: Answer
    # Of the cause less that of its look-alike; None if they cannot be compared
    log_evidence: float | None
    sigma: float  # How sure the answer is, in standard deviations
    sentence: str  # The same in one line

    @classmethod
    def of(
        cls, cause: Named, look_alike: Named, answer: Answer, log_evidence: float | None = None
    ) -> Decision:
        """Return the decision on a cause and its look-alike, with significance and sentence.

        ``answer``: the outcome; ``log_evidence``: of the cause less that of its look-alike. If
        None, the significance is 0 and the sentence says that the search names neither.
        """
        if log_evidence is None:
            words = f'the search now names neither {cause} nor {look_alike}'
            return cls(cause, look_alike, answer, None, 0.0, words)
        sigma = sigma_of(log_evidence)
        first, second = (cause, look_alike)[:: -1 if log_evidence < 0.0 else 1]
        words = f'decided: {first}, not {second}; {sigma:.1f} sigma'
        if answer == 'open':
            words = f'still open: {first} or {second}; {sigma:.1f} sigma for the first'
        return cls(cause, look_alike, answer, log_evidence, sigma, words)


def sigma_of(log_odds: float) -> float:
    """Return the one-sided Gaussian significance of odds, in standard deviations, 0 or more.

    ``log_odds``: natural logarithm; its sign does not matter.
    """
    return max(0.0, float(-ndtri_exp(-np.logaddexp(0.0, abs(log_odds)))))


@one_thread
def decisions(found: Discovery, pairs: Sequence[tuple[Named, Named]]) -> tuple[Decision, ...]:
    """Decide between the two causes of each pair, by all that was measured.

    Parameters
    ----------
    found
        Discovery in all that was measured.
    pairs
        A cause and its look-alike of an earlier search; pairs given twice count once.
    """
    return tuple(_decision(found, *pair) for pair in dict.fromkeys(pairs))


def _decision(found: Discovery, cause: Named, look_alike: Named) -> Decision:
    """Decide between a cause and a look-alike by log evidence.

    The answer is 'cause' or 'look_alike' if the odds exceed twenty to one and the search names
    the winner, else 'open'. It is 'neither' if the search names none of the two, or if none can
    be fitted.
    """
    # Named are causes that the search has found now; part of a solution may be located structure.
    named = [Named(effect.name, effect.joints) for effect in found.effects]
    if cause not in named and look_alike not in named:
        return Decision.of(cause, look_alike, 'neither')
    first, second = _evidence(found, cause, look_alike), _evidence(found, look_alike, cause)
    if first is None and second is None:
        return Decision.of(cause, look_alike, 'neither')
    # What cannot be fitted beside the rest explains nothing.
    bare = _without(found, cause, look_alike)
    first, second = (
        bare if evidence is None else max(evidence, bare) for evidence in (first, second)
    )
    difference = first - second
    winner = cause if difference > 0.0 else look_alike
    decided = abs(difference) > NEEDED and winner in named
    answer: Answer = 'open'
    if decided:
        answer = 'cause' if difference > 0.0 else 'look_alike'
    return Decision.of(cause, look_alike, answer, difference)


def _rest(found: Discovery, *causes: Named) -> tuple[Candidate, ...]:
    """Return the candidates of a discovery's model with some causes taken out.

    These are the candidates of all other named causes, and of the background those families of
    random effects that have no member with the name of one of ``causes`` and share no parameter
    with a named cause.
    """
    named = [candidate for group in found.groups for candidate in group]
    kinds = {cause.name for cause in causes}
    have = {name for candidate in named for name in candidate.parameters}
    return (
        *(
            candidate
            for candidate in named
            if not any(_belongs(candidate, target) for target in causes)
        ),
        *(
            family.candidate
            for family in found.background
            if kinds.isdisjoint(member.name for member in family.members)
            and have.isdisjoint(family.parameters)
        ),
    )


def _belongs(candidate: Candidate, cause: Named) -> bool:
    """Return whether a candidate has a cause's name, and all its joints or just one of them."""
    parts = [(joint,) for joint in cause.joints]
    return candidate.name == cause.name and (
        candidate.joints == cause.joints or candidate.joints in parts
    )


def _without(found: Discovery, *causes: Named) -> float:
    """Log evidence of the discovery's model without some causes; -inf if that cannot be fitted."""
    remaining = _rest(found, *causes)
    bare = solve(found.residuals, remaining, found.solution)
    return -np.inf if bare is None else bare.log_evidence


def _evidence(found: Discovery, cause: Named, other: Named) -> float | None:
    """Return the log evidence of the model with ``cause`` and without ``other``.

    The cause has its candidates in the discovery's model if these cover all its joints, else
    the best set of `_variants`. None if no set can be fitted with parameters of a sign that is
    physically possible.
    """
    every, remaining = _candidates(found), _rest(found, cause, other)
    named = [candidate for group in found.groups for candidate in group]
    present = tuple(candidate for candidate in named if _belongs(candidate, cause))
    is_complete = {joint for candidate in present for joint in candidate.joints} == {*cause.joints}
    sets = [present] if present and is_complete else _variants(every, cause)
    best = None
    for candidates in sets:
        fit = solve(found.residuals, (*remaining, *candidates), found.solution)
        if fit is None or fit.unphysical():
            continue
        if best is None or fit.log_evidence > best:
            best = fit.log_evidence
    return best


def _variants(every: Sequence[Candidate], cause: Named) -> list[tuple[Candidate, ...]]:
    """Return the sets of candidates that a cause can be made of.

    ``every``: candidates to choose from. One set for each candidate of exactly the cause's
    joints; if there are none, one set with a candidate for each joint; [] if a joint has none.
    """
    mine = [candidate for candidate in every if candidate.name == cause.name]
    singles: list[tuple[Candidate, ...]] = [
        (candidate,) for candidate in mine if candidate.joints == cause.joints
    ]
    each = [
        [c for c in mine if c.joints == (joint,) and EFFECTS[c.name].in_family(c)][:1]
        for joint in cause.joints
    ]
    if singles or not all(each):
        return singles
    return [tuple(candidate for candidates in each for candidate in candidates)]


def _candidates(found: Discovery) -> list[Candidate]:
    """Return the candidates of all effects that the session can show.

    Effects with very many candidates (`costly`) and marker offsets (`moves_the_fit`) are left out.
    """
    context = found.residuals.context
    return [
        candidate
        for effect in effects_of(context).values()
        if not effect.needs(context) and not effect.moves_the_fit and not effect.costly
        for candidate in effect.candidates(context)
    ]
