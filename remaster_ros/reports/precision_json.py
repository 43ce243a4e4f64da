"""What is known while a collection is under way, as JSON on ``remaster/precision``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from remaster_ros.collection.stopping_rule import Look, StoppingRule

FORMAT = 'remaster-precision/1'


def precision_json(rule: StoppingRule, looks: Sequence[Look]) -> str:
    """Return all looks so far, the newest last, in degrees, millimetres and minutes.

    Parameters
    ----------
    rule
        What they were judged by.
    looks
        At least one.
    """
    last, goal = looks[-1], rule.goal
    return json.dumps(
        {
            'format': FORMAT,
            'goal': {
                'joint_std_deg': _scaled(goal.joint_std_rad, np.degrees(1.0)),
                'tool_std_mm': _scaled(goal.tool_std_m, 1e3),
            },
            'planned_configurations': rule.planned,
            'enough': rule.is_enough(last),
            'message': rule.describe(last),
            'more': None
            if last.more is None
            else {'configurations': last.more, 'minutes': _scaled(last.more_s, 1.0 / 60.0)},
            'structure': [
                {
                    'driver': test.driver,
                    'between_poses': test.between_poses,
                    'p_value': test.p_value,
                    'message': test.words,
                }
                for test in last.structure
            ],
            'looks': [_look(look) for look in looks],
        },
        allow_nan=False,
    )


def _look(look: Look) -> dict[str, Any]:
    return {
        'configurations': look.configurations,
        'minutes': _scaled(look.elapsed_s, 1.0 / 60.0),
        'joint_std_deg': {
            name: _scaled(std, np.degrees(1.0)) for name, std in look.joint_std.items()
        },
        'joint_rms_deg': _scaled(look.joint_rms, np.degrees(1.0)),
        'tool_rms_mm': _scaled(look.tool_rms, 1e3),
        'degrees_of_freedom': look.freedom,
        'parameters': look.parameters,
    }


def _scaled(value: float | None, factor: float) -> float | None:
    """Return a value in another unit; None for what is not known."""
    return None if value is None or not np.isfinite(value) else float(value * factor)
