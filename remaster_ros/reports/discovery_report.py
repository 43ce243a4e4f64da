"""report.html of a discovery: one self-contained page that a technician can read."""

from __future__ import annotations

from pathlib import Path

import msgspec

from remaster_ros.discovery.confirmation import Confirmation, in_words
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.reports.discovery_apply import load_words
from remaster_ros.reports.discovery_figures import draw_discovery
from remaster_ros.reports.discovery_schema import Discovered
from remaster_ros.reports.pages import inlined, page, write_report

# Long lists of spline coefficients are for other programs; the figure shows the curve.
MOST_PARAMETERS = 8


def write_discovery_report(
    discovery: Discovery,
    confirmation: Confirmation | None,
    content: Discovered,
    folder: Path,
) -> Path:
    """Write report.html and the figures of what was found; return its path.

    Parameters
    ----------
    discovery, confirmation
        What was found.
    content
        The same as discovery.json has it.
    folder
        Where to; made if missing.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    drawings = draw_discovery(discovery)
    html = page(
        'discovery.html.jinja',
        found=msgspec.to_builtins(content),
        session=discovery.fit.session,
        equations={name: effect.equation for name, effect in EFFECTS.items()},
        sources={name: effect.source for name, effect in EFFECTS.items()},
        most_parameters=MOST_PARAMETERS,
        confirmed=in_words(discovery, confirmation) if confirmation else (),
        to_load=[(row, *load_words(row)) for row in content.loadable or ()],
        drawings={name: inlined(name, text) for name, text in drawings.items()},
    )
    return write_report(folder, drawings, html)
