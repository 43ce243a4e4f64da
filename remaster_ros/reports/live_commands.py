"""What a person may ask for on the live page now, and why not; it is for the eye alone."""

from __future__ import annotations

from typing import Any

STOP_LABEL = 'Stop the collection'
STOP_NOTE = (
    'No emergency stop: it asks the planner over the network. In danger use the red button.'
)


def commands(
    *,
    state: str,
    silent: bool,
    halted: bool,
    begun: bool,
    measured: bool,
    unconfirmed: bool,
    confirmation: dict[str, Any] | None,
) -> dict[str, dict[str, Any]]:
    """Return what each command is called, whether it is of use now, and a note.

    Parameters
    ----------
    state
        Of the planner.
    silent
        Whether the planner was not heard for long.
    halted
        Whether the arm is halted.
    begun, measured
        Whether something was visited, and recorded.
    unconfirmed
        Whether the arm waits until a plan is confirmed.
    confirmation
        Which plan that is (`LiveView`); None as long as it is not shown.
    """
    plan = confirmation['plan'] if confirmation else ''
    why = 'the planner is silent' if silent else ''
    if not why and halted:
        why = 'the arm is halted'
    if not why and state not in ('idle', 'paused', 'stopped'):
        why = f'the collection is {state[:100]}'
    if not why and unconfirmed:
        why = f'plan {plan} is not confirmed' if plan else 'the plan is not shown yet'
    idle = state not in ('running', 'held')
    ready = bool(confirmation and confirmation['address'] and confirmation['offered'])
    return {
        'collect': {
            'label': 'Go on' if begun else 'Begin the collection',
            'on': not why,
            'note': why or 'the arm moves',
        },
        'pause': {'label': 'Pause', 'on': not silent and not idle, 'note': ''},
        'stop': {'label': STOP_LABEL, 'on': True, 'note': STOP_NOTE},
        'fit': {'label': 'Fit', 'on': idle and measured, 'note': ''},
        'confirm': {
            'label': f'Confirm plan {plan}',
            'on': ready and unconfirmed and idle and not silent,
            'note': 'Nothing moves before you begin the collection or go on.',
        },
    }
