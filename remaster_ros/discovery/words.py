"""Numbers and names in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from remaster_ros.calibration.gauge_words import listed, the
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.sizes import rounded
from remaster_ros.discovery.effects.unnamed import EFFECT as NO_NAME

# Unit of a parameter -> the unit for people, and how many of those one is.
SHOWN_UNITS = {
    'rad': ('′', 60.0 * 180.0 / np.pi),
    'rad/(N m)': ('′/(N m)', 60.0 * 180.0 / np.pi),
    'rad/rad': ('′/°', 60.0),
    'm': ('mm', 1e3),
    'm/m': ('mm/m', 1e3),
    'm/N': ('µm/N', 1e6),
    'm/rad': ('mm/°', 1e3 * np.pi / 180.0),
    'rad/m': ('′/m', 60.0 * 180.0 / np.pi),
    'm/s': ('mm/h', 3.6e6),
    's': ('ms', 1e3),
    's/s': ('ppm', 1e6),
    '1/K': ('µm/(m K)', 1e6),
    '1/s': ('µm/(m h)', 3.6e9),
}

# Place of an error -> what the name of its subject names.
KIND_OF_SUBJECT = {'sensor_frame': 'sensor', 'marker': 'marker'}

# Stamps between 2001 and 2100 are counted from 1970 on, smaller ones from the start of something.
EARLIEST_S, LATEST_S = 1e9, 4.1e9
# Below it a p-value's figures tell nobody more.
LEAST_P_VALUE = 1e-4

# Times of a session are told in minutes from here on, those of clocks in milliseconds, s.
LONG_S = 30.0
# A probability by a finite number of models visited is not stated beyond this.
MOST_STATED = 0.99


def shown(value: float, std: float, unit: str) -> tuple[str, str, str]:
    """Return value, standard deviation and unit of a parameter as texts, in usual units.

    The value has a sign; times of `LONG_S` or more are in minutes.
    """
    words, times = SHOWN_UNITS.get(unit, (unit, 1.0))
    if unit == 's' and abs(value) >= LONG_S:
        words, times = 'min', 1.0 / 60.0
    return *rounded(times * value, times * std, '+'), words


def percent(share: float) -> str:
    """Return a share as whole per cent with a typographic minus sign: '35 %'; never '-0 %'."""
    return f'{round(100.0 * share)} %'.replace('-', '−')


def probability_text(probability: float | None) -> str:
    """Return a probability as whole per cent, never '100 %'; 'unknown' for None."""
    if probability is None:
        return 'unknown'
    if probability > MOST_STATED:
        return f'over {percent(MOST_STATED)}'
    return percent(probability)


def p_value_text(p_value: float) -> str:
    """Return a p-value as text: 'p = 0.012', 'p < 0.0001' if below that, 'p unknown' for NaN."""
    if np.isnan(p_value):
        return 'p unknown'
    return f'p < {LEAST_P_VALUE:.4f}' if p_value < LEAST_P_VALUE else f'p = {p_value:.2g}'


def clock_time(stamp_s: float) -> str:
    """Return a time as text: '08:11:05 UTC on 2026-11-22'.

    ``stamp_s``: s since 1970. '' for a stamp that cannot be such a time, as it is far in the past
    or future.
    """
    if not EARLIEST_S < stamp_s < LATEST_S:
        return ''
    return f'{datetime.fromtimestamp(stamp_s, UTC):%H:%M:%S UTC on %Y-%m-%d}'


def titled(candidate: Candidate, joints: Sequence[int]) -> str:
    """Return a heading: 'Link length of joint 2', 'Joint 3 slipped', 'The sensor mocap moved'.

    ``candidate``: the first one of a cause; ``joints``: of the whole cause, 1-based; headings of
    steps and of unnamed causes name only the first. The heading of a change in mid-session ends
    with its time: ', from 12.0 min on'.
    """
    kind = KIND_OF_SUBJECT.get(candidate.place, '')
    joint = joint_words(joints[:1]) if joints else ''
    if candidate.happened and candidate.changes is None:
        words = {
            'joint_angle': f'{joint} slipped',
            'marker': f'{the(kind, candidate.subject)} moved',
            'sensor_frame': f'{the(kind, candidate.subject)} moved',
        }.get(candidate.place, 'the base moved, or all sensors together')
    elif candidate.name == NO_NAME.name:
        whose = joint or (the(kind, candidate.subject) if candidate.subject else '')
        driver = candidate.driver.replace('_', ' ')
        words = place_words(candidate) + (f' of {whose}' if whose else '')
        words += f': an error that follows {driver}'
    else:
        words = called(candidate.name, joints)
        if candidate.subject.lower() not in ('', kind):
            words += f' of {candidate.subject}'
    if candidate.changes is not None:
        minutes = f'{candidate.moment / 60.0:.1f} min'
        words += f', until {minutes}' if candidate.ends else f', from {minutes} on'
    return words[:1].upper() + words[1:]


def place_words(candidate: Candidate) -> str:
    """Return a candidate's place in words: 'joint angle', 'joint position' if the joint slides."""
    return 'joint position' if candidate.slide else candidate.place.replace('_', ' ')


def sentence_case(title: str) -> str:
    """Return a heading with its first letter small, as within a sentence."""
    return title[:1].lower() + title[1:]


def called(name: str, joints: Sequence[int]) -> str:
    """Return an effect's name with its joints (1-based): 'link length of joints 2 and 3'.

    The name alone without joints.
    """
    words = name.replace('_', ' ')
    return f'{words} of {joint_words(joints)}' if joints else words


def joint_words(joints: Sequence[int]) -> str:
    """Return joints (1-based) in words: 'joint 2', 'joints 2 and 3'."""
    return f'joint{"s" if len(joints) > 1 else ""} {listed([str(joint) for joint in joints])}'


def part_words(name: str, joints: Sequence[int], other: str, of: Sequence[int]) -> str:
    """Return 'joint 2 alone' if another effect has the same name and fewer joints, else ''.

    ``name``, ``joints``: of the effect; ``other``, ``of``: name and joints of the other.
    """
    return f'{joint_words(of)} alone' if other == name and set(of) < set(joints) else ''
