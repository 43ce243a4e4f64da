# SPDX-License-Identifier: Apache-2.0
"""What discovery has to report of a hidden effect: its cause by name.

This is the one module that uses both the names of hidden effects and those of discovery.json; only
judges use it, after everything that estimates has ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from remaster_ros.simulation.hidden_effects import KINDS, NAMED, UNNAMED, HiddenEffect

Cause = tuple[str, tuple[int, ...], str]
"""Name, joints, and the place and driver of what is hidden without a name; for a sensor its name.
"""


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


def named_cause(effect: Mapping[str, Any]) -> list[Cause]:
    """Return what an effect of a discovery.json claims, one cause for each joint.

    Parameters
    ----------
    effect
        Of its list ``effects``.
    """
    name, joints = effect['name'], tuple(effect['joints'])
    if name not in NAMED:
        return [(name, joints, f'{effect["place"]} {effect["driver"]}')]
    if name != 'joint_coupling' and len(joints) > 1:
        # One entry for several joints that err in the same way.
        return [(name, (joint,), '') for joint in joints]
    sensor = ''
    if effect['place'] == 'sensor_frame':
        sensor = effect['parameters'][0]['name'].rpartition('_')[2]
    return [(name, joints, sensor)]


def answers(found: Cause, hidden: Cause, effect: HiddenEffect) -> bool:
    """Return whether a cause found is the one hidden, which is a cause of the effect.

    What is hidden without a name is found by any effect that is at its place and has its driver,
    or that its kind names as an answer.
    """
    name, joints, rest = found
    if joints != hidden[1]:
        return False
    if name in KINDS[effect.kind].answers:
        return name not in NAMED or rest in ('', effect.detail.get('sensor', ''))
    return found == hidden or (name not in NAMED and hidden[0] == 'unnamed' and rest == hidden[2])


def describe(cause: Cause) -> str:
    """Return a cause in a few words."""
    name, joints, rest = cause
    where = f'joint {", ".join(map(str, joints))}' if joints else ''
    return ' '.join(part for part in (name, where, rest) if part)
