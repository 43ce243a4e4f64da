"""Read what bags of versions before `collection.events` hold in its place: pairs of text.

There the nodes published states and events as key/value pairs on ``remaster/status``: a state
under the node's name, an event as ``node: event``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from remaster_ros.collection.events import EventRecord

_STATES = {'pose_planner': 'planner', 'robot_bridge': 'bridge', 'recorder': 'recorder'}
_FLAGS = 'ready', 'last', 'registered', 'stops'
_NEVER_USED = 'decided', 'changed_run'
"""A planner alone reads these, and no planner runs on a bag."""


def record_of(name: str, message: str, pairs: Mapping[str, str]) -> EventRecord | None:
    """Return the record that a status of an old bag stands for; None where it is none.

    Parameters
    ----------
    name, message, pairs
        Of the ``DiagnosticStatus``.
    """
    try:
        return msgspec.convert(_content(name, message, pairs), EventRecord, strict=False)
    except (msgspec.ValidationError, ValueError):
        return None


def _content(name: str, message: str, pairs: Mapping[str, str]) -> dict[str, Any]:
    node, is_event, event = name.partition(': ')
    values: dict[str, Any] = {key: pairs[key] for key in pairs if key not in _NEVER_USED}
    values.update({key: pairs[key] == 'yes' for key in _FLAGS if key in pairs})
    if is_event:
        words = {'reason': message, 'text': message, 'description': message}
        # The first version had no numbers of its own for the solutions.
        ids = pairs.get('ids', ' '.join(map(str, range(int(pairs.get('solutions', 0))))))
        values = {**words, **values, 'kind': event, 'ids': ids.split()}
    elif 'sensor' in pairs:
        values.update(kind='sensor', message=message, hidden=pairs.get('fault') == 'marker')
    else:
        state = {'halted': '', 'waiting_for': '', 'run': ''}
        values = {**state, **values, 'kind': _STATES.get(node, 'alive')}
    return {
        'node': pairs.get('node', f'/{node}'),
        'started': pairs.get('started', ''),
        'uptime_s': pairs.get('uptime_s', 0.0),
        'body': values,
    }
