"""What is kept of the references: readings, rounds of them, and what has changed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from remaster_ros.collection.pairing import PairedReading


@dataclass(frozen=True, kw_only=True)
class ReferenceReading(PairedReading):
    """A reading at a reference; `configuration` is the configuration's number in the session."""

    configuration: int


@dataclass(frozen=True)
class SetupChange:
    """What has changed.

    Attributes
    ----------
    kind
        ``sensor``, ``base``, ``marker``, ``tool``, ``joint``, or ``unexplained`` (no one cause) or
        ``unsteady`` (the references do not repeat from the first).
    subject
        For people.
    drifts
        Whether it grows with time; else it came at once.
    size_m
        Largest displacement of a marker at a reference.
    turn_rad
        Of the sensor, base, tool or joint; None where nothing turns.
    after, before
        Configurations that it happened between: the last one that was as at first (None where it
        was so from the first) and the first one that was not.
    p_value
        Of the round that showed it.
    look_alikes
        Other subjects that explain the same readings.
    """

    kind: str
    subject: str
    drifts: bool
    size_m: float
    turn_rad: float | None
    after: int | None
    before: int
    p_value: float
    look_alikes: tuple[str, ...] = ()

    def describe(self) -> str:
        """Return it in a sentence."""
        turn = ''
        if self.turn_rad is not None:
            turn = f' and turned by {np.rad2deg(self.turn_rad) * 60:.1f} arc minutes'
            if self.kind == 'joint':
                turn = f' ({np.rad2deg(self.turn_rad):.4f} degrees)'
        how = ', growing with time,' if self.drifts else ''
        since = f'between configurations {self.after} and {self.before}'
        if self.after is None:
            since = f'up to configuration {self.before}'
        alike = f'; it looks the same as: {", ".join(self.look_alikes)}' * bool(self.look_alikes)
        size = f'the references are off by up to {1e3 * self.size_m:.2f} mm{turn}'
        return f'{self.subject}{how} {since}: {size}{alike}'


@dataclass
class ReferenceRound:
    """Readings of one visit to the references, by reference and sensor."""

    rows: dict[tuple[int, str], ReferenceReading] = field(default_factory=dict)
    judged: bool = False
    alarmed: bool = False

    @property
    def configurations(self) -> list[int]:
        """Numbers in the session of what was measured."""
        return [row.configuration for row in self.rows.values()]
