"""Which injections are drawn in a campaign, how often, and what the bridge has to do.

Expected is `halt`, `go on` (a control, or something that must not disturb) or `any` (both are
right; what is commanded is judged as always).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hostile_injections import (
    a_little_late,
    another_robots_joints,
    clock_set_back,
    command_doubled,
    commands_late,
    commands_lost,
    control,
    doubled_states,
    early_stamps,
    emergency,
    emergency_driver_silent,
    emergency_in_a_wait,
    emergency_released,
    emergency_topic,
    emergency_topic_blinks,
    emergency_while_braking,
    emergency_while_measuring,
    emergency_while_paused,
    foreign_commands,
    foreign_garbage,
    foreign_states,
    frozen_states,
    gripper_beside,
    killed_while_halted,
    late_from_the_start,
    late_states,
    limit_raised,
    long_wait,
    lost_states,
    named_twice,
    nan_once,
    nan_states,
    pauses,
    planner_silent,
    pose_taken_back,
    process_killed,
    process_paused,
    process_paused_emergency,
    recorder_silent,
    reordered_states,
    sensor_missing,
    short_silence,
    silence,
    somewhat_late,
    stopped_stamps,
    wrapped,
    wrapped_once,
)
from hostile_scene import Scene


@dataclass(frozen=True)
class Injection:
    """A kind: what is done, what the bridge has to do, and how often it is drawn.

    ``topic`` says whether the robot must, or must not, report its safety circuit.
    """

    act: Callable[[Scene], None]
    expected: str
    weight: float = 1.0
    topic: bool | None = None

    @property
    def name(self) -> str:
        """Its name in tables."""
        return self.act.__name__.replace('_', ' ')


INJECTIONS = (
    *(Injection(act, 'go on') for act in (control, planner_silent, recorder_silent)),
    *(Injection(act, 'go on') for act in (sensor_missing, lost_states, short_silence)),
    *(Injection(act, 'go on') for act in (a_little_late, command_doubled, pose_taken_back)),
    Injection(pauses, 'go on', 3.0),
    # Where the move before it was long, a person goes on after it.
    Injection(process_killed, 'any', 0.5),
    *(Injection(act, 'halt', 1.5) for act in (emergency, emergency_driver_silent)),
    *(Injection(act, 'halt') for act in (emergency_released, emergency_while_measuring)),
    *(Injection(act, 'halt') for act in (emergency_while_paused, process_paused_emergency)),
    Injection(killed_while_halted, 'halt', 0.5),
    *(Injection(act, 'halt') for act in (late_states, silence, wrapped, nan_states)),
    *(Injection(act, 'halt') for act in (frozen_states, stopped_stamps)),
    *(Injection(act, 'halt') for act in (foreign_states, foreign_garbage, foreign_commands)),
    *(Injection(act, 'halt') for act in (named_twice, another_robots_joints)),
    *(Injection(act, 'go on') for act in (gripper_beside, limit_raised)),
    Injection(late_from_the_start, 'any', 0.5),
    *(Injection(act, 'any') for act in (process_paused, somewhat_late, early_stamps)),
    *(Injection(act, 'any') for act in (clock_set_back, doubled_states, reordered_states)),
    *(Injection(act, 'any') for act in (wrapped_once, nan_once, commands_late, commands_lost)),
)
WITH_TOPIC = (
    Injection(emergency_topic, 'halt', 1.5, topic=True),
    Injection(emergency_topic_blinks, 'halt', topic=True),
    Injection(long_wait, 'go on', topic=True),
)
"""Where the bridge has an emergency_stop_topic."""
WITHOUT_TOPIC = (
    Injection(emergency_in_a_wait, 'any', 2.0, topic=False),
    Injection(emergency_while_braking, 'halt', 3.0, topic=False),
)
"""And where it has none."""
