"""What the live page takes of a fit, and of what is known while a session is measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from remaster_ros.types import FloatArray


class Look(msgspec.Struct, frozen=True):
    """Of `precision_json`: what was known after so many configurations."""

    configurations: int
    minutes: float | None
    joint_std_deg: dict[str, float | None]


class Precision(msgspec.Struct, frozen=True):
    """What the page shows of `precision_json`."""

    message: str = ''
    looks: list[Look] = []


@dataclass(frozen=True)
class PlanPage:
    """Where the page of a plan is served.

    Attributes
    ----------
    plan
        Fingerprint of the plan.
    address
        Below that of the live page; '' where it is not served.
    trouble
        Why it is not; ''.
    """

    plan: str = ''
    address: str = ''
    trouble: str = ''


@dataclass(frozen=True)
class FitFacts:
    """What is known of a fit beside its offsets.

    Attributes
    ----------
    shown
        Label -> text.
    unidentifiable
        Joints whose offset is not to be believed.
    markers
        Where the markers were found, in the tool frame, m, (3,).
    """

    shown: Mapping[str, str] = field(default_factory=dict)
    unidentifiable: frozenset[str] = frozenset()
    markers: Mapping[str, FloatArray] = field(default_factory=dict)
