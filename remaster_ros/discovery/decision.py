"""What further measurements have decided between two causes that could be mistaken for each other.

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
    """A cause: name and joints (1-based)."""

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
        """Decision by the difference of the log evidence, in numbers and words."""
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
    """Return the standard deviations whose one-sided tail has the probability of these odds."""
    return max(0.0, float(-ndtri_exp(-np.logaddexp(0.0, abs(log_odds)))))


@one_thread
def decisions(found: Discovery, pairs: Sequence[tuple[Named, Named]]) -> tuple[Decision, ...]:
    """Decide between the two causes of each pair, by all that was measured.

    Parameters
    ----------
    found
        The search of all that was measured.
    pairs
        A cause and its look-alike of an earlier search.
    """
    return tuple(_decision(found, *pair) for pair in dict.fromkeys(pairs))


def _decision(found: Discovery, cause: Named, look_alike: Named) -> Decision:
    """Decision between a cause and a look-alike by log evidence; 'neither' if both are gone."""
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
    """Return the other causes, and the background without the kinds of these."""
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
    """Whether a candidate is of a cause: of its name, and of all its joints or one of them."""
    parts = [(joint,) for joint in cause.joints]
    return candidate.name == cause.name and (
        candidate.joints == cause.joints or candidate.joints in parts
    )


def _without(found: Discovery, *causes: Named) -> float:
    """Log evidence of the discovery's model without some causes; -inf if it has no solution."""
    remaining = _rest(found, *causes)
    bare = solve(found.residuals, remaining, found.solution)
    return -np.inf if bare is None else bare.log_evidence


def _evidence(found: Discovery, cause: Named, other: Named) -> float | None:
    """Return the log evidence with a cause in place of another; None if it cannot be fitted."""
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
    """Sets of candidates that a cause can be: each candidate of its joints, alone.

    If there are none, one candidate for each of the joints together; [] if a joint has none.
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
    """Candidates of all effects that the session can show, except costly ones.

    Effects that move the fit itself are left out, too.
    """
    context = found.residuals.context
    return [
        candidate
        for effect in effects_of(context).values()
        if not effect.needs(context) and not effect.moves_the_fit and not effect.costly
        for candidate in effect.candidates(context)
    ]
