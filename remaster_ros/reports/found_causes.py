# SPDX-License-Identifier: Apache-2.0
"""Causes of an earlier search that have look-alikes, for plans and for sessions that decide."""

from __future__ import annotations

import os
from collections.abc import Sequence

from remaster_ros.discovery.decision import Named
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.errors import InputError
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.reports.schemas import Discovered


def read_causes(
    path: str | os.PathLike[str],
    joint_names: Sequence[str] = (),
    observations_sha256: str = '',
) -> tuple[FoundCause, ...]:
    """Return the causes of a discovery.json that have look-alikes which poses can separate.

    Parameters
    ----------
    path
        The file.
    joint_names
        Joints that its arm must have; empty for any.
    observations_sha256
        Hash that its observations must have; '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, is of another arm or other observations, or has no cause with a
        look-alike.
    """
    found = _read(path, joint_names)
    found_sha256 = found.session and found.session.observations_sha256
    if observations_sha256 and found_sha256 != observations_sha256:
        raise InputError(
            f'{path} is not of the observations that the session has now; call /remaster/discover '
            'first'
        )
    causes = tuple(
        FoundCause(
            effect.name,
            effect.joints,
            {parameter.name: parameter.value for parameter in effect.parameters},
            tuple((other.name, other.joints, other.separate_by) for other in _separable(effect)),
            effect.driver,
        )
        for effect in found.effects
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
    """Pairs (cause, look-alike) of a discovery.json: those decided, then those still open.

    Parameters
    ----------
    path
        The file.
    joint_names
        Joints that its arm must have; empty for any.
    created
        Begin of its session; () is returned for another session. '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, or is of another arm.
    """
    found = _read(path, joint_names)
    if created and (not found.session or found.session.created != created):
        return ()
    pairs = [(decision.cause, decision.look_alike) for decision in found.decided or ()]
    pairs += [
        (Named(effect.name, effect.joints), Named(other.name, other.joints))
        for effect in found.effects
        for other in _separable(effect)
    ]
    return tuple(pairs)


def _read(path: str | os.PathLike[str], joint_names: Sequence[str]) -> Discovered:
    """Content of a discovery.json; no joint names stand for any arm.

    Raises InputError if it is no discovery.json or its arm has other joints.
    """
    found = read_discovery(path)
    names = found.robot.joint_names if found.robot else joint_names
    if joint_names and list(names) != list(joint_names):
        raise InputError(
            f'{path}: its causes are of an arm with the joints {", ".join(names)}, this one has '
            f'{", ".join(joint_names)}; give the discovery.json of this arm'
        )
    return found


def _separable(effect: FoundEffect) -> list[LookAlike]:
    """Return the look-alikes of an effect that further poses can separate from it.

    Left out are look-alikes that displace the marker exactly as the effect does (`same`), and free
    forms such as splines, of which the effect is one possible shape (`general`).
    """
    return [other for other in effect.confusable_with if not other.same and not other.general]
