"""The law behind an effect of discovery.json."""

from __future__ import annotations

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.unnamed import EFFECT as NO_NAME
from remaster_ros.reports.discovery_schema import Effect


def law(effect: Effect) -> str:
    """Return equation and source of an effect; one without a name has those of its form."""
    happened = effect.name == NO_NAME.name and effect.moment_s is not None
    kind = EFFECTS.get('step' if happened else effect.name)
    return '' if kind is None else f'{kind.equation} ({kind.source})'
