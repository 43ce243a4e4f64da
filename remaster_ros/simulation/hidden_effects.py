# SPDX-License-Identifier: Apache-2.0
"""Effects that a hidden world can have, each with its own equation.

No code is shared with the estimation (`discovery.effects`). An effect is linear in its values:
`HiddenEffect.values` times the contribution of its rule to a `Deviation`. A rule reads the
`Circumstances` of every configuration. `NAMED` are the effects with a name, `UNNAMED` those
without, `OF_SLIDES` those of joints that slide. Compliance and thermal growth are drawn with the
sign of physics.

A joint that slides has metres for radians and, for a torque, the force along it; a radian of the
drawn values counts as `SLIDE_M` there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from remaster_ros.simulation.hidden_effect import (
    ARC_MINUTE,
    Circumstances,
    Deviation,
    Draw,
    DrawContext,
    HiddenEffect,
    HiddenKind,
    Part,
    Rule,
    at_some_time,
    no_joint,
    of_sensor,
    one_value,
    two_joints,
)
from remaster_ros.types import FloatArray

# Parameters that several kinds have.
WAVES = (Part('sin{order}_{j}', (1.0, 0.0)), Part('cos{order}_{j}', (0.0, 1.0)))
NAMED: dict[str, HiddenKind] = {}
# Effects without a name: discovery should find place and driver, or report remaining structure.
UNNAMED: dict[str, HiddenKind] = {}
# Effects that only an arm with a joint that slides can have.
OF_SLIDES: dict[str, HiddenKind] = {}


def in_own_units(effect: HiddenEffect, per_radian: FloatArray) -> HiddenEffect | None:
    """Effect drawn in rad, converted to the units of its joints: m for those that slide.

    None if such a joint cannot have the effect. ``per_radian``: equivalent of a radian in each
    joint's unit, (k,). Effects elsewhere than in a joint's angle are returned as they are.
    """
    kind = KINDS[effect.kind]
    by = effect.detail.get('by')
    scale = per_radian[np.array(effect.joints, dtype=int) - 1]
    driver = scale if by is None else per_radian[by - 1]
    if kind.place != 'joint_angle' or (np.all(scale == 1.0) and np.all(driver == 1.0)):
        return effect
    wave = effect.detail.get('form') == 'sin/cos'
    if kind.power is None or (wave and driver != 1.0):
        return None
    power = 0 if wave else kind.power
    return replace(effect, values=effect.values * scale * driver ** -float(power))


def _draw_compliance(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a compliance of 0.2 to 0.4 mrad/(N m) for one or two joints.

    Of those whose gravity torque varies by over 0.5 N m over the visits; with none the effect
    has no joints.
    """
    loaded = 1 + np.flatnonzero(np.ptp(context.circumstances.torque, axis=0) > 0.5)
    count = min(int(context.rng.choice((1, 1, 2))), len(loaded))
    joints = np.sort(context.rng.choice(loaded, count, replace=False))
    values = 4e-4 * context.rng.uniform(0.5, 1.0, count)
    return HiddenEffect(kind, tuple(int(j) for j in joints), values)


def _draw_eccentricity(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw an eccentric encoder of any joint: waves of order 1, 2 or both.

    Their coefficients are 20 arc minutes times a random unit vector.
    """
    orders = ((1,), (2,), (1, 2))[context.rng.integers(3)]
    values = 20 * ARC_MINUTE * context.direction(2 * len(orders))
    return HiddenEffect(kind, context.joint(), values, {'orders': orders})


def _draw_gear(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a gear error of any joint: a wave of one even order from 100 to 320 per turn.

    Its amplitude is 10 arc minutes.
    """
    # Twice the ratio of a strain wave gear of 50 to 160.
    order = int(2 * context.rng.integers(50, 161))
    values = 10 * ARC_MINUTE * context.direction(2)
    return HiddenEffect(kind, context.joint(), values, {'orders': (order,)})


def _draw_curve(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a smooth error of any joint, RMS 8 arc minutes: orders 4 to 24, random phases."""
    orders = np.arange(4, 25)
    # Weights of a Gaussian bell: waves shorter than its width hardly occur.
    weight = np.exp(-0.5 * (orders * np.deg2rad(context.rng.uniform(4.0, 10.0))) ** 2)
    amplitudes = weight * np.abs(context.rng.standard_normal(len(orders)))
    amplitudes /= np.sqrt(0.5 * np.sum(amplitudes**2))
    phases = context.rng.uniform(0, 2 * np.pi, len(orders))
    detail = {'orders': orders, 'amplitudes': amplitudes, 'phases': phases}
    return HiddenEffect(kind, context.joint(), np.array([8 * ARC_MINUTE]), detail)


def _draw_link(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw an error of 5 mm, with a random sign, of the link behind one of joints 1 to k - 1.

    Along the link, or along x, y or z of the frame after the joint: ``axis`` of the detail is
    'along', 'x', 'y' or 'z'. ``kind``: name of the effect. Raises ValueError for an arm of one
    joint.
    """
    joint = int(context.rng.integers(1, context.joints))
    segment = context.circumstances.segments[joint]
    length = np.linalg.norm(segment)
    axis = str(context.rng.choice(('x', 'y', 'z')))
    # Offsets of a link are as likely as a wrong length, where it has one.
    if length > 0.02 and (
        context.rng.random() < 0.5 or abs(segment['xyz'.index(axis)]) > 0.1 * length
    ):
        axis = 'along'
    return HiddenEffect(kind, (joint,), np.array([5e-3 * context.sign()]), {'axis': axis})


def _draw_tilt(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a tilt by 0.01 rad of the axis of any joint but the first, about a random normal."""
    (joint,) = context.joint(2)
    across = np.cross(context.circumstances.axes[joint - 1], context.rng.standard_normal(3))
    return HiddenEffect(kind, (joint,), 0.01 * across / np.linalg.norm(across))


def _draw_marker(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw an offset of the markers by 10 mm in a random direction."""
    return HiddenEffect(kind, (), 10e-3 * context.direction(3))


def _draw_bump(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a shift of a random sensor by 3 mm and a turn by 1.5 mrad, in random directions."""
    # A turn about the sensor moves a marker two metres away about as far as the shift does.
    values = np.concatenate((3e-3 * context.direction(3), 1.5e-3 * context.direction(3)))
    return HiddenEffect(kind, (), values, {'sensor': str(context.rng.choice(context.sensors))})


def _draw_marker_slip(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a shift of a random marker by 3 mm in a random direction."""
    marker = str(context.rng.choice(context.markers))
    return HiddenEffect(kind, (), 3e-3 * context.direction(3), {'marker': marker})


def _about_mean_distance(largest: float) -> Draw:
    """Return a function that draws an effect of a random sensor with one value, ±`largest`.

    The detail has ``sensor``, and ``distance_m``, the mean distance of the sensor's markers.
    """

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        sensor = str(context.rng.choice(context.sensors))
        detail = {'sensor': sensor, 'distance_m': context.distance_m[sensor]}
        return HiddenEffect(kind, (), np.array([largest * context.sign()]), detail)

    return draw


def _along_axes(name: str) -> tuple[Part, ...]:
    """Three parameters, along x, y and z, of an effect with three values.

    `name` has ``{axis}`` for the letter.
    """
    units = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return tuple(Part(name.format(axis=axis), unit) for axis, unit in zip('xyz', units))


def _kind(
    table: dict[str, HiddenKind],
    place: str,
    driver: str,
    draw: Draw,
    *parts: Part,
    answers: tuple[str, ...] = (),
    name: str = '',
    power: int | None = 0,
) -> Callable[[Rule], Rule]:
    """Decorator that enters a new `HiddenKind` with the decorated rule into a table.

    A rule is a function that adds an effect to a deviation; it is returned unchanged. The key
    is `name`, or the rule's own name if that is ''. Other arguments: as the fields of
    `HiddenKind`; `answers` are its ``accepted``.
    """

    def take(rule: Rule) -> Rule:
        table[name or rule.__name__] = HiddenKind(place, driver, rule, draw, parts, power, answers)
        return rule

    return take


_named, _unnamed = partial(_kind, NAMED), partial(_kind, UNNAMED)
_of_slides = partial(_kind, OF_SLIDES)


def _after(e: HiddenEffect, c: Circumstances) -> FloatArray:
    """1.0 at configurations later than the effect's ``moment_s``, s, else 0.0, (n,)."""
    return (c.time_s > e.detail['moment_s']).astype(float)


# A torque is a force at a lever: its unit is in it once more.
@_named('joint_angle', 'gravity_torque', _draw_compliance, Part('compliance_{j}'), power=-1)
def joint_compliance(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = values_j τ_j for each of the joints, in rad/(N m), added to ``d.angle``.

    τ_j: gravity's torque about joint j, N m.
    """
    for value, j in zip(e.values, e.joints, strict=True):
        d.angle[:, j - 1] += value * c.torque[:, j - 1]


@_named('joint_angle', 'joint_angle', _draw_eccentricity, *WAVES, power=None)
def encoder_eccentricity(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = a sin(o q) + b cos(o q), rad, summed over orders o, added to ``d.angle`` of the joint.

    ``orders`` in the effect's detail; its values: a and b of each order, in turn.
    """
    q = c.q[:, e.joints[0] - 1]
    for order, (a, b) in zip(e.detail['orders'], e.values.reshape(-1, 2), strict=True):
        d.angle[:, e.joints[0] - 1] += a * np.sin(order * q) + b * np.cos(order * q)


@_named('joint_angle', 'joint_angle', one_value(5e-3), Part('scale_{j}'), power=1)
def encoder_scale(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = s q, added to ``d.angle`` of the joint; s, without unit, is the only value."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.q[:, e.joints[0] - 1]


_named('joint_angle', 'joint_angle', _draw_gear, *WAVES, name='gear_periodic', power=None)(
    encoder_eccentricity
)


@_named('joint_angle', 'joint_angle', _draw_curve)
def joint_error_curve(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = v Σ a cos(o q + phase), added to ``d.angle`` of the joint; v, rad: the only value.

    ``orders`` o, ``amplitudes`` a and ``phases`` are arrays in the effect's detail. Drawn
    orders are 4 to 24: an eccentricity has the orders 1 and 2.
    """
    q = (c.q / c.per_radian)[:, e.joints[0] - 1]
    waves = sum(
        a * np.cos(order * q + phase)
        for order, a, phase in zip(
            e.detail['orders'], e.detail['amplitudes'], e.detail['phases'], strict=True
        )
    )
    d.angle[:, e.joints[0] - 1] += e.values[0] * waves


@_named(
    'joint_angle',
    'approach',
    one_value(15 * ARC_MINUTE, positive=True),
    Part('half_backlash_{j}', (2.0,)),
)
def backlash(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = ½ B (-1, 0 or 1, direction of the last move), added to ``d.angle`` of the joint.

    B, rad, is the only value; the direction is that of the joint's last move above
    `SLACK_RAD`.
    """
    d.angle[:, e.joints[0] - 1] += 0.5 * e.values[0] * c.approach[:, e.joints[0] - 1]


@_named('joint_angle', 'last_move', one_value(3e-3, positive=True), Part('settling_{j}'), power=1)
def settling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = −s (q − q before the move), added to ``d.angle``: the arm has not quite arrived.

    s, the share of the move that is missing, is the only value.
    """
    d.angle[:, e.joints[0] - 1] -= e.values[0] * c.move[:, e.joints[0] - 1]


@_named(
    'joint_angle',
    'other_joint',
    two_joints(5e-3, ('linear', 'sin/cos')),
    Part('coupling_{j}_by_{by}', detail={'form': 'linear'}),
    Part('sin_{j}_by_{by}', (1.0, 0.0), {'form': 'sin/cos'}),
    Part('cos_{j}_by_{by}', (0.0, 1.0), {'form': 'sin/cos'}),
    power=1,
)
def joint_coupling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s q_i, or a sin q_i + b cos q_i, added to ``d.angle`` of joint j.

    Joint i is ``by`` in the detail, whose ``form`` is 'linear' or 'sin/cos'; values: s, or a and
    b.
    """
    other = c.q[:, e.detail['by'] - 1]
    if e.detail['form'] == 'linear':
        d.angle[:, e.joints[0] - 1] += e.values[0] * other
    else:
        d.angle[:, e.joints[0] - 1] += e.values[0] * np.sin(other) + e.values[1] * np.cos(other)


@_named(
    'link_translation',
    'constant',
    _draw_link,
    Part('length_{j}', detail={'axis': 'along'}),
    *(Part(f'offset_{axis}_{{j}}', detail={'axis': axis}) for axis in 'xyz'),
)
def link_length(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Shift of all behind joint j along the link after it, or along one of its axes, m.

    By the only value, added to ``d.shift``. The detail's ``axis`` is 'along' (the link; also
    the default), 'x', 'y' or 'z' of the frame after joint j.
    """
    j = e.joints[0]
    axis = e.detail.get('axis', 'along')
    along = c.segments[j] if axis == 'along' else np.eye(3)['xyz'.index(axis)]
    d.shift[:, j] += e.values[0] * along / np.linalg.norm(along)


@_named('link_rotation', 'constant', _draw_tilt, *_along_axes('tilt_{axis}_{{j}}'))
def joint_axis_tilt(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Constant rotation of joint j's frame about its x, y, z before its own rotation, rad.

    The three values are added to ``d.tilt``.
    """
    d.tilt[:, e.joints[0] - 1] += e.values


@_named('marker', 'constant', _draw_marker)
def marker_offset(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Constant shift of all markers along x, y, z of the tool, m, added to ``d.marker``."""
    d.marker += e.values


@_named('link_translation', 'temperature', no_joint(2e-4), Part('growth'))
def thermal_growth(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Growth of every segment by α ΔT times its length, added to ``d.shift``.

    α, 1/K, is the only value; ΔT: temperature above the first.
    """
    d.shift += e.values[0] * c.warming_k[:, None, None] * c.segments


@_named('base_rotation', 'gravity_moment', no_joint(1e-4), Part('base_compliance'))
def base_compliance(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Rotation of the base about x and y in proportion to the weight's moments about them.

    Added to ``d.base``, rad; the only value is in rad/(N m).
    """
    d.base[:, :2] += e.values[0] * c.base_moment[:, :2]


@_named(
    'link_rotation',
    'gravity_moment',
    lambda kind, context: HiddenEffect(
        kind, (int(context.rng.integers(2, context.joints)),), np.array([5e-5])
    ),
    Part('lateral_compliance_{j}'),
)
def lateral_compliance(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Rotation of joint j's frame in proportion to gravity's moment across its axis.

    Of the moment on all that the joint carries. Added to ``d.tilt``, rad; the only value is in
    rad/(N m).
    """
    j = e.joints[0] - 1
    across = np.eye(3) - np.outer(c.axes[j], c.axes[j])
    d.tilt[:, j] += e.values[0] * c.carried_moment[:, j] @ across


def _draw_rocking(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a base that rocks by 2 mrad about a random horizontal axis, with a threshold.

    The detail has ``axis`` and ``moment``, N m, which the weight's moment about the axis
    exceeds at a quarter to three quarters of the visits.
    """
    angle = context.rng.uniform(0.0, np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    moment = np.quantile(context.circumstances.base_moment @ axis, context.rng.uniform(0.25, 0.75))
    return HiddenEffect(kind, (), np.array([2e-3]), {'axis': axis, 'moment': float(moment)})


@_named('base_rotation', 'gravity_moment', _draw_rocking, Part('base_tipping'))
def base_tipping(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Rotation of the base to one of two sides, by whether gravity's moment exceeds a threshold.

    About ``axis`` of the detail, by +½ of the value, rad, if the weight's moment about it is
    above ``moment``, N m, of the detail, else by -½; added to ``d.base``.
    """
    leans = c.base_moment @ e.detail['axis'] > e.detail['moment']
    d.base += e.values[0] * np.where(leans, 0.5, -0.5)[:, None] * e.detail['axis']


@_named('sensor_frame', 'time', of_sensor(1e-6, 3), *_along_axes('drift_{axis}_{{sensor}}'))
def registration_drift(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Drift of the sensor's readings with a constant velocity in its own frame N.

    The values, m/s, times the time since the first measurement, added to ``d.sensor_shift``.
    """
    d.sensor_shift[:, d.sensors.index(e.detail['sensor'])] += c.time_s[:, None] * e.values


@_named(
    'sensor_frame',
    'position',
    of_sensor(1e-2, 1, ('all', 'depth')),
    Part('scale_z_{sensor}', detail={'form': 'depth'}),
    Part('scale_{sensor}', detail={'form': 'all'}),
)
def sensor_scale(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = s p of a sensor's reading p, or only of its depth (z of N); s is the only value.

    Added to ``d.scale``; the detail's ``form`` is 'all' or 'depth'.
    """
    along = np.array([0.0, 0.0, 1.0]) if e.detail['form'] == 'depth' else np.ones(3)
    d.scale[:, d.sensors.index(e.detail['sensor'])] += e.values[0] * along


@_named('sensor_frame', 'position', of_sensor(0.2), Part('radial_{sensor}'))
def sensor_distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = k r² (x, y, 0) of a sensor's reading (x, y, z), r its distance from the optical axis z.

    k, 1/m², is the only value, added to ``d.radial``.
    """
    d.radial[:, d.sensors.index(e.detail['sensor'])] += e.values[0]


@_unnamed(
    'joint_angle',
    'gravity_torque',
    two_joints(4e-4),
    Part('joint_{j}_by_gravity_torque_of_joint_{by}'),
    power=-1,
)
def foreign_torque(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s τ_i, added to ``d.angle``: joint j yields to the gravity torque of another joint i.

    Joint i is ``by`` in the detail; s, rad/(N m), is the only value.
    """
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.torque[:, e.detail['by'] - 1]


@_unnamed('joint_angle', 'time', one_value(1e-6, 2), Part('joint_{j}_by_time'))
def creeping_joint(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s t, added to ``d.angle``; s, rad/s, is the only value.

    t: time since the first measurement, s.
    """
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.time_s


@_unnamed(
    'joint_angle', 'time', at_some_time(one_value(15 * ARC_MINUTE, 2)), Part('joint_{j}_step')
)
def slipped_joint(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s after ``moment_s``, a time in the detail, s; added to ``d.angle``.

    s, rad, is the only value; before that time 0.
    """
    d.angle[:, e.joints[0] - 1] += e.values[0] * _after(e, c)


@_unnamed('joint_angle', 'temperature', one_value(5e-4, 2), Part('joint_{j}_by_temperature'))
def warm_joint(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s ΔT, added to ``d.angle``; s, rad/K, is the only value.

    ΔT: the arm's temperature above its first, K.
    """
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.warming_k


@_unnamed('joint_angle', 'angle', two_joints(3e-3), power=2)
def bent_coupling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s q_i², added to ``d.angle``: neither a line nor a wave of the other joint.

    Joint i is ``by`` in the detail; s, 1/rad, is the only value.
    """
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.q[:, e.detail['by'] - 1] ** 2


@_unnamed('marker', 'gravity', no_joint(3e-3))
def sagging_tool(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Shift of all markers by s times gravity's direction across the tool's z axis, m.

    As if their stem bends; in the tool frame, added to ``d.marker``. s, m, is the only value.
    """
    down = np.swapaxes(c.tool, -1, -2) @ np.array([0.0, 0.0, -1.0])
    d.marker += e.values[0] * (down * (1.0, 1.0, 0.0))[:, None]


@_unnamed('sensor_frame', 'time', at_some_time(_draw_bump))
def bumped_sensor(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = v + w × p of a sensor's readings p after some time, as if the sensor was moved.

    Values: v, m, then w, rad. Added to ``d.sensor_shift`` and ``d.turn`` after ``moment_s`` of
    the detail.
    """
    s, after = d.sensors.index(e.detail['sensor']), _after(e, c)[:, None]
    d.sensor_shift[:, s] += after * e.values[:3]
    d.turn[:, s] += after * e.values[3:]


@_unnamed('marker', 'time', at_some_time(_draw_marker_slip))
def slipped_marker(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Shift of one marker on the tool after some time, m along x, y, z of the tool.

    The values, added to ``d.marker`` of ``marker`` after ``moment_s``, both of the detail.
    """
    d.marker[:, d.markers.index(e.detail['marker'])] += _after(e, c)[:, None] * e.values


@_unnamed('sensor_frame', 'position', _about_mean_distance(0.05), answers=('sensor_distortion',))
def range_distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δ = k (|p|/D − 1)² along the line of sight: zero near the mean distance D.

    k, m, is the only value; D is ``distance_m`` in the detail. Added to ``d.along`` and
    ``d.scale``.
    """
    s, k, mean = d.sensors.index(e.detail['sensor']), e.values[0], e.detail['distance_m']
    d.along[:, s, 0] += k
    d.scale[:, s] -= 2.0 * k / mean
    d.along[:, s, 1] += k / mean**2


@_unnamed(
    'sensor_frame',
    'position',
    _about_mean_distance(0.02),
    # It is the sum of the two.
    answers=('sensor_distortion', 'sensor_scale'),
)
def spherical_distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = k ((|p|/D)² − 1) p of a sensor's reading p: zero at the mean distance D only.

    k, without unit, is the only value; D is ``distance_m`` in the detail. Added to ``d.along``
    and ``d.scale``.
    """
    s = d.sensors.index(e.detail['sensor'])
    d.along[:, s, 2] += e.values[0] / e.detail['distance_m'] ** 2
    d.scale[:, s] -= e.values[0]


@_unnamed('sensor_frame', 'position', of_sensor(0.05, 2), answers=('sensor_distortion',))
def one_sided_lens(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = z u² k in x and y if u = (x, y)/z · k/|k| is positive, else 0.

    k: the two values; added to ``d.half``. (x, y, z): the true point in the sensor's frame N.
    """
    d.half[:, d.sensors.index(e.detail['sensor'])] += e.values


def _draw_off_centre(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a distortion of a random sensor by ±0.2 1/m² about a center 0.3 m beside the axis.

    The center is ``center`` in the detail, m, (2,), in a random direction.
    """
    effect = of_sensor(0.2)(kind, context)
    return replace(effect, detail={**effect.detail, 'center': 0.3 * context.direction(2)})


@_unnamed('sensor_frame', 'position', _draw_off_centre, answers=('sensor_distortion',))
def off_centre_lens(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = k |p − c|² (p − c) in x and y of a sensor's reading p, about a center c off the axis z.

    k, 1/m², is the only value; c, m, is ``center`` in the detail. Added to ``d.radial`` and
    ``d.center``.
    """
    s = d.sensors.index(e.detail['sensor'])
    d.radial[:, s] += e.values[0]
    d.center[:, s] += e.detail['center']


def _draw_lagging(kind: str, context: DrawContext) -> HiddenEffect:
    """Draw a thermal growth of 2e-4 1/K that lags behind the temperature by 900 to 4500 s.

    A random time constant, ``lag_s`` in the detail.
    """
    lag = float(context.rng.uniform(900.0, 4500.0))
    return HiddenEffect(kind, (), np.array([2e-4]), {'lag_s': lag})


@_unnamed('link_translation', 'temperature', _draw_lagging, answers=('thermal_growth',))
def lagging_growth(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Growth of every segment by α times its length per K of a delayed temperature.

    α, 1/K, is the only value. Added to ``d.shift``. The delay is of first order with the time
    constant ``lag_s``, s, of the detail.
    """
    # The thermometer's temperature is a line between two configurations.
    tau, slow = e.detail['lag_s'], np.zeros(len(c.time_s))
    for i in range(1, len(slow)):
        dt = c.time_s[i] - c.time_s[i - 1]
        rate = (c.warming_k[i] - c.warming_k[i - 1]) / max(dt, 1e-9)
        steady = c.warming_k[i - 1] - rate * tau
        slow[i] = steady + rate * dt + (slow[i - 1] - steady) * np.exp(-dt / tau)
    d.shift += e.values[0] * slow[:, None, None] * c.segments


def _draw_guide(largest: float) -> Draw:
    """Return a function that draws a sine wave along a random joint that slides.

    Half to one and a half periods over the joint's visited range. The value is `largest`, 0 at
    joint 1 if nothing slides. The detail has ``axis``, a unit vector across the slide,
    ``per_m``, rad/m, and ``phase``, rad.
    """

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        c, rng = context.circumstances, context.rng
        slides = 1 + np.flatnonzero(c.per_radian != 1.0)
        joint = int(rng.choice(slides)) if len(slides) else 1
        across = np.cross(c.axes[joint - 1], rng.standard_normal(3))
        detail = {
            'axis': across / np.linalg.norm(across),
            'per_m': 2.0 * np.pi * rng.uniform(0.5, 1.5) / max(np.ptp(c.q[:, joint - 1]), 1e-9),
            'phase': rng.uniform(0.0, 2.0 * np.pi),
        }
        return HiddenEffect(kind, (joint,), np.array([largest * bool(len(slides))]), detail)

    return draw


def _along_guide(e: HiddenEffect, c: Circumstances) -> FloatArray:
    """Wave of a slide's reported position, times the effect's value and axis, m or rad, (n, 3)."""
    wave = np.sin(e.detail['per_m'] * c.q[:, e.joints[0] - 1] + e.detail['phase'])
    return e.values[0] * wave[:, None] * e.detail['axis']


@_of_slides('link_translation', 'own_place', _draw_guide(2e-3), answers=('guide_straightness',))
def crooked_guide(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Shift of the carriage of sliding joint j across its way, a sine of its position.

    m, added to ``d.shift``; axis, period and phase are in the detail.
    """
    d.shift[:, e.joints[0]] += _along_guide(e, c)


@_of_slides('link_rotation', 'own_place', _draw_guide(2e-3), answers=('guide_pitch',))
def pitching_guide(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Rotation of the carriage of sliding joint j across its way, a sine of its position.

    About an axis across the way, rad, added to ``d.tilt``, and to ``d.shift`` so that the
    carriage stays in its place.
    """
    j, turn = e.joints[0], _along_guide(e, c)
    d.tilt[:, j - 1] += turn
    # That turns the way about its zero; the carriage stays where it is.
    d.shift[:, j] -= np.cross(turn, c.q[:, [j - 1]] * c.axes[j - 1])


KINDS = NAMED | UNNAMED | OF_SLIDES


def add_effect(effect: HiddenEffect, deviation: Deviation, c: Circumstances) -> None:
    """Add an effect's errors, by the rule of its kind, to the arrays of a deviation, in place."""
    KINDS[effect.kind].rule(effect, deviation, c)


def true_parameters(effect: HiddenEffect) -> dict[str, float]:
    """True values of an effect's parameters, SI units, by their names in a discovery.

    {} if none can be compared: a curve, a marker (of which only parts can be seen), and most
    effects without a name.
    """
    return {
        name: value
        for effect_part in _each(effect)
        for part in KINDS[effect.kind].parts
        for name, value in part.of(effect_part).items()
    }


def _each(effect: HiddenEffect) -> list[HiddenEffect]:
    """Split an effect into one for each joint, or waves into one for each order; else [effect]."""
    if len(effect.joints) > 1:
        return [
            replace(effect, joints=(joint,), values=np.array([value]))
            for joint, value in zip(effect.joints, effect.values, strict=True)
        ]
    if effect.kind in ('encoder_eccentricity', 'gear_periodic'):
        return [
            replace(effect, values=values, detail={'orders': (order,)})
            for order, values in zip(
                effect.detail['orders'], effect.values.reshape(-1, 2), strict=True
            )
        ]
    return [effect]
