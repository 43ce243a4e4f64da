"""The state of the optimizer: whether what was measured so far is enough."""

from __future__ import annotations

from typing import ClassVar

from remaster_ros.collection.event_body import Body


class OptimizerState(Body, frozen=True, kw_only=True, tag='optimizer'):
    """State of the optimizer.

    Attributes
    ----------
    plan
        The plan whose session it has looked at, '' for none.
    enough
        Whether the precision that the cell file states is reached: no more poses to fit are
        visited then.
    precision
        What is known, and what more would cost, as text.
    """

    sender: ClassVar[str] = 'optimizer'
    plan: str
    enough: bool
    precision: str = ''
