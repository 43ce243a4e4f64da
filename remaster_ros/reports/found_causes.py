"""Causes and their look-alikes from a discovery.json, for a plan that separates them."""

from __future__ import annotations

import os

from remaster_ros.errors import InputError
from remaster_ros.planning.separating_design import FoundCause
from remaster_ros.reports.discovery_json import read_discovery


def read_causes(path: str | os.PathLike[str]) -> tuple[FoundCause, ...]:
    """Return the causes of a discovery.json that have look-alikes.

    Raises
    ------
    InputError
        It is no discovery.json, or has no cause with a look-alike.
    """
    causes = tuple(
        FoundCause(
            effect['name'],
            tuple(effect['joints']),
            {parameter['name']: parameter['value'] for parameter in effect['parameters']},
            tuple(
                (other['name'], tuple(other['joints']), other['separate_by'])
                for other in effect['confusable_with']
            ),
        )
        for effect in read_discovery(path)['effects']
        if effect['confusable_with']
    )
    if not causes:
        raise InputError(
            f'{path}: none of its causes has a look-alike (confusable_with); there is nothing to '
            'separate, plan without it'
        )
    return causes
