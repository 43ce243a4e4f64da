# SPDX-License-Identifier: Apache-2.0
"""Page of a discovery, with its figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from remaster_ros.reports.discovery_figures import draw_discovery
from remaster_ros.reports.pages import inlined, page, write_report
from remaster_ros.reports.schemas import Discovered
from remaster_ros.reports.sentences import MOST_PARAMETERS, load_words
from remaster_ros.types import Session

if TYPE_CHECKING:
    from remaster_ros.discovery.discover import Discovery


def write_discovery_report(discovery: Discovery, content: Discovered, folder: Path) -> Path:
    """Write a discovery's report.html with its figures; return the path of report.html.

    ``folder``: made if missing. Raises DiskError if it cannot be written to.
    """
    drawings = draw_discovery(discovery)
    html = discovery_html(content, discovery.fit.session, drawings)
    return write_report(folder, drawings, html)


def discovery_html(content: Discovered, session: Session, drawings: dict[str, str]) -> str:
    """Return the text of a discovery's page.

    ``drawings``: SVG text by name, of `draw_discovery`.
    """
    return page(
        'discovery.html.jinja',
        found=msgspec.to_builtins(content),
        session=session,
        most_parameters=MOST_PARAMETERS,
        to_load=[(row, *load_words(row)) for row in content.loadable or ()],
        drawings={name: inlined(name, text) for name, text in drawings.items()},
    )
