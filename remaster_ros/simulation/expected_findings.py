# SPDX-License-Identifier: Apache-2.0
"""Causes that discovery has to report for a hidden effect.

This is the only module with both the names of hidden effects and those of discovery.json; it is
used only by judges, after all estimating programs have ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.hidden_effects import KINDS, NAMED

Cause = tuple[str, tuple[int, ...], str]
"""Name, joints, and further: place and driver of an effect without a name, or a sensor's name."""


def causes(effect: HiddenEffect) -> list[Cause]:
    """Causes that discovery has to report for a hidden effect: one per compliant joint, else one.

    Joints count from 1; a coupled joint is followed by the one that drives it.
    """
    if effect.kind == 'joint_compliance':
        return [(effect.kind, (joint,), '') for joint in effect.joints]
    if effect.kind == 'joint_coupling':
        return [(effect.kind, (effect.joints[0], effect.detail['by']), '')]
    if effect.kind not in NAMED:
        return [_without_name(effect)]
    return [(effect.kind, effect.joints, effect.detail.get('sensor', ''))]


def _without_name(effect: HiddenEffect) -> Cause:
    """Cause that discovery has to report for an effect of a kind without a name.

    Its name is 'unnamed'; the joints are those of the effect, then the joint that drives it if
    that is another one; the last entry is 'PLACE DRIVER'.
    """
    cell = KINDS[effect.kind]
    joints, driver = effect.joints, cell.driver
    if 'by' in effect.detail:
        joints = (*joints, effect.detail['by'])
        driver = f'{driver}_of_joint_{effect.detail["by"]}'
    return 'unnamed', joints, f'{cell.place} {driver}'


def named_cause(effect: Mapping[str, Any]) -> list[Cause]:
    """Causes in one entry of the list ``effects`` of a discovery.json, one for each joint.

    A coupling, and an effect without a name, are a single cause with all its joints. The last
    entry of a cause is 'PLACE DRIVER' for an effect without a name, the sensor's name for an
    error of a sensor, else ''. ``effect``: the entry.
    """
    name, joints = effect['name'], tuple(effect['joints'])
    if name not in NAMED:
        return [(name, joints, f'{effect["place"]} {effect["driver"]}')]
    if name != 'joint_coupling' and len(joints) > 1:
        # One entry for several joints with the same kind of error.
        return [(name, (joint,), '') for joint in joints]
    sensor = ''
    if effect['place'] == 'sensor_frame':
        sensor = effect['parameters'][0]['name'].rpartition('_')[2]
    return [(name, joints, sensor)]


def answers(found: Cause, hidden: Cause, effect: HiddenEffect) -> bool:
    """Whether a found cause is a right answer to a hidden one, which is a cause of ``effect``.

    The joints must be equal, in order. Right are an equal cause, a cause without a name with
    the same place and driver as a hidden one without a name, and any further name that the
    kind of ``effect`` accepts (a sensor in it must be the right one).
    """
    name, joints, detail = found
    if joints != hidden[1]:
        return False
    if name in KINDS[effect.kind].accepted:
        return name not in NAMED or detail in ('', effect.detail.get('sensor', ''))
    return found == hidden or (
        name not in NAMED and hidden[0] == 'unnamed' and detail == hidden[2]
    )


def describe(cause: Cause) -> str:
    """Describe a cause as text: name, joints if any, then sensor or place and driver if any."""
    name, joints, detail = cause
    where = f'joint {", ".join(map(str, joints))}' if joints else ''
    return ' '.join(part for part in (name, where, detail) if part)
