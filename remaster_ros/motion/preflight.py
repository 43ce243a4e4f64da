# SPDX-License-Identifier: Apache-2.0
"""What must be right before the first motion: topics, sensors and nodes. Times are arguments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

FRESH_S = 3.0
"""Nothing older counts as a sign of life (wall time), s."""


@dataclass(frozen=True)
class SensorFacts:
    """The present state of a sensor. Ages are wall time, s; infinite for what never came."""

    name: str  # As in the cell
    node_age_s: float  # Since the last report of its node
    ready: bool  # Whether its node reports that the device can measure
    message: str  # The node's own diagnosis
    read_age_s: float  # Since the recorder's last reading of it


@dataclass(frozen=True)
class Facts:
    """Present state of robot, nodes and sensors that the first motion needs."""

    joints_age_s: float  # Since the last joint_states that name every joint, s
    joints_message: str  # What is wrong with them; ''
    # Since the last report of the bridge and of the recorder, s
    bridge_age_s: float
    recorder_age_s: float
    sensors: Sequence[SensorFacts]  # Those that the arm waits for
    any_sensor: bool = False  # Whether one of them is enough


def preflight(facts: Facts) -> tuple[str, ...]:
    """Return obstacles to the first motion, one line each; () if it may begin.

    What is older than `FRESH_S` is missing. Sensors that are not ready are obstacles, except
    if `any_sensor` is set and at least one of them is ready.
    """
    findings = []
    if facts.joints_message:
        findings.append(facts.joints_message)
    elif not facts.joints_age_s <= FRESH_S:
        findings.append('no joint_states: is the robot running?')
    for node, age_s in (('robot_bridge', facts.bridge_age_s), ('recorder', facts.recorder_age_s)):
        if not age_s <= FRESH_S:
            findings.append(f'no sign of {node}: is it running in this ROS domain?')
    troubles = [trouble for sensor in facts.sensors if (trouble := _trouble(sensor))]
    if troubles and not (facts.any_sensor and len(troubles) < len(facts.sensors)):
        findings.extend(troubles)
    return tuple(findings)


def _trouble(sensor: SensorFacts) -> str:
    """Why a sensor is not ready (no node, not ready, marker not read), and a remedy; or ''."""
    if not sensor.node_age_s <= FRESH_S:
        return f'{sensor.name}: no sign of its node: is it running in this ROS domain?'
    if not sensor.ready:
        return f'{sensor.name}: {sensor.message or "not ready"}'
    if not sensor.read_age_s <= FRESH_S:
        seen = sensor.message or 'turn the tool until the sensor sees its marker'
        return f'{sensor.name}: the recorder has no reading of its marker: {seen}'
    return ''
