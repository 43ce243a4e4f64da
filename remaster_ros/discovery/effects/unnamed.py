"""What has no name: places by drivers by forms, so that an unknown cause is still located."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import (
    Cell,
    Design,
    Effect,
    Place,
    displaced,
    turned,
)
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.splines import basis, knot_vector, roughness
from remaster_ros.types import FloatArray

# All causes without a name together are this many times less likely than one that has a name.
RARITY = 3
FREE_KNOTS = 10
# Something may have slipped or been bumped at any time: so many moments are tried.
MOMENTS = 24

Feature = Callable[[Context], FloatArray]


@dataclass(frozen=True, eq=False)
class Driver:
    """What may drive an error: its name, unit, and value in each row, (n,)."""

    name: str
    unit: str
    value: Feature


def cells(context: Context) -> Iterator[Cell]:
    """All cells that no named effect has."""
    found = [*_joint_angles(context), *_links(context), *_frames(context)]
    for cell in found:
        yield replace(cell, drawn_from=RARITY * len(found))


def _elapsed(context: Context) -> FloatArray:
    return context.elapsed_s


def _warming(context: Context) -> FloatArray:
    return context.warming


def _angle(context: Context, joint: int) -> FloatArray:
    return context.measurements.q[:, joint - 1]


def _torque(context: Context, joint: int) -> FloatArray:
    return context.gravity_torque[:, joint - 1]


def _approach(context: Context, joint: int) -> FloatArray:
    return context.approach[:, joint - 1]


def _move(context: Context, joint: int) -> FloatArray:
    return context.last_move[:, joint - 1]


def _power(context: Context, value: Feature, power: int) -> FloatArray:
    return value(context)[:, None] ** power


def _sine_cosine(context: Context, value: Feature) -> FloatArray:
    return np.stack((np.sin(value(context)), np.cos(value(context))), axis=-1)


def _after(context: Context, moment: float) -> FloatArray:
    return (context.elapsed_s > moment).astype(float)[:, None]


def _spline(context: Context, value: Feature, knots: FloatArray) -> FloatArray:
    return basis(value(context), knots)


def slow_drivers(context: Context) -> list[Driver]:
    """Return the drivers that change over the session."""
    found = [Driver('time', 's', _elapsed)] if context.has_time else []
    return found + ([Driver('temperature', 'K', _warming)] if context.has_temperature else [])


@dataclass(frozen=True, eq=False)
class _Form:
    """A form of a driver: its m features, (n, m), with suffixes and unit of the parameters."""

    name: str
    features: Feature
    suffixes: tuple[str, ...]
    unit: str
    penalty: FloatArray | None = None
    variant: str = ''


def _form(context: Context, driver: Driver, name: str) -> _Form | None:
    """Return a driver's form; None where the driver hardly varies."""
    values = driver.value(context)
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9:
        return None
    if name == 'sin/cos':
        return _Form(name, partial(_sine_cosine, value=driver.value), ('_sin', '_cos'), '')
    if name == 'free':
        knots = knot_vector(low, high, (high - low) / FREE_KNOTS)
        count = len(knots) - 4
        suffixes = tuple(f'_{i}' for i in range(count))
        features = partial(_spline, value=driver.value, knots=knots)
        return _Form(name, features, suffixes, '', roughness(count))
    power = 2 if name == 'quadratic' else 1
    unit = '' if driver.unit == '1' else f'/{driver.unit}' + ('^2' if power == 2 else '')
    return _Form(name, partial(_power, value=driver.value, power=power), ('',), unit)


def _steps(context: Context) -> list[_Form]:
    """Return steps at moments spread over the session, between rows."""
    if not context.has_time:
        return []
    times = np.unique(context.elapsed_s)
    chosen = np.unique(np.linspace(0, len(times) - 1, MOMENTS + 2).astype(int)[1:-1])
    return [
        _Form(
            'step', partial(_after, moment=float(times[i])), ('',), '', None, f'{times[i]:.0f} s'
        )
        for i in chosen
    ]


def _joint_drivers(context: Context, joint: int) -> Iterator[tuple[Driver, tuple[int, ...], str]]:
    """Give each driver of a joint's angle with the joints it concerns and the forms tried."""
    if joint in context.moving:
        yield Driver('own_angle', 'rad', partial(_angle, joint=joint)), (joint,), 'quadratic'
    for driver in slow_drivers(context):
        yield driver, (joint,), 'linear quadratic free'
    if context.has_gravity:
        own = Driver('gravity_torque', '(N m)', partial(_torque, joint=joint))
        yield own, (joint,), 'quadratic free'
    for other in range(1, context.joints + 1):
        if other == joint:
            continue
        pair = (joint, other)
        if other in context.moving:
            angle = Driver(f'angle_of_joint_{other}', 'rad', partial(_angle, joint=other))
            yield angle, pair, 'quadratic free'
        if context.has_gravity:
            name = f'gravity_torque_of_joint_{other}'
            yield Driver(name, '(N m)', partial(_torque, joint=other)), pair, 'linear'
        if context.has_approach and other in context.moving:
            name = f'approach_of_joint_{other}'
            yield Driver(name, '1', partial(_approach, joint=other)), pair, 'linear'
            name = f'last_move_of_joint_{other}'
            yield Driver(name, 'rad', partial(_move, joint=other)), pair, 'linear'


def _at(context: Context, joint: int, form: _Form) -> Design:
    return Design(joint - 1, form.features(context))


def _joint_angles(context: Context) -> Iterator[Cell]:
    """Angles: by own angle squared, by other joints, by torques, over time and temperature."""
    for joint in range(1, context.joints + 1):
        forms = [
            (driver.name, joints, _form(context, driver, name))
            for driver, joints, names in _joint_drivers(context, joint)
            for name in names.split()
        ]
        forms += [('time', (joint,), step) for step in _steps(context)]
        for driver_name, joints, form in forms:
            if form is not None:
                yield _cell(
                    'joint_angle',
                    joints,
                    driver_name,
                    form,
                    (f'joint_{joint}_by_{driver_name}',),
                    'rad',
                    partial(_at, joint=joint, form=form),
                )


def _cell(
    place: Place,
    joints: tuple[int, ...],
    driver: str,
    form: _Form,
    stems: tuple[str, ...],
    unit: str,
    columns: Callable[[Context], Design],
    subject: str = '',
) -> Cell:
    return Cell(
        name='unnamed',
        joints=joints,
        place=place,
        driver=driver,
        form=form.name,
        parameters=tuple(f'{stem}{suffix}' for suffix in form.suffixes for stem in stems),
        unit=f'{unit}{form.unit}',
        columns=columns,
        penalty=form.penalty,
        variant=form.variant,
        subject=subject,
    )


def _shifted(context: Context, turn: Feature, form: _Form) -> Design:
    """Shift along the axes of a rotation (n, 3, 3), for each feature."""
    features = form.features(context)
    axes = turn(context)
    count = features.shape[1]
    return displaced(*(features[:, [i]] * axes[:, :, a] for i in range(count) for a in range(3)))


def _rotated(context: Context, turn: Feature, about: Feature, form: _Form) -> Design:
    """Turn about the axes of a rotation (n, 3, 3) through points (n, 3), for each feature."""
    features = form.features(context)
    frame = turn(context)
    axes = [features[:, [i]] * frame[:, :, a] for i in range(features.shape[1]) for a in range(3)]
    return turned(context, axes, about(context))


def _link_turn(context: Context, link: int) -> FloatArray:
    return context.link_rotation(link)


def _joint_origin(context: Context, joint: int) -> FloatArray:
    return context.joint_origin(joint)


def _bending(context: Context, link: int) -> Design:
    """Bearings give way to gravity's moment across the joint's own axis."""
    moment = context.gravity_moment[:, link - 1]
    own = context.link_rotation(link) @ context.chain.axes[link - 1]
    lateral = moment - np.sum(moment * own, axis=1)[:, None] * own
    return turned(context, [lateral], context.joint_origin(link))


def _links(context: Context) -> Iterator[Cell]:
    """Links that shift or turn: by gravity's moment, over time, by temperature."""
    for link in context.links():
        turn = partial(_link_turn, link=link)
        axes = tuple(f'link_{link}_{axis}' for axis in 'xyz')
        turns = tuple(f'link_{link}_r{axis}' for axis in 'xyz')
        for driver in slow_drivers(context):
            form = _form(context, driver, 'linear')
            if form is None:
                continue
            shift = partial(_shifted, turn=turn, form=form)
            yield _cell('link_translation', (link,), driver.name, form, axes, 'm', shift)
            about = partial(_joint_origin, joint=link + 1)
            rotation = partial(_rotated, turn=turn, about=about, form=form)
            yield _cell('link_rotation', (link,), driver.name, form, turns, 'rad', rotation)
        if context.has_gravity:
            yield Cell(
                name='unnamed',
                joints=(link,),
                place='link_rotation',
                driver='gravity_moment',
                form='linear',
                parameters=(f'lateral_compliance_{link}',),
                unit='rad/(N m)',
                columns=partial(_bending, link=link),
            )


def _base_turn(context: Context) -> FloatArray:
    return np.broadcast_to(np.eye(3), (len(context), 3, 3))


def _base_origin(context: Context) -> FloatArray:
    return np.zeros((len(context), 3))


def _tool_turn(context: Context, marker: int) -> FloatArray:
    return context.tool[:, :3, :3] * (context.marker == marker)[:, None, None]


def _sensor_turn(context: Context, sensor: int) -> FloatArray:
    return context.sensor_turn * context.seen_by(sensor)[:, None, None]


def _sagging(context: Context, marker: int) -> Design:
    """The marker's stem bends under its own weight, across the tool's z axis."""
    axis = context.tool[:, :3, 2]
    across = np.array((0.0, 0.0, -1.0)) + axis * axis[:, 2:]
    return displaced((context.marker == marker)[:, None] * across)


def _line_of_sight(context: Context, sensor: int, power: int) -> Design:
    distance = np.maximum(context.range_m, 1e-3)
    along = np.einsum('nij,nj->ni', context.sensor_turn, context.in_sensor)
    return displaced((context.seen_by(sensor) * distance ** (power - 1.0))[:, None] * along)


def _frames(context: Context) -> Iterator[Cell]:
    """Base, markers and sensors: over time, by temperature, gravity, joint 1, range."""
    slow = [
        (driver.name, form)
        for driver in slow_drivers(context)
        if (form := _form(context, driver, 'linear')) is not None
    ]
    turns = tuple(f'base_r{axis}' for axis in 'xyz')
    first = Driver('angle_of_joint_1', 'rad', partial(_angle, joint=1))
    for name, form in (*slow, (first.name, _form(context, first, 'sin/cos'))):
        if form is not None:
            columns = partial(_rotated, turn=_base_turn, about=_base_origin, form=form)
            yield _cell('base_rotation', (), name, form, turns, 'rad', columns)
    for index, marker in enumerate(context.marker_names):
        turn = partial(_tool_turn, marker=index)
        axes = tuple(f'marker_{marker}_{axis}' for axis in 'xyz')
        for name, form in slow:
            columns = partial(_shifted, turn=turn, form=form)
            yield _cell('marker', (), name, form, axes, 'm', columns, subject=marker)
        yield Cell(
            name='unnamed',
            joints=(),
            place='marker',
            driver='gravity',
            form='linear',
            parameters=(f'sag_{marker}',),
            unit='m',
            columns=partial(_sagging, marker=index),
            subject=marker,
        )
    for index, sensor in enumerate(context.sensor_names):
        turn = partial(_sensor_turn, sensor=index)
        axes = tuple(f'{sensor}_{axis}' for axis in 'xyz')
        forms = [('time', step) for step in _steps(context)]
        forms += [
            (driver.name, form)
            for driver in slow_drivers(context)
            for form in (_form(context, driver, name) for name in ('linear', 'free'))
            if form is not None and (driver.name, form.name) != ('time', 'linear')
        ]
        for name, form in forms:
            if form.penalty is not None:
                penalty: FloatArray = np.kron(form.penalty, np.eye(3)).astype(float)
                form = replace(form, penalty=penalty)
            columns = partial(_shifted, turn=turn, form=form)
            yield _cell('sensor_frame', (), name, form, axes, 'm', columns, subject=sensor)
        for form_name, power, unit in (('constant', 0, 'm'), ('quadratic', 2, '1/m')):
            yield Cell(
                name='unnamed',
                joints=(),
                place='sensor_frame',
                driver='range',
                form=form_name,
                parameters=(f'range_{form_name}_{sensor}',),
                unit=unit,
                columns=partial(_line_of_sight, sensor=index, power=power),
                subject=sensor,
            )


EFFECT = Effect(
    name='unnamed',
    place='joint_angle',
    driver='any',
    form='any',
    equation='δ = Σ θ_i f_i(driver) at the place',
    source='the systematic table of places, drivers and forms',
    unit='',
    plausible=(0.0, np.inf),
    sentence='No named cause: {place} follows {driver}.',
    separate_by='poses in which {driver} changes and all else is held',
    cells=cells,
    cause_per='variant',
)
