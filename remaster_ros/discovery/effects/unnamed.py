"""Unnamed candidates by place, driver and form, so that an unknown cause is still located."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from remaster_ros.discovery.effects import joint_error_curve
from remaster_ros.discovery.effects.base import (
    Candidate,
    Design,
    Effect,
    Place,
    along_axes,
    displaced,
    turned,
)
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import (
    TIME,
    Driver,
    angle_of,
    approach_of,
    last_move_of,
    slow_drivers,
    torque_of,
)
from remaster_ros.discovery.effects.sizes import at_most
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import BoolArray, FloatArray

# All causes without a name together are this many times less likely than one that has a name.
RARITY = 3
# What an angle errs by is no larger without a name than with one, rad.
LARGEST_RAD = joint_error_curve.LARGEST_RAD
# Knots of a free form over the range of its driver.
FREE_KNOTS = 10

Feature = Callable[[Context], FloatArray]


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield all candidates without a name: errors of joints, links, base, markers and sensors.

    As functions of the quantities that they may depend on, without those that a named effect
    has.
    """
    found = [*_joint_angles(context), *_links(context), *_frames(context)]
    for candidate in found:
        yield replace(candidate, drawn_from=RARITY * len(found))


@dataclass(frozen=True, eq=False)
class _Form:
    """Function by which an error depends on a driver, such as 'linear' or 'free', as features.

    ``features``: of a context, (n, m); ``suffixes``: of the m parameters' names; ``unit``: of
    the driver's part, to follow the error's unit.
    """

    driver: str
    name: str
    features: Feature
    suffixes: tuple[str, ...]
    unit: str = ''
    penalty: FloatArray | None = None
    curve: Curve | None = None
    sign: int = 0


def _forms(
    context: Context, driver: Driver, *names: str, rows: BoolArray | None = None
) -> Iterator[_Form]:
    """Yield forms of a driver: 'linear', 'quadratic', 'sin/cos' or 'free' (a spline).

    ``names``: which of them; ``rows``: mask of rows, (n,), over which the spline is made; only
    rows to fit among these (all, if None). Nothing if the driver varies by less than 1e-9
    there.
    """
    values = driver.value(context)[context.to_fit if rows is None else context.to_fit & rows]
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9:
        return
    for name in names:
        form = partial(_Form, driver.name, name)
        if name == 'sin/cos':
            yield form(partial(_sine_cosine, value=driver.value), ('_sin', '_cos'))
        elif name == 'free':
            curve = driver.curve(context, 1.0 / FREE_KNOTS, rows=rows)
            features = partial(_spline, value=driver.value, curve=curve)
            suffixes = tuple(f'_{i}' for i in range(len(curve.places)))
            yield form(features, suffixes, penalty=curve.penalty, curve=curve)
        else:
            power = 2 if name == 'quadratic' else 1
            unit = '' if driver.unit == '1' else f'/{driver.unit}' + ('^2' if power == 2 else '')
            yield form(partial(_power, value=driver.value, power=power), ('',), unit)


def _power(context: Context, value: Feature, power: int) -> FloatArray:
    """Return a driver's values to a power, unscaled, as one feature, (n, 1).

    ``value``: function from a context to the driver's values, (n,).
    """
    return value(context)[:, None] ** power


def _sine_cosine(context: Context, value: Feature) -> FloatArray:
    """Return sine and cosine of a driver's values as two features, (n, 2).

    ``value``: function from a context to the driver's values, rad, (n,).
    """
    return np.stack((np.sin(value(context)), np.cos(value(context))), axis=-1)


def _spline(context: Context, value: Feature, curve: Curve) -> FloatArray:
    """Return the free splines of a curve at a driver's values as features, (n, m).

    ``value``: function from a context to the driver's values, (n,).
    """
    return curve.columns(value(context))


def _candidate(
    place: Place,
    form: _Form,
    stems: list[str],
    unit: str,
    columns: Callable[[Context], Design],
    joints: tuple[int, ...] = (),
    subject: str = '',
    **more: Any,
) -> Candidate:
    """Return the candidate without a name of an error at a place that follows a form.

    Parameters are named by each of ``stems`` with each of the form's suffixes. ``unit``: of the
    error; that of the form, such as '/K', is appended; ``more``: further arguments of
    `Candidate`.
    """
    return EFFECT.candidate(
        columns,
        [f'{stem}{suffix}' for suffix in form.suffixes for stem in stems],
        joints=joints,
        place=place,
        driver=form.driver,
        form=form.name,
        unit=f'{unit}{form.unit}',
        penalty=form.penalty,
        curve=form.curve,
        sign=form.sign,
        subject=subject,
        **more,
    )


def _joint_forms(context: Context, joint: int) -> Iterator[tuple[tuple[int, ...], _Form]]:
    """Yield forms by which an unnamed error of a joint's position may depend on a driver.

    Linear, quadratic or free functions of its own angle, approach, last move and gravity
    torque, of those of other joints, of time or of temperature; each with its joints
    (1-based): this one, then the driver's if that is another. None of a driver that hardly
    varies.
    """

    def by(driver: Driver, *names: str) -> Iterator[tuple[tuple[int, ...], _Form]]:
        joints = (joint,) if driver.joint in (0, joint) else (joint, driver.joint)
        return ((joints, form) for form in _forms(context, driver, *names))

    if joint in context.moving:
        yield from by(angle_of(context, joint), 'quadratic')
        if context.has_approach:
            # The other sign has a name: backlash and settling.
            for driver, sign in (
                (approach_of(context, joint, 'approach'), -1),
                (last_move_of(context, joint, 'last_move'), 1),
            ):
                for joints, form in by(driver, 'linear'):
                    yield joints, replace(form, sign=sign)
    for driver in slow_drivers(context):
        yield from by(driver, 'linear', 'quadratic', 'free')
    if context.has_gravity:
        yield from by(torque_of(context, joint), 'quadratic', 'free')
    for other in range(1, context.joints + 1):
        if other == joint:
            continue
        if other in context.moving:
            driver = angle_of(context, other, f'angle_of_joint_{other}')
            yield from by(driver, 'quadratic', 'free')
        if context.has_gravity:
            driver = torque_of(context, other, f'gravity_torque_of_joint_{other}')
            yield from by(driver, 'linear')
        if context.has_approach and other in context.moving:
            yield from by(approach_of(context, other, f'approach_of_joint_{other}'), 'linear')
            driver = last_move_of(context, other, f'last_move_of_joint_{other}')
            yield from by(driver, 'linear')


def _joint_angles(context: Context) -> Iterator[Candidate]:
    """Yield the candidates of each joint's position, one for each of its `_joint_forms`."""
    for joint in range(1, context.joints + 1):
        for joints, form in _joint_forms(context, joint):
            stem = f'joint_{joint}_by_{form.driver}'
            columns = partial(_at, joint=joint, form=form)
            unit = 1.0 if form.curve is not None else _rms(form.features(context))
            yield _candidate(
                'joint_angle',
                form,
                [stem],
                context.chain.units[joint - 1],
                columns,
                joints,
                largest=LARGEST_RAD * context.chain.per_radian[joint - 1] / unit,
                slide=context.slides(joint),
            )


def _rms(values: FloatArray) -> float:
    """Root mean square of all entries; 1 if they are all zero, as it is a divisor."""
    return float(np.sqrt(np.mean(values**2))) or 1.0


def _at(context: Context, joint: int, form: _Form) -> Design:
    """Return columns that add a form's features to a joint's (1-based) position."""
    return Design(joint - 1, form.features(context))


def _shifted(context: Context, turn: Feature, form: _Form) -> Design:
    """Return columns of a shift in proportion to each of a form's m features: 3 for each.

    One along each axis of a frame. ``turn``: function from a context to the rotation matrices of
    that frame in each row, (n, 3, 3).
    """
    return displaced(*along_axes(form.features(context), turn(context)))


def _rotated(context: Context, turn: Feature, about: Feature, form: _Form) -> Design:
    """Return columns of a rotation in proportion to each of a form's m features: 3 for each.

    One about each axis of a frame, as displacement of the marker, m per rad. ``turn``, ``about``:
    functions from a context to the rotation matrices of that frame, (n, 3, 3), and to points on
    the axes, m, (n, 3).
    """
    return turned(context, along_axes(form.features(context), turn(context)), about(context))


def _links(context: Context) -> Iterator[Candidate]:
    """Yield candidates of each link that shifts or turns in proportion to time or temperature."""
    slow = [form for driver in slow_drivers(context) for form in _forms(context, driver, 'linear')]
    for link in context.links():
        turn = partial(Context.link_rotation, joint=link)
        about = partial(Context.joint_origin, joint=link + 1)
        for form in slow:
            axes, turns = ([f'link_{link}_{kind}{axis}' for axis in 'xyz'] for kind in ('', 'r'))
            shift = partial(_shifted, turn=turn, form=form)
            yield _candidate('link_translation', form, axes, 'm', shift, (link,))
            rotation = partial(_rotated, turn=turn, about=about, form=form)
            yield _candidate('link_rotation', form, turns, 'rad', rotation, (link,))


def _base_turn(context: Context) -> FloatArray:
    """Return the rotation of the base frame R in itself, the identity, (n, 3, 3)."""
    return np.broadcast_to(np.eye(3), (len(context), 3, 3))


def _base_origin(context: Context) -> FloatArray:
    """Return the origin of the base frame R, zeros, m, (n, 3)."""
    return np.zeros((len(context), 3))


def _tool_turn(context: Context, marker: int) -> FloatArray:
    """Return the rotation of the tool frame in R, (n, 3, 3); 0 in rows of other markers."""
    return context.tool[:, :3, :3] * (context.marker == marker)[:, None, None]


def _sensor_turn(context: Context, sensor: int) -> FloatArray:
    """Return the rotation of a sensor's frame in R, (n, 3, 3); 0 in rows of other sensors."""
    return context.sensor_turn * context.seen_by(sensor)[:, None, None]


def _sagging(context: Context, marker: int) -> Design:
    """Return the column of a marker whose stem, along the tool's z axis, bends under gravity.

    Component of gravity's direction across that axis, m per m; 0 in rows of other markers.
    """
    axis = context.tool[:, :3, 2]
    across = np.array((0.0, 0.0, -1.0)) + axis * axis[:, 2:]
    return displaced((context.marker == marker)[:, None] * across)


def _line_of_sight(context: Context, sensor: int, power: int) -> Design:
    """Return the column of a shift along a sensor's lines of sight, by a power of the distance, m.

    ``power``: 0 is a constant shift. Rows of other sensors are 0.
    """
    distance = np.maximum(context.range_m, 1e-3)
    along = np.einsum('nij,nj->ni', context.sensor_turn, context.in_sensor)
    return displaced((context.seen_by(sensor) * distance ** (power - 1.0))[:, None] * along)


def _frames(context: Context) -> Iterator[Candidate]:
    """Yield candidates of errors of the base, the markers and the sensors.

    The base turns with time, temperature or joint 1; markers shift with time, temperature or
    gravity; sensors shift with temperature, or along the line of sight with the distance.
    """
    slow = [form for driver in slow_drivers(context) for form in _forms(context, driver, 'linear')]
    first = angle_of(context, 1, 'angle_of_joint_1')
    # What twists and bends a rail has a name (`guide_pitch`).
    around = () if context.slides(1) else _forms(context, first, 'sin/cos')
    for form in (*slow, *around):
        columns = partial(_rotated, turn=_base_turn, about=_base_origin, form=form)
        yield _candidate(
            'base_rotation', form, [f'base_r{axis}' for axis in 'xyz'], 'rad', columns
        )
    for index, marker in enumerate(context.marker_names):
        axes = [f'marker_{marker}_{axis}' for axis in 'xyz']
        for form in slow:
            columns = partial(_shifted, turn=partial(_tool_turn, marker=index), form=form)
            yield _candidate('marker', form, axes, 'm', columns, subject=marker)
        yield EFFECT.candidate(
            partial(_sagging, marker=index),
            [f'sag_{marker}'],
            place='marker',
            driver='gravity',
            form='linear',
            unit='m',
            subject=marker,
        )
    with_lens = context.sensors('tracker', 'controller')
    for index, sensor in context.sensors('controller'):
        axes = [f'{sensor}_{axis}' for axis in 'xyz']
        for form in _sensor_forms(context, index):
            columns = partial(_shifted, turn=partial(_sensor_turn, sensor=index), form=form)
            yield _candidate('sensor_frame', form, axes, 'm', columns, subject=sensor)
        for name, power, unit in (('constant', 0, 'm'), ('quadratic', 2, '1/m')):
            if power and (index, sensor) not in with_lens:
                continue
            yield EFFECT.candidate(
                partial(_line_of_sight, sensor=index, power=power),
                [f'range_{name}_{sensor}'],
                place='sensor_frame',
                driver='range',
                form=name,
                unit=unit,
                subject=sensor,
            )


def _sensor_forms(context: Context, sensor: int) -> Iterator[_Form]:
    """Yield forms by which a sensor's shift may depend on temperature: linear, and free.

    ``sensor``: its index, over whose rows the free form (a spline) is made. Nothing if the
    temperature does not vary. Time is left out, as named causes cover it.
    """
    for driver in slow_drivers(context):
        if driver == TIME:
            continue
        for form in _forms(context, driver, 'linear', 'free', rows=context.seen_by(sensor)):
            if form.penalty is not None:
                # The three axes of a knot stand next to each other.
                penalty: FloatArray = np.kron(form.penalty, np.eye(3)).astype(float)
                yield replace(form, penalty=penalty)
            else:
                yield form


def _size(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the largest error by an unnamed candidate, of a joint or of the marker.

    ``draws``: of its parameters, (draws, m).
    """
    what = (
        f'joint {candidate.joints[0]} errs'
        if candidate.place == 'joint_angle'
        else 'the marker is moved'
    )
    return f'{what} by up to {at_most(context, candidate, draws)}'


EFFECT = Effect(
    name='unnamed',
    place='joint_angle',
    driver='any',
    form='any',
    equation='δ = Σ θ_i f_i(driver) at the place',
    source='the systematic table of places, drivers and forms',
    unit='',
    plausible=None,
    sentence='No named cause: {place} follows {driver}.',
    separate_by='poses in which {driver} changes and all else is held',
    remedy='Find the cause: measure poses in which {driver} changes and all else is held, and see '
    'what it comes with.',
    size=_size,
    candidates=candidates,
    cause_per='variant',
    many=True,
)
