# SPDX-License-Identifier: Apache-2.0
"""Precision reached during a collection, as JSON on ``remaster/precision``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from remaster_ros.collection.stopping_rule import Look, StoppingRule

FORMAT = 'remaster-precision/1'


class Known(Struct):
    """Precision of a fit after a number of configurations; None for what is unknown."""

    configurations: int
    minutes: float | None
    joint_std_deg: dict[str, float | None]
    joint_rms_deg: float | None = None
    tool_rms_mm: float | None = None
    degrees_of_freedom: int = 0
    parameters: int = 0
    joint_std_mm: dict[str, float | None] = {}  # Prismatic joints, which are not in `…_deg`


class Precision(Struct):
    """Message on /remaster/precision: precision at all looks so far, newest last, and the goal.

    In degrees, millimetres and minutes.
    """

    format: str = FORMAT
    goal: dict[str, float | None] = {}
    planned_configurations: int = 0
    enough: bool = False
    message: str = ''
    more: dict[str, float | None] | None = None
    structure: list[dict[str, Any]] = []
    looks: list[Known] = []


def precision_json(rule: StoppingRule, looks: Sequence[Look]) -> str:
    """Return the JSON of `Precision`: all looks, and what the stopping rule says of the newest.

    ``looks``: at least one, newest last. Unknown values are null.
    """
    last, goal = looks[-1], rule.goal
    found = Precision(
        goal={
            'joint_std_deg': _scaled(goal.joint_std_rad, np.degrees(1.0)),
            'tool_std_mm': _scaled(goal.tool_std_m, 1e3),
        },
        planned_configurations=rule.planned,
        enough=rule.is_enough(last),
        message=rule.describe(last),
        more=None
        if last.more is None
        else {'configurations': last.more, 'minutes': _scaled(last.more_s, 1.0 / 60.0)},
        structure=[
            {
                'driver': test.driver,
                'between_poses': test.between_poses,
                'p_value': test.p_value,
                'message': test.words(),
            }
            for test in last.structure
        ],
        looks=[
            Known(
                look.configurations,
                _scaled(look.elapsed_s, 1.0 / 60.0),
                {
                    name: _scaled(std, np.degrees(1.0))
                    for name, std in look.joint_std.items()
                    if name not in look.sliding
                },
                _scaled(look.joint_rms, np.degrees(1.0)),
                _scaled(look.tool_rms, 1e3),
                look.freedom,
                look.parameters,
                {name: _scaled(look.joint_std.get(name), 1e3) for name in look.sliding},
            )
            for look in looks
        ],
    )
    return msgspec.json.encode(found).decode()


def _scaled(value: float | None, factor: float) -> float | None:
    """Value times a factor; None if it is None or not finite."""
    return None if value is None or not np.isfinite(value) else float(value * factor)
