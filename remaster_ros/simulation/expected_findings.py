"""What discovery has to report of a hidden effect: its cause, and its parameters by name.

This is the one module that uses both the names of hidden effects and those of discovery.json; only
judges use it, after everything that estimates has ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from remaster_ros.simulation.hidden_effects import UNNAMED, HiddenEffect

Cause = tuple[str, tuple[int, ...], str]
"""Name, joints, and for a cell without a name its place and driver; for a sensor its name."""


def causes(effect: HiddenEffect) -> list[Cause]:
    """Return what has to be named: one cause for each joint that gives way, else one."""
    if effect.kind == 'joint_compliance':
        return [(effect.kind, (joint,), '') for joint in effect.joints]
    if effect.kind == 'joint_coupling':
        return [(effect.kind, (effect.joints[0], effect.detail['by']), '')]
    if effect.kind in UNNAMED:
        return [_without_name(effect)]
    return [(effect.kind, effect.joints, effect.detail.get('sensor', ''))]


def _without_name(effect: HiddenEffect) -> Cause:
    cell = UNNAMED[effect.kind]
    joints, driver = effect.joints, cell.driver
    if 'by' in effect.detail:
        joints = (*joints, effect.detail['by'])
        driver = f'{driver}_of_joint_{effect.detail["by"]}'
    return 'unnamed', joints, f'{cell.place} {driver}'


def true_parameters(effect: HiddenEffect) -> dict[str, float]:
    """Return an effect's true parameters, SI units, under the names that discovery gives them.

    Empty where there is none to compare: a curve, a marker (of which only parts can be seen), and
    cells without a name that are more than a line.
    """
    j = effect.joints[0] if effect.joints else 0
    values = [float(value) for value in effect.values]
    sensor, by = effect.detail.get('sensor'), effect.detail.get('by')
    match effect.kind:
        case 'joint_compliance':
            return {f'compliance_{i}': v for i, v in zip(effect.joints, values, strict=True)}
        case 'encoder_eccentricity' | 'gear_periodic':
            orders = effect.detail['orders']
            names = [f'{wave}{order}_{j}' for order in orders for wave in ('sin', 'cos')]
            return dict(zip(names, values, strict=True))
        case 'encoder_scale':
            return {f'scale_{j}': values[0]}
        case 'backlash':
            return {f'half_backlash_{j}': 0.5 * values[0]}
        case 'settling':
            return {f'settling_{j}': values[0]}
        case 'joint_coupling' if effect.detail['form'] == 'linear':
            return {f'coupling_{j}_by_{by}': values[0]}
        case 'joint_coupling':
            return {f'sin_{j}_by_{by}': values[0], f'cos_{j}_by_{by}': values[1]}
        case 'link_length':
            axis = effect.detail['axis']
            return {f'length_{j}' if axis == 'along' else f'offset_{axis}_{j}': values[0]}
        case 'joint_axis_tilt':
            return {f'tilt_{a}_{j}': float(t) for a, t in zip('xyz', values) if abs(t) > 1e-12}
        case 'thermal_growth':
            return {'growth': values[0]}
        case 'base_compliance':
            return {'base_compliance': values[0]}
        case 'registration_drift':
            return {f'drift_{a}_{sensor}': v for a, v in zip('xyz', values, strict=True)}
        case 'sensor_scale':
            prefix = 'scale_z' if effect.detail['form'] == 'depth' else 'scale'
            return {f'{prefix}_{sensor}': values[0]}
        case 'sensor_distortion':
            return {f'radial_{sensor}': values[0]}
        case 'foreign_torque':
            return {f'joint_{j}_by_gravity_torque_of_joint_{by}': values[0]}
        case 'creeping_joint' | 'slipped_joint':
            return {f'joint_{j}_by_time': values[0]}
        case 'warm_joint':
            return {f'joint_{j}_by_temperature': values[0]}
        case _:
            return {}


def named_cause(effect: Mapping[str, Any]) -> list[Cause]:
    """Return what an effect of a discovery.json claims, one cause for each joint.

    Parameters
    ----------
    effect
        Of its list ``effects``.
    """
    name, joints = effect['name'], tuple(effect['joints'])
    if name == 'unnamed':
        return [(name, joints, f'{effect["place"]} {effect["driver"]}')]
    if name != 'joint_coupling' and len(joints) > 1:
        # One entry for several joints that err in the same way.
        return [(name, (joint,), '') for joint in joints]
    sensor = ''
    if effect['place'] == 'sensor_frame':
        sensor = effect['parameters'][0]['name'].rpartition('_')[2]
    return [(name, joints, sensor)]


def describe(cause: Cause) -> str:
    """Return a cause in a few words."""
    name, joints, rest = cause
    where = f'joint {", ".join(map(str, joints))}' if joints else ''
    return ' '.join(part for part in (name, where, rest) if part)
