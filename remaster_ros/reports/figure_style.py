# SPDX-License-Identifier: Apache-2.0
"""Style and common parts of all figures: colours, axes, legends, error histograms, SVG text.

Drawn on separate Matplotlib figures (no pyplot, no window, no shared state). Lines and text are in
marker colours that a page replaces by its own in the dark; data colours are readable on both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any, TypeVar

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes


INK, GRID, PAPER = '#1b1f25', '#d8dce1', '#fefefd'
BEFORE, AFTER = '#e07b39', '#3b82c4'
SENSOR_MARKERS = 'os^Dv'
FAINT = '#808a96'
WIDTH_IN = 8.4
SCATTER_POINTS = 1500
# Decades up to which labels at 1, 2 and 5 have room: the narrowest axis has some 250 pt, 1 and 2
# are 0.3 decades apart, and '0.002' with its gap takes 30 pt at 8 pt.
FEW_DECADES = 2.5
Drawn = TypeVar('Drawn')

STYLE: Any = {
    'svg.fonttype': 'none',
    # Wider than the fonts that pages use, so that text that fits in it is never cut off there.
    'font.family': 'sans-serif',
    'font.sans-serif': ['DejaVu Sans'],
    'font.size': 8.0,
    'axes.titlesize': 8.5,
    'axes.titleweight': 'bold',
    'axes.titlelocation': 'left',
    # Fixed, as nothing is above a panel: finding it would lay out the labels of the axis again.
    'axes.titley': 1.0,
    'axes.formatter.useoffset': False,
    'axes.labelsize': 8.0,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.edgecolor': INK,
    'axes.labelcolor': INK,
    'axes.facecolor': 'none',
    'axes.linewidth': 0.7,
    'axes.grid': True,
    'axes.axisbelow': True,
    # Names come from files: a dollar sign in them is no formula.
    'text.parse_math': False,
    'grid.color': GRID,
    'grid.linewidth': 0.6,
    'text.color': INK,
    'xtick.color': INK,
    'ytick.color': INK,
    'xtick.labelsize': 7.5,
    'ytick.labelsize': 7.5,
    'legend.frameon': False,
    'legend.fontsize': 7.5,
    'figure.facecolor': PAPER,
    'lines.linewidth': 0.6,
    # In points: a deviation smaller than the width of the line is invisible.
    'path.simplify_threshold': 0.5,
}


def as_figures(
    figures: Mapping[str, Callable[[Drawn], Figure]], subject: Drawn
) -> dict[str, Figure]:
    """Draw figures of a subject (fit, discovery or report) in the style of reports.

    ``figures``: function that draws each, by name. Returns them by the same names.
    """
    with matplotlib.rc_context(STYLE):
        return {name: draw(subject) for name, draw in figures.items()}


def as_svg(figures: dict[str, Callable[[Drawn], Figure]], subject: Drawn) -> dict[str, str]:
    """Draw figures of a subject (fit, discovery or report) as SVG text, by name.

    ``figures``: function that draws each. The same subject gives the same text.
    """
    texts = {}
    for name, draw in figures.items():
        # The salt makes the same result give the same file.
        with matplotlib.rc_context({**STYLE, 'svg.hashsalt': name}):
            out = StringIO()
            canvas = FigureCanvasSVG(draw(subject))
            canvas.print_svg(out, metadata={'Date': None, 'Creator': None})
        texts[name] = out.getvalue()
    return texts


def evenly(count: int, most: int) -> IntArray:
    """At most ``most`` of the numbers 0 to count - 1, evenly spaced, ascending, with both ends.

    [] for a count of 0; 0 alone if ``most`` is 1.
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def arm_lines(chain: SerialChain, q: FloatArray, offsets: FloatArray | None = None) -> FloatArray:
    """Return the points of arms drawn as lines: base, joints and tip, (n, k + 2, 3).

    In the robot base R, m. ``q``: n configurations, rad, m for slides, (n, k); ``offsets``:
    zero-offsets to add, (k,), or None.
    """
    joints = chain.frames(q, offsets)[..., :3, 3]
    tips = chain.forward(q, offsets)[:, None, :3, 3]
    return np.concatenate((np.zeros((len(q), 1, 3)), joints, tips), axis=1)


def error_histograms(ax: Axes, before: FloatArray, after: FloatArray) -> None:
    """Draw the distributions of 3-D errors before and after, mm, (n,) each, with their means.

    The axis is logarithmic and begins at the 0.2 % quantile of all errors (at least 1e-4 mm);
    smaller errors count in the first bin.
    """
    both = np.concatenate((before, after))
    floor = max(float(np.quantile(both, 0.002)), 1e-4)
    count = int(np.clip(3 * np.sqrt(len(before)), 8, 45))
    bins = np.geomspace(floor, max(float(both.max()), 2 * floor) * 1.001, count).tolist()
    for errors, color, when in ((before, BEFORE, 'before'), (after, AFTER, 'after')):
        mean = float(errors.mean())
        shown, label = np.maximum(errors, floor), f'{when}: mean {mean:.3f} mm'
        ax.hist(shown, bins=bins, color=color, alpha=0.5, histtype='stepfilled', label=label)
        ax.axvline(mean, color=color, linewidth=1.3)
    log_axis(ax, 'x')
    ax.set_xlabel('3-D error (mm); lines: means')
    ax.set_ylabel('observations')
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def legend_above(ax: Axes, handles: list[Line2D] | None = None) -> None:
    """Put the legend above the panel at the right, in one row; None: the panel's own entries."""
    shown: Sequence[Artist] = ax.get_legend_handles_labels()[0] if handles is None else handles
    ax.legend(
        handles=shown,
        loc='lower right',
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.1,
        ncols=len(shown),
        handletextpad=0.3,
        columnspacing=1.2,
    )


def legend_entry(marker: str, color: str, name: str) -> Line2D:
    """Entry of a legend for points of a marker and colour; a name over 20 characters is cut."""
    return Line2D(
        [],
        [],
        linestyle='',
        marker=marker,
        color=color,
        markersize=5,
        markeredgewidth=2.5 if marker == '_' else 0,
        label=name if len(name) <= 20 else name[:19] + '…',
    )


class _PlainLogLocator(LogLocator):
    """Ticks at 1, 2 and 5 of each decade; of many decades (`FEW_DECADES`) at 1 alone."""

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Tick positions for the limits of an axis."""
        few = vmin > 0.0 and vmax <= vmin * 10.0**FEW_DECADES
        self.set_params(subs=(1.0, 2.0, 5.0) if few else (1.0,))
        return super().tick_values(vmin, vmax)


def log_axis(ax: Axes, which: str) -> None:
    """Make an axis ('y', else x) logarithmic, labelled in plain numbers (`_PlainLogLocator`)."""
    axis = ax.yaxis if which == 'y' else ax.xaxis
    (ax.set_yscale if which == 'y' else ax.set_xscale)('log')
    axis.set_major_locator(_PlainLogLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axis.set_minor_formatter(NullFormatter())
