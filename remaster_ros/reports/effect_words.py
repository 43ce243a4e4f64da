"""What pages call an effect of discovery.json, and the law behind it."""

from __future__ import annotations

import re

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.words import called
from remaster_ros.reports.discovery_schema import Effect

UNNAMED, STEP = 'unnamed', 'step'


def title(effect: Effect | FoundEffect) -> str:
    """Return a heading: 'Link length of joint 2', 'Sensor mocap moved'."""
    if effect.name != UNNAMED:
        name = called(effect.name, effect.joints)
        return name[:1].upper() + name[1:]
    joint = f'joint {effect.joints[0]}' if effect.joints else ''
    if effect.form == STEP:
        subject = re.sub(r'_step(_r?[xyz])?$', '', effect.parameters[0].name)
        return {
            'joint_angle': f'{joint.capitalize()} slipped',
            'marker': f'Marker {subject.removeprefix("marker_")} moved',
            'sensor_frame': f'Sensor {subject} moved',
        }.get(effect.place, 'The base moved, or all sensors together')
    place = effect.place.replace('_', ' ').capitalize()
    driver = effect.driver.replace('_', ' ')
    return f'{place}{f" of {joint}" if joint else ""}: an error that follows {driver}'


def law(effect: Effect) -> str:
    """Return equation and source of an effect; one without a name has those of its form."""
    name = STEP if effect.name == UNNAMED and effect.form == STEP else effect.name
    kind = EFFECTS.get(name)
    return '' if kind is None else f'{kind.equation} ({kind.source})'


def moment(effect: Effect) -> tuple[float, float] | None:
    """Return when something happened at one moment, s since the first reading, and its std."""
    for parameter in effect.parameters:
        if parameter.name == 'moment':
            return parameter.value, parameter.std
    return None


def is_held_by_model(effect: Effect) -> bool:
    """Whether the corrected robot model holds it: a length or a tilt that is constant."""
    return effect.driver == 'constant' and effect.place in ('link_translation', 'link_rotation')


def is_of_measurement(effect: Effect) -> bool:
    """Whether it lies in how the arm was measured and not in the arm."""
    if effect.form == STEP:
        return effect.place != 'joint_angle'
    return effect.place == 'sensor_frame' or (
        effect.place == 'marker' and effect.driver == 'constant'
    )
