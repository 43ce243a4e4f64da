"""Was the hidden effect found: its name, its joint, its size?

The judge is strict. Right is who names exactly what was hidden, no less and no more. One thing
alone is forgiven: naming a look-alike that this session's data cannot tell from the truth, and
saying so. "Cannot tell" is decided by the oracle, which knows the noise: the best test between
the two, with everything else fitted, must have a noncentrality below `INDISTINGUISHABLE`, so that
it would not be sure at two standard deviations. "Saying so" means that ``confusable_with`` has
the truth.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hidden_oracle import Oracle
from hidden_world import HiddenTruth, HiddenWorld
from scipy.interpolate import BSpline

from remaster_ros.simulation.expected_findings import Cause, causes, named_cause, true_parameters
from remaster_ros.simulation.hidden_effects import HiddenEffect
from remaster_ros.types import FloatArray

INDISTINGUISHABLE = 4.0
SIZE_STD = 3.0
# A free curve has no single size: it must agree with the true one to this share of its RMS.
CURVE_SHARE = 0.4
# A component of which less than this share is left cannot be asked for.
UNSEEN_SHARE = 0.02


@dataclass
class Judgement:
    """What came of a session.

    Attributes
    ----------
    hidden, named
        Causes.
    named_right
        All of the hidden ones and nothing else were named, or look-alikes as said above.
    forgiven
        Look-alikes were involved.
    first_right
        The first cause named is one that was hidden.
    size_right
        Every parameter lies within 3 std of the truth, where the names are right and not forgiven;
        None where they are not.
    deviations
        (value - truth) / std of every parameter compared.
    """

    hidden: list[Cause]
    named: list[Cause]
    named_right: bool
    forgiven: bool
    first_right: bool
    size_right: bool | None
    deviations: dict[str, float] = field(default_factory=dict)


def judge(world: HiddenWorld, truth: HiddenTruth, discovery: Any) -> Judgement:
    """Compare what was found in a session with what was hidden in it."""
    hidden = {cause: effect for effect in truth.effects for cause in causes(effect)}
    found: dict[Cause, list[Any]] = {}
    for effect in discovery.effects:
        for cause in _claimed(effect):
            found.setdefault(cause, []).append(effect)
    missing = {cause: effect for cause, effect in hidden.items() if cause not in found}
    extra = {cause: claims for cause, claims in found.items() if cause not in hidden}
    forgiven = bool(missing) and _forgiven(Oracle(world, truth), missing, extra)
    named_right = (not missing and not extra) or forgiven
    deviations: dict[str, float] = {}
    size_right = None
    if named_right and not forgiven and hidden:
        deviations = _deviations(world, truth.effects, discovery.effects)
        limits = {name: CURVE_SHARE if name == 'curve' else SIZE_STD for name in deviations}
        size_right = all(abs(z) <= limits[name] for name, z in deviations.items())
    first = next(iter(found), None)
    return Judgement(
        list(hidden), list(found), named_right, forgiven, first in hidden, size_right, deviations
    )


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


# What the estimate calls a parameter -> the same thing in the terms of the hidden world.
_PATTERNS = {
    r'compliance_(?P<j>\d+)': 'joint_compliance',
    r'sin(?P<order>\d+)_(?P<j>\d+)': 'encoder_eccentricity',
    r'cos(?P<order>\d+)_(?P<j>\d+)': 'encoder_eccentricity',
    r'scale_(?P<j>\d+)': 'encoder_scale',
    r'half_backlash_(?P<j>\d+)': 'backlash',
    r'settling_(?P<j>\d+)': 'settling',
    r'coupling_(?P<j>\d+)_by_(?P<by>\d+)': 'joint_coupling',
    r'length_(?P<j>\d+)': 'link_length',
    r'offset_(?P<axis>[xyz])_(?P<j>\d+)': 'link_length',
    r'tilt_(?P<axis>[xyz])_(?P<j>\d+)': 'joint_axis_tilt',
    r'growth': 'thermal_growth',
    r'base_compliance': 'base_compliance',
    r'drift_(?P<axis>[xyz])_(?P<sensor>\w+)': 'registration_drift',
    r'scale_z_(?P<sensor>[a-z]\w*)': 'sensor_scale',
    r'scale_(?P<sensor>[a-z]\w+)': 'sensor_scale',
    r'radial_(?P<sensor>[a-z]+)': 'sensor_distortion',
}


def part_of(name: str) -> HiddenEffect | None:
    """Return the effect of size 1 whose parameter discovery calls so; None where none is."""
    for pattern, kind in _PATTERNS.items():
        match = re.fullmatch(pattern, name)
        if match is None:
            continue
        detail: dict[str, Any] = match.groupdict()
        values = np.ones(1)
        joints = (int(detail['j']),) if 'j' in detail else ()
        if kind == 'encoder_eccentricity':
            detail = {'orders': (int(detail['order']),)}
            values = np.array([1.0, 0.0] if name.startswith('sin') else [0.0, 1.0])
        elif kind == 'joint_coupling':
            detail = {'by': int(detail['by']), 'form': 'linear'}
        elif kind in ('joint_axis_tilt', 'registration_drift'):
            values = np.eye(3)['xyz'.index(detail['axis'])]
        elif kind == 'sensor_scale':
            detail['form'] = 'depth' if name.startswith('scale_z_') else 'all'
        elif kind == 'link_length' and 'axis' not in detail:
            detail = {'axis': 'along'}
        return HiddenEffect(kind, joints, values, detail)
    return None


def _deviations(
    world: HiddenWorld, effects: Sequence[HiddenEffect], found: Sequence[Any]
) -> dict[str, float]:
    """Compare every true value with its estimate; one that was not estimated counts as zero.

    For want of its own, a value that was not estimated is given the std of its neighbours in the
    same effect.
    """
    deviations = {}
    for effect in effects:
        claims = [claim for claim in found if set(_claimed(claim)) & set(causes(effect))]
        estimates = {
            parameter.name: (parameter.value, parameter.std)
            for claim in claims
            for parameter in claim.parameters
        }
        if effect.kind == 'joint_error_curve':
            deviations['curve'] = _curve_deviation(world, effect, estimates)
            continue
        if effect.kind == 'marker_offset':
            deviations |= _marker_deviations(world, effect, estimates)
            continue
        spread = max(std for _, std in estimates.values())
        for name, true in true_parameters(effect).items():
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

    Where the marker is round that axis trades with the last zero-offset: nobody can tell.
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


def _curve_deviation(
    world: HiddenWorld, effect: HiddenEffect, estimates: dict[str, tuple[float, float]]
) -> float:
    """RMS of estimated minus true curve over the configurations, as a share of the true one's.

    Offset and slope of both are left out: the one is a zero-offset, the other hardly seen.
    """
    peaks = np.deg2rad([float(re.findall(r'_at_([-+.\d]+)deg', n)[0]) for n in estimates])
    weights = np.array([value for value, _ in estimates.values()])
    step = np.mean(np.diff(peaks))
    knots = peaks[0] + step * np.arange(-2, len(peaks) + 2)
    q = world.visits.q[:, effect.joints[0] - 1]
    inside = np.clip(q, knots[3], knots[-4])
    estimated = BSpline(knots, weights, 3)(inside)
    waves = zip(effect.detail['orders'], effect.detail['amplitudes'], effect.detail['phases'])
    true = effect.values[0] * sum(a * np.cos(order * q + phase) for order, a, phase in waves)
    return float(np.std(_detrended(q, estimated - true)) / np.std(_detrended(q, true)))


def _detrended(q: FloatArray, values: FloatArray) -> FloatArray:
    return values - np.polyval(np.polyfit(q, values, 1), q)
