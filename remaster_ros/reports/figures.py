"""The figures of a fit as SVG text: traces, posteriors, errors before and after.

Drawn on Matplotlib figures of their own (no pyplot, no window, no shared state). Lines and text
are in marker colours, so that a page can swap them for its own in the dark; data colours are
readable on both.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any, TypeVar

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from remaster_ros.calibration.predictive_accuracy import predicted_accuracy, tool_places
from remaster_ros.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from remaster_ros.calibration.result import FitResult

INK, GRID, PAPER = '#1b1f25', '#d8dce1', '#fefefd'
BEFORE, AFTER = '#e07b39', '#3b82c4'
CHAINS = ('#3b82c4', '#e07b39', '#2f9e78', '#b05fb5', '#b08a1e', '#d1495b', '#5f7d95', '#7a6ff0')
SENSOR_MARKERS = 'os^Dv'
FAINT = '#808a96'
WIDTH_IN = 8.4
TOOL_DRAWS = 400
MAP_POINTS, MAP_TILES = 4000, 22
TRACE_POINTS = 1500
SCATTER_POINTS = 1500
WHOLE_TURN_DEG = 359.999
Subject = TypeVar('Subject')

STYLE: Any = {
    'svg.fonttype': 'none',
    # Wider than the fonts that pages use: what fits in it is never cut off in them.
    'font.family': 'sans-serif',
    'font.sans-serif': ['DejaVu Sans'],
    'font.size': 8.0,
    'axes.titlesize': 8.5,
    'axes.titleweight': 'bold',
    'axes.titlelocation': 'left',
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
}


def draw_figures(result: FitResult) -> dict[str, str]:
    """Return every figure as SVG text, by file name without ending."""
    return as_svg(figures_of(result), result)


def figures_of(_: FitResult) -> dict[str, Callable[[FitResult], Figure]]:
    """Return what draws each figure of a fit, by file name without ending."""
    return {
        'posteriors': posteriors,
        'traces': traces,
        'errors': errors_by_configuration,
        'residuals': residual_distribution,
        'tool_places': tool_places_of_one,
        'accuracy_map': accuracy_map,
    }


def as_figures(
    figures: Mapping[str, Callable[[Subject], Figure]], subject: Subject
) -> dict[str, Figure]:
    """Draw figures of a fit or a discovery, by the same names."""
    with matplotlib.rc_context(STYLE):
        return {name: draw(subject) for name, draw in figures.items()}


def as_svg(figures: dict[str, Callable[[Subject], Figure]], subject: Subject) -> dict[str, str]:
    """Draw figures of a fit or a discovery and return them as SVG text, by the same names."""
    texts = {}
    for name, draw in figures.items():
        # The salt makes the same result give the same file.
        with matplotlib.rc_context({**STYLE, 'svg.hashsalt': name}):
            out = StringIO()
            canvas = FigureCanvasSVG(draw(subject))
            canvas.print_svg(out, metadata={'Date': None, 'Creator': None})
        texts[name] = out.getvalue()
    return texts


def shown_scale(result: FitResult) -> FloatArray:
    """Return degrees per rad, or mm per m where a joint slides, (k,)."""
    return np.where(result.chain.slides, 1e3, 180.0 / np.pi)


def posteriors(result: FitResult) -> Figure:
    """Draw the marginal posterior of each joint's offset with mean and 95 % interval (Fig. 4)."""
    figure, axes = _joint_panels(result, height_in=1.55)
    scale = shown_scale(result)
    draws = scale * result.joint_offset_draws
    for i, ax in enumerate(axes):
        sample = draws[..., i].ravel()
        if np.ptp(sample) == 0.0:
            _write_instead(ax, _short(result.why[i]))
            continue
        color = AFTER if result.identifiable[i] else BEFORE
        ax.hist(sample, bins=60, density=True, histtype='stepfilled', color=color, alpha=0.55)
        mean, std = scale[i] * result.joint_offsets[i], scale[i] * result.joint_offsets_std[i]
        low, high = scale[i] * result.joint_offsets_interval95[i]
        unit = ' mm' if result.chain.slides[i] else '°'
        text = 'not identifiable: where the chains wandered to'
        if high - low < WHOLE_TURN_DEG / (180.0 / np.pi) * scale[i] * result.chain.per_radian[i]:
            ax.axvspan(low, high, color=color, alpha=0.13, linewidth=0)
            ax.axvline(mean, color=color, linewidth=1.4)
            unseen = result.why[i].startswith('the data do not determine')
            source = 'prior alone: ' if unseen and not result.identifiable[i] else ''
            text = f'{source}{mean:+.4f}{unit} ± {std:.4f}{unit}'.replace('-', '\N{MINUS SIGN}')
        ax.set_title(text, loc='right', fontweight='normal')
        ax.set_yticks([])
        ax.spines['left'].set_visible(False)
        ax.grid(False)
        ax.xaxis.set_major_locator(MaxNLocator(5))
    units = 'degrees; mm of a joint that slides' if result.chain.slides.any() else 'degrees'
    figure.supxlabel(f'zero-offset ({units}); line: mean, shaded: 95 % interval', fontsize=8)
    return figure


def traces(result: FitResult) -> Figure:
    """Draw the chains of each joint's offset from their first state (Fig. 3)."""
    figure, axes = _joint_panels(result, height_in=1.35)
    chains, records = result.trace.shape[:2]
    step = max(1, -(-records // TRACE_POINTS))
    x = np.arange(0, records, step)
    columns = {name: i for i, name in enumerate(result.parameter_names)}
    for i, (joint, ax) in enumerate(zip(result.joint_names, axes, strict=True)):
        if joint not in columns:
            _write_instead(ax, _short(result.why[i]))
            continue
        values = shown_scale(result)[i] * result.trace[:, ::step, columns[joint]]
        for chain in range(chains):
            color = CHAINS[chain % len(CHAINS)]
            ax.plot(x, values[chain], color=color, alpha=0.8, label=f'chain {chain + 1}')
        if not result.identifiable[i]:
            ax.set_title('not identifiable', loc='right', fontweight='normal')
        ax.set_ylabel('mm' if result.chain.slides[i] else 'degrees')
        ax.margins(x=0.01)
        ax.yaxis.set_major_locator(MaxNLocator(4))
    if sampled := [ax for ax in axes if ax.lines]:
        handles, labels = sampled[0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc='outside upper right', ncols=min(chains, 8))
        for line in legend.get_lines():
            line.set_linewidth(2.0)
    figure.supxlabel('recorded state of the chain, from its start', fontsize=8)
    return figure


def errors_by_configuration(result: FitResult) -> Figure:
    """Draw the error of every row before and after, by configuration and sensor."""
    m = result.session.measurements
    before, after = _norms_mm(result)
    splits = _splits(result)
    figure, axes = _stacked(len(splits), height_in=2.5)
    for ax, (title, rows) in zip(axes, splits, strict=True):
        chosen = np.flatnonzero(rows)
        note = ''
        if len(chosen) > SCATTER_POINTS:
            picked = np.linspace(0, len(chosen) - 1, SCATTER_POINTS).round().astype(int)
            note = f', {SCATTER_POINTS} of {len(chosen)} rows shown'
            chosen = chosen[picked]
        legend = [legend_entry('_', BEFORE, 'before'), legend_entry('_', AFTER, 'after')]
        for sensor, name in enumerate(result.session.sensor_names):
            mine = chosen[m.sensor[chosen] == sensor]
            if not len(mine):
                continue
            marker = SENSOR_MARKERS[sensor % len(SENSOR_MARKERS)]
            for errors, color in ((before, BEFORE), (after, AFTER)):
                ax.plot(
                    m.configuration[mine],
                    errors[mine],
                    marker,
                    color=color,
                    markersize=3.2,
                    markeredgewidth=0,
                    alpha=0.85,
                )
            legend.append(legend_entry(marker, INK, name))
        log_axis(ax, 'y')
        ax.set_title(f'{title}{note}')
        ax.set_ylabel('3-D error (mm)')
        ax.set_xlabel('joint configuration, in the order measured')
        ax.margins(x=0.01)
        legend_above(ax, legend)
    return figure


def residual_distribution(result: FitResult) -> Figure:
    """Draw how large the errors are with and without the offsets."""
    before, after = _norms_mm(result)
    splits = _splits(result)
    figure, axes = _stacked(len(splits), height_in=2.1)
    for ax, (title, rows) in zip(axes, splits, strict=True):
        error_histograms(ax, before[rows], after[rows])
        ax.set_title(title)
        legend_above(ax)
    return figure


def tool_places_of_one(result: FitResult) -> Figure:
    """Draw where the marker may be at one configuration, from three sides (Fig. 5)."""
    m = result.session.measurements
    lengths = np.linalg.norm(result.residuals_before, axis=1)
    fitted = np.flatnonzero(~m.is_validation)
    # The one whose error before is the median.
    row = int(fitted[np.argsort(lengths[fitted])[len(fitted) // 2]])
    places = tool_places(result.predictive, m, row, TOOL_DRAWS, np.random.default_rng(0))
    before, after, drawn, noisy = (1e3 * (place - places.after) for place in places)
    figure = Figure(figsize=(WIDTH_IN, 3.2), layout='constrained')
    for ax, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        ax.plot(*noisy[:, [i, j]].T, '.', color=FAINT, markersize=2.0, alpha=0.5)
        ax.plot(*drawn[:, [i, j]].T, '.', color=AFTER, markersize=2.0, alpha=0.5)
        ax.plot(after[i], after[j], '+', color=INK, markersize=8, markeredgewidth=1.4)
        ax.plot(before[i], before[j], 'x', color=BEFORE, markersize=7, markeredgewidth=2.0)
        ax.set_xlabel(f'{"xyz"[i]} (mm)')
        ax.set_ylabel(f'{"xyz"[j]} (mm)')
        ax.set_aspect('equal', adjustable='datalim')
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.yaxis.set_major_locator(MaxNLocator(5))
    handles = [
        legend_entry('x', BEFORE, 'offsets at zero'),
        legend_entry('+', INK, 'offsets estimated'),
        legend_entry('.', AFTER, 'offsets drawn'),
        legend_entry('.', FAINT, '… and noise'),
    ]
    for handle in handles[:2]:
        handle.set_markeredgewidth(1.6)
    figure.legend(handles=handles, loc='outside upper right', ncols=len(handles))
    configuration = int(m.configuration[row])
    sensor = result.session.sensor_names[m.sensor[row]]
    figure.suptitle(f'configuration {configuration}, {sensor}', fontsize=8, ha='left', x=0.01)
    return figure


def accuracy_map(result: FitResult) -> Figure:
    """Draw the predicted error over the workspace: from the side and from above."""
    m = result.session.measurements
    found = predicted_accuracy(result.predictive, m, MAP_POINTS, np.random.default_rng(0))
    error_mm = 1e3 * found.error
    # A marker of the cell that nothing measured has no row.
    known = {**result.session.markers, **result.marker_positions}
    markers = np.array([known[name] for name in result.session.marker_names])
    measured = result.chain.positions(m.q, markers[m.marker], result.joint_offsets)
    figure = Figure(figsize=(WIDTH_IN, 4.0), layout='constrained')
    views: tuple[tuple[str, str, Callable[[FloatArray], FloatArray]], ...] = (
        (
            'distance from the axis of the base (m)',
            'height (m)',
            lambda p: np.column_stack((np.hypot(p[:, 0], p[:, 1]), p[:, 2])),
        ),
        ('x (m)', 'y (m)', lambda p: p[:, :2]),
    )
    low, high = np.quantile(error_mm, (0.02, 0.98))
    for ax, (across, up, seen) in zip(figure.subplots(1, 2), views, strict=True):
        places = seen(found.place)
        across_tiles, up_tiles = MAP_TILES * np.ptp(places, axis=0) / np.ptp(found.place[:, 0])
        tiles = ax.hexbin(
            *places.T,
            C=error_mm,
            reduce_C_function=np.mean,
            # Hexagons with sides of one length, in both views.
            gridsize=(max(1, round(across_tiles)), max(1, round(up_tiles / np.sqrt(3.0)))),
            cmap='viridis',
            vmin=low,
            vmax=high,
            linewidths=0.1,
        )
        ax.plot(*seen(measured).T, '.', color=BEFORE, markersize=2.5)
        ax.set_xlabel(across)
        ax.set_ylabel(up)
        ax.set_aspect('equal')
        ax.grid(False)
    bar = figure.colorbar(tiles, ax=figure.axes, label='predicted error (mm)', shrink=0.85)
    # Drawn as a picture it would be the only one of a page that is not lines.
    if bar.solids is not None:
        bar.solids.set(rasterized=False, edgecolor='face')
    return figure


def error_histograms(ax: Axes, before: FloatArray, after: FloatArray) -> None:
    """Draw the distributions of 3-D errors before and after, mm, with their means."""
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


def _joint_panels(result: FitResult, height_in: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with one titled panel per joint, two in a row."""
    joints = result.joint_names
    rows = -(-len(joints) // 2)
    figure = Figure(figsize=(WIDTH_IN, height_in * rows + 0.5), layout='constrained')
    grid = figure.subplots(rows, 2, squeeze=False)
    axes = list(grid.flat)
    for spare in axes[len(joints) :]:
        spare.set_visible(False)
    for joint, ax in zip(joints, axes, strict=False):
        ax.set_title(joint)
    return figure, axes[: len(joints)]


def _stacked(count: int, height_in: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTH_IN, height_in * count + 0.2), layout='constrained')
    return figure, list(figure.subplots(count, 1, squeeze=False).flat)


def legend_above(ax: Axes, handles: list[Line2D] | None = None) -> None:
    """Put the legend at the right above the panel, in one row."""
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
    """Return the entry of a legend for points of a marker and colour; a long name is cut."""
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


def _write_instead(ax: Axes, text: str) -> None:
    """Write a text in a panel instead of a drawing."""
    ax.set_axis_off()
    lines = textwrap.fill(text, 58)
    ax.text(0.0, 0.8, lines, transform=ax.transAxes, va='top', linespacing=1.4)


def _short(why: str) -> str:
    """Return the reason up to the remedy, which the page gives in full."""
    reason = why.split(';')[0]
    return f'Not identifiable: {reason}.'


def log_axis(ax: Axes, which: str) -> None:
    """Make an axis logarithmic, labelled in plain numbers at 1, 2 and 5."""
    axis = ax.yaxis if which == 'y' else ax.xaxis
    (ax.set_yscale if which == 'y' else ax.set_xscale)('log')
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axis.set_minor_formatter(NullFormatter())


def _norms_mm(result: FitResult) -> tuple[FloatArray, FloatArray]:
    """Return the 3-D error of every row before and after, mm, never quite zero."""
    before, after = (
        np.maximum(1e3 * np.linalg.norm(residuals, axis=1), 1e-6)
        for residuals in (result.residuals_before, result.residuals_after)
    )
    return before, after


def _splits(result: FitResult) -> list[tuple[str, BoolArray]]:
    """Return title and rows of the splits that have any; gross errors are not among the fitted."""
    m = result.session.measurements
    left_out = np.isin(m.observation, [observation for observation, _ in result.left_out])
    splits = [
        ('Validation poses (never fitted)', m.is_validation),
        ('Optimization poses (fitted)', ~m.is_validation & ~left_out),
    ]
    return [(title, rows) for title, rows in splits if rows.any()]
