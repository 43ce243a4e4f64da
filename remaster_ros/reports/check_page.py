# SPDX-License-Identifier: Apache-2.0
"""Page of the checks of an arm: their results, and the trend of each joint."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from remaster_ros.reports.pages import inlined, page
from remaster_ros.session.files import write_atomically
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Trend = tuple[dict[str, Any], FloatArray, list[str]]


def write_check_page(
    path: Path,
    content: dict[str, Any],
    series_m: FloatArray,
    names: list[str],
) -> None:
    """Write the page of the checks of an arm to a file.

    Parameters
    ----------
    path
        The file; replaced if it exists.
    content
        Output of ``remaster check --json``.
    series_m
        Change of each joint in each check, at the tool, m, (T, k).
    names
        Names of the checks, oldest first.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    from remaster_ros.reports.figure_style import as_svg

    trend: Trend = content, series_m, names
    drawing = as_svg({'trend': _draw}, trend)['trend']
    html = page('check.html.jinja', check=content, names=names, trend=inlined('trend', drawing))
    write_atomically(path, html)


def _draw(trend: Trend) -> Figure:
    """Draw each joint's change over the checks, at the tool, mm.

    ``trend``: (output of ``remaster check --json``, changes, m, (T, k), names of the T checks), as
    for `write_check_page`. Only joints whose change could be detected have a panel.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    from remaster_ros.reports.figure_style import AFTER, BEFORE, WIDTH_IN

    content, x_m, names = trend
    shown = [i for i, joint in enumerate(content['joints']) if joint['detectable_mm'] is not None]
    figure = Figure(figsize=(WIDTH_IN, 1.25 * len(shown) + 0.4), layout='constrained')
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    numbers = np.arange(1, len(names) + 1)
    for ax, i in zip(axes, shown, strict=True):
        joint = content['joints'][i]
        is_it = joint['joint'] in content['changed']
        values = 1e3 * x_m[:, i]
        ax.axhspan(-content['smallest_mm'], content['smallest_mm'], color=AFTER, alpha=0.12, lw=0)
        ax.plot(numbers, values, 'o-', color=BEFORE if is_it else AFTER, ms=3.0, lw=0.8)
        if content['since_check'] is not None:
            ax.axvline(content['since_check'] - 0.5, color=BEFORE, lw=0.9, ls='--')
        ax.set_title(joint['joint'] + (': changed' if is_it else ''))
        ax.set_ylabel('mm')
        ax.margins(x=0.02)
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.supxlabel(
        'check; change at the tool against the baseline, shaded: what does not matter', fontsize=8
    )
    return figure
