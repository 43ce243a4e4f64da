# SPDX-License-Identifier: Apache-2.0
"""What results show of themselves in Python: a short table, a report's first screen, figures."""

from __future__ import annotations

import html
import os
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.discover import Discovery
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from remaster_ros.reports.schemas import Discovered

# In px; what is longer is scrolled.
SCREEN_HEIGHT = 620


class Fit(FitResult):
    """Result of `fit`: printed as a short table, in a notebook the first screen of its report."""

    @classmethod
    def of(cls, result: FitResult) -> Fit:
        """Return a `FitResult` as a `Fit`, with the same fields."""
        return cls(**{field.name: getattr(result, field.name) for field in fields(result)})

    @cached_property
    def joint_offsets_std_shown(self) -> FloatArray:
        """Standard deviations of the offsets if link lengths may differ from the drawing, (k,).

        rad or m, as reports show them. ``joint_offsets_std``, in contrast, assumes that all link
        lengths and joint axes are exactly those of the URDF.
        """
        from remaster_ros.reports.loadable import uncertainty

        return uncertainty(self).std

    def __repr__(self) -> str:
        from remaster_ros.reports.fit_json import fit_content
        from remaster_ros.reports.result_lines import fit_lines

        return '\n'.join(fit_lines(fit_content(self)))

    def _repr_html_(self) -> str:
        """First screen of the report of this fit, as HTML."""
        from remaster_ros.reports.fit_page import fit_html

        return _first_screen(fit_html(self, {}))

    def figures(self) -> dict[str, Figure]:
        """Return the plots of the report (matplotlib figures) by name; no file is written."""
        from remaster_ros.reports.figure_style import as_figures
        from remaster_ros.reports.fit_figures import fit_figures

        return as_figures(fit_figures(self), self)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write what ``remaster fit --out`` writes into a folder, with the files for the robot.

        Returns
        -------
        Path
            The report.

        Raises
        ------
        InputError
            The folder cannot be written to, or holds what this would replace.
        """
        from remaster_ros.reports.fit_json import FIT_FILE
        from remaster_ros.reports.result_folder import prepare_folder, save_fit

        prepare_folder(folder, FIT_FILE)
        return save_fit(self, folder)


class Found(Discovery):
    """Result of `discover`: printed as a short table, in a notebook its report's first screen."""

    @classmethod
    def of(cls, found: Discovery) -> Found:
        """Return a `Discovery` as a `Found`, with the same fields."""
        return cls(**{field.name: getattr(found, field.name) for field in fields(found)})

    def __repr__(self) -> str:
        from remaster_ros.reports.result_lines import discovery_lines

        return '\n'.join(discovery_lines(self._content))

    def _repr_html_(self) -> str:
        """First screen of the report of this search, as HTML."""
        from remaster_ros.reports.discovery_page import discovery_html

        return _first_screen(discovery_html(self._content, self.fit.session, {}))

    @cached_property
    def _content(self) -> Discovered:
        """Content of discovery.json, computed once."""
        from remaster_ros.reports.discovery_json import discovery_content

        return discovery_content(self)

    def figures(self) -> dict[str, Figure]:
        """Return the plots of the report (matplotlib figures) by name; no file is written."""
        from remaster_ros.reports.discovery_figures import discovery_figures
        from remaster_ros.reports.figure_style import as_figures

        return as_figures(discovery_figures(self), self)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write what ``remaster discover --out`` writes to a folder; return the report's path.

        Raises InputError as `Fit.save`.
        """
        from remaster_ros.reports.fit_json import DISCOVERY_FILE
        from remaster_ros.reports.result_folder import prepare_folder, save_discovery

        prepare_folder(folder, DISCOVERY_FILE)
        return save_discovery(self, folder)


def _first_screen(page: str) -> str:
    """Return an HTML page up to its contents list, in an iframe that keeps its style to itself."""
    screen = page.partition('<nav>')[0] + '<p class="soft">Files: save(folder).</p>'
    return (
        f'<iframe srcdoc="{html.escape(screen)}" title="first screen of the report" '
        f'style="width:100%;height:{SCREEN_HEIGHT}px;border:0"></iframe>'
    )
