"""Causes and their look-alikes from a discovery.json, to be separated and decided between."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from remaster_ros.discovery.decision import Named
from remaster_ros.errors import InputError
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.reports.discovery_json import read_discovery


def read_causes(
    path: str | os.PathLike[str],
    joint_names: Sequence[str] = (),
    observations_sha256: str = '',
) -> tuple[FoundCause, ...]:
    """Return the causes of a discovery.json that have look-alikes.

    Parameters
    ----------
    path
        The file.
    joint_names
        Of the arm that it has to be of; empty for any.
    observations_sha256
        Of the observations that it has to be of; '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, is of another arm or other observations, or has no cause with a
        look-alike.
    """
    found = _read(path, joint_names)
    of = found.get('session', {}).get('observations_sha256')
    if observations_sha256 and of != observations_sha256:
        raise InputError(
            f'{path} is not of the observations that the session has now; call /remaster/discover '
            'first'
        )
    causes = tuple(
        FoundCause(
            effect['name'],
            tuple(effect['joints']),
            {parameter['name']: parameter['value'] for parameter in effect['parameters']},
            tuple(
                (other['name'], tuple(other['joints']), other['separate_by'])
                for other in _separable(effect)
            ),
            effect['driver'],
        )
        for effect in found['effects']
        if _separable(effect)
    )
    if not causes:
        raise InputError(
            f'{path}: none of its causes has a look-alike (confusable_with) that can be '
            'separated from it; there is nothing to separate, plan without it'
        )
    return causes


def earlier_pairs(
    path: str | os.PathLike[str], joint_names: Sequence[str] = (), created: str = ''
) -> tuple[tuple[Named, Named], ...]:
    """Return causes and look-alikes of a discovery.json, and those that it has decided between.

    Parameters
    ----------
    path
        The file.
    joint_names
        Of the arm that it has to be of; empty for any.
    created
        When the session was begun that it has to be of; of another there are none. '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, or is of another arm.
    """
    found = _read(path, joint_names)
    if created and found.get('session', {}).get('created') != created:
        return ()
    pairs = [(_named(one['cause']), _named(one['look_alike'])) for one in found.get('decided', ())]
    pairs += [
        (_named(effect), _named(other))
        for effect in found['effects']
        for other in _separable(effect)
    ]
    return tuple(pairs)


def _read(path: str | os.PathLike[str], joint_names: Sequence[str]) -> dict[str, Any]:
    found = read_discovery(path)
    names = found.get('robot', {}).get('joint_names', joint_names)
    if joint_names and list(names) != list(joint_names):
        raise InputError(
            f'{path}: its causes are of an arm with the joints {", ".join(names)}, this one has '
            f'{", ".join(joint_names)}; give the discovery.json of this arm'
        )
    return found


def _named(cause: Mapping[str, Any]) -> Named:
    return Named(cause['name'], tuple(cause['joints']))


def _separable(effect: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the look-alikes of an effect that are neither another name nor a free form of it."""
    return [
        other
        for other in effect['confusable_with']
        if not other.get('same') and not other.get('general')
    ]
