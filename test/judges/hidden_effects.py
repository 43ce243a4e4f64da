# SPDX-License-Identifier: Apache-2.0
"""Was the hidden effect found: its name, its joint, its size?

The judge is strict. A result is right if it names exactly what was hidden, no less and no more.
One exception is allowed: a look-alike that this session's data cannot distinguish from the truth,
if its ``confusable_with`` lists the truth. Whether they can be distinguished is decided by the
oracle, which has the true noise: the best test between the two, with everything else fitted, must
have a noncentrality of at least `INDISTINGUISHABLE`; below, it is not sure at two standard
deviations.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from judges.hidden_oracle import Oracle
from worlds.hidden_world import HiddenTruth, HiddenWorld

from remaster_ros.simulation.expected_findings import Cause, answers, causes, named_cause
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.hidden_effects import KINDS, NAMED, true_parameters
from remaster_ros.types import FloatArray

INDISTINGUISHABLE = 4.0
SIZE_STD = 3.0
# A free curve has no single size: it must agree with the true one to this share of its RMS.
CURVE_SHARE = 0.4
# A component of which less than this share is left cannot be asked for.
UNSEEN_SHARE = 0.02
# What an entry of ``unexplained`` has to mention, one of these, where the readings themselves err.
FAULT_PLACES = {
    'pairing': ('pairing', 'paired', 'tail', 'outlier', 'gross'),
    'memory': ('serial',),
    'tails': ('tail', 'outlier', 'gross'),
}

Outcome = Literal['right', 'unexplained', 'elsewhere', 'partly', 'none', 'wrong']


@dataclass
class Judgement:
    """What came of a session.

    Attributes
    ----------
    hidden, named
        Causes.
    named_right
        All of the hidden ones and nothing else were named, or look-alikes as described above.
    forgiven
        Look-alikes were involved.
    first_right
        The first cause named is one that was hidden.
    size_right
        Every parameter lies within 3 std of the truth, where the names are right and not forgiven;
        None where they are not.
    outcome
        ``right``; ``unexplained`` at the right place, no wrong name beside; ``elsewhere``:
        unexplained at another place; ``partly``: some named, all of them right; ``none``;
        ``wrong``: a name of what is not there.
    deviations
        (value - truth) / std of every parameter compared.
    """

    hidden: list[Cause]
    named: list[Cause]
    named_right: bool
    forgiven: bool
    first_right: bool
    size_right: bool | None
    outcome: Outcome
    deviations: dict[str, float] = field(default_factory=dict)


def judge(world: HiddenWorld, truth: HiddenTruth, discovery: Any) -> Judgement:
    """Compare what was found in a session with what was hidden in it."""
    hidden = {cause: effect for effect in truth.effects for cause in causes(effect)}
    found: dict[Cause, list[Any]] = {}
    for effect in discovery.effects:
        for cause in _claimed(effect):
            found.setdefault(cause, []).append(effect)
    missing = {
        cause: effect
        for cause, effect in hidden.items()
        if not any(answers(claim, cause, effect) for claim in found)
    }
    extra = {
        claim: claims
        for claim, claims in found.items()
        if not any(answers(claim, cause, effect) for cause, effect in hidden.items())
    }
    forgiven = bool(missing) and _forgiven(Oracle(world, truth), missing, extra)
    named_right = (not missing and not extra) or forgiven
    deviations: dict[str, float] = {}
    size_right = None
    if named_right and not forgiven and hidden:
        deviations = _deviations(world, truth.effects, discovery)
        limits = {name: CURVE_SHARE if name == 'curve' else SIZE_STD for name in deviations}
        size_right = all(abs(z) <= limits[name] for name, z in deviations.items())
    first = next(iter(found), None)
    return Judgement(
        list(hidden),
        list(found),
        named_right,
        forgiven,
        bool(found) and first not in extra,
        size_right,
        _outcome(truth, discovery, missing, extra, named_right),
        deviations,
    )


def _outcome(
    truth: HiddenTruth,
    discovery: Any,
    missing: dict[Cause, HiddenEffect],
    extra: dict[Cause, list[Any]],
    named_right: bool,
) -> Outcome:
    """Sum up in one word; a wrong name counts before all else."""
    if named_right and truth.effects:
        return 'right'
    if extra:
        return 'wrong'
    words = [
        f'{entry.where} {entry.driver}' + ' serial' * ('serial correlation' in entry.next)
        for entry in discovery.unexplained
    ]
    wanted = [(KINDS[effect.kind].driver,) for effect in missing.values()]
    wanted += [places for fault, places in FAULT_PLACES.items() if fault in truth.faults]
    if wanted and all(
        any(place in text for place in places for text in words) for places in wanted
    ):
        return 'unexplained'
    if discovery.effects:
        return 'partly'
    return 'elsewhere' if discovery.unexplained else 'none'


def _claimed(effect: Any) -> list[Cause]:
    names = [{'name': parameter.name} for parameter in effect.parameters]
    plain = {key: getattr(effect, key) for key in ('name', 'joints', 'place', 'driver')}
    return named_cause({**plain, 'parameters': names})


def _forgiven(
    oracle: Oracle, missing: dict[Cause, HiddenEffect], extra: dict[Cause, list[Any]]
) -> bool:
    """Whether the causes named in place of missing ones are look-alikes, and listed as such."""
    if len(missing) != len(extra):
        return False
    rivals = [rival for claims in extra.values() for claim in claims for rival in _parts(claim)]
    listed = {
        (other.name, tuple(other.joints))
        for claims in extra.values()
        for claim in claims
        for other in claim.confusable_with
    }
    if not rivals or any((name, joints) not in listed for name, joints, _ in missing):
        return False
    return all(
        oracle.information(effect, *rivals) < INDISTINGUISHABLE for effect in missing.values()
    )


def _parts(claim: Any) -> list[HiddenEffect]:
    """Return the named effect as this world would hide it, each of its parameters alone."""
    return [
        part.scaled(parameter.value)
        for parameter in claim.parameters
        if (part := part_of(parameter.name)) is not None
    ]


# What stands for a word in the name of a parameter; no sensor of these worlds has an underscore.
_WORDS = {'j': r'\d+', 'by': r'\d+', 'order': r'\d+', 'sensor': '[a-z][a-z0-9]*'}


def part_of(name: str) -> HiddenEffect | None:
    """Return the effect of size 1 whose parameter discovery calls so; None where none is."""
    for kind, hidden in NAMED.items():
        for part in hidden.parts:
            pattern = part.name.format(**{w: f'(?P<{w}>{form})' for w, form in _WORDS.items()})
            if (match := re.fullmatch(pattern, name)) is None:
                continue
            words = match.groupdict()
            detail: dict[str, Any] = dict(part.detail)
            if 'by' in words:
                detail['by'] = int(words['by'])
            if 'order' in words:
                detail['orders'] = (int(words['order']),)
            if 'sensor' in words:
                detail['sensor'] = words['sensor']
            joints = (int(words['j']),) if 'j' in words else ()
            return HiddenEffect(kind, joints, np.array(part.values), detail)
    return None


def _deviations(
    world: HiddenWorld, effects: Sequence[HiddenEffect], discovery: Any
) -> dict[str, float]:
    """Compare every true value with its estimate; one that was not estimated counts as zero.

    For want of its own, a value that was not estimated is given the std of its neighbours in the
    same effect.
    """
    deviations = {}
    for effect in effects:
        claims = [
            claim
            for claim in discovery.effects
            if any(answers(c, cause, effect) for c in _claimed(claim) for cause in causes(effect))
        ]
        estimates = {
            parameter.name: (parameter.value, parameter.std)
            for claim in claims
            for parameter in claim.parameters
        }
        if 'moment' in estimates and 'moment_s' in effect.detail:
            value, std = estimates.pop('moment')
            # A moment is known to the time between two configurations at best.
            std = max(std, float(np.median(np.diff(world.visited.time_s))))
            deviations['moment'] = (value - effect.detail['moment_s']) / std
        if effect.kind == 'joint_error_curve':
            deviations['curve'] = _curve_deviation(effect, discovery)
            continue
        if effect.kind == 'marker_offset':
            deviations |= _marker_deviations(world, effect, estimates)
            continue
        parameters = true_parameters(effect)
        if not parameters.keys() & estimates.keys():
            # An answer of another name, whose parameters are others.
            continue
        spread = max(std for _, std in estimates.values())
        for name, true in parameters.items():
            if name not in estimates and _unseen(world, effect, name):
                continue
            value, std = estimates.get(name, (0.0, spread))
            deviations[name] = (value - true) / std
    return deviations


def _unseen(world: HiddenWorld, effect: HiddenEffect, name: str) -> bool:
    """Whether this component of the effect is taken up by offsets, registration or marker."""
    part = part_of(name)
    if part is None:
        return False
    size = np.linalg.norm(effect.values) / np.linalg.norm(part.values)
    return world.size_m(part.scaled(size)) < UNSEEN_SHARE * world.size_m(effect)


def _marker_deviations(
    world: HiddenWorld, effect: HiddenEffect, estimates: dict[str, tuple[float, float]]
) -> dict[str, float]:
    """Compare height and distance from the last joint's axis, the z axis of the tool here.

    Where the marker is round that axis trades with the last zero-offset, and cannot be determined.
    """
    deviations = {}
    for name, nominal in world.nominal_markers.items():
        if f'x_{name}' not in estimates:
            continue
        true = world.markers[name] + effect.values
        value, std = np.transpose([estimates[f'{axis}_{name}'] for axis in 'xyz'])
        found = nominal + value
        radius = np.hypot(found[0], found[1])
        radial_std = np.hypot(found[0] * std[0], found[1] * std[1]) / radius
        deviations[f'radius_{name}'] = float((radius - np.hypot(true[0], true[1])) / radial_std)
        deviations[f'z_{name}'] = float((found[2] - true[2]) / std[2])
    return deviations


def _curve_deviation(effect: HiddenEffect, discovery: Any) -> float:
    """RMS of estimated minus true curve over all rows, as a share of the true one's.

    Offset and slope of both are left out: the one is a zero-offset, the other hardly seen.
    """
    context, solution = discovery.residuals.context, discovery.solution
    q = context.measurements.q[:, effect.joints[0] - 1]
    estimated = np.zeros(len(q))
    for candidate, where in zip(solution.candidates, solution.slices(), strict=True):
        if (candidate.name, candidate.joints) == (effect.kind, effect.joints):
            estimated += candidate.columns(context).values @ discovery.fit.theta[where]
    waves = zip(effect.detail['orders'], effect.detail['amplitudes'], effect.detail['phases'])
    true = effect.values[0] * sum(a * np.cos(order * q + phase) for order, a, phase in waves)
    return float(np.std(_detrended(q, estimated - true)) / np.std(_detrended(q, true)))


def _detrended(q: FloatArray, values: FloatArray) -> FloatArray:
    return values - np.polyval(np.polyfit(q, values, 1), q)
