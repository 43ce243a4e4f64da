# SPDX-License-Identifier: Apache-2.0
"""Figures of a fit, of causes and of the answer, as SVG text.

Drawn on separate Matplotlib figures (no pyplot, no window, no shared state). Lines and text are in
marker colours that a page replaces by its own in the dark; data colours are readable on both.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from remaster_ros.calibration.predictive_accuracy import predicted_accuracy, tool_places
from remaster_ros.discovery.effects.drivers import driver_named
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.loadable import uncertainty
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.discovery.effects.base import Candidate
    from remaster_ros.discovery.effects.context import Context
    from remaster_ros.discovery.explain import FoundEffect
    from remaster_ros.reports.answer import Answer, Inputs


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


def draw_fit(result: FitResult) -> dict[str, str]:
    """All figures of a fit as SVG text, by file name without ending."""
    return as_svg(fit_figures(result), result)


def fit_figures(_: FitResult) -> dict[str, Callable[[FitResult], Figure]]:
    """Function that draws each figure of a fit, by file name without ending; the fit is unused."""
    return {
        'posteriors': posteriors,
        'traces': traces,
        'errors': errors_by_configuration,
        'residuals': residual_distribution,
        'tool_places': tool_places_of_one,
        'accuracy_map': accuracy_map,
    }


def as_figures(
    figures: Mapping[str, Callable[[Drawn], Figure]], subject: Drawn
) -> dict[str, Figure]:
    """Figures of a subject (fit, discovery or report), drawn in the style of reports, by name."""
    with matplotlib.rc_context(STYLE):
        return {name: draw(subject) for name, draw in figures.items()}


def as_svg(figures: dict[str, Callable[[Drawn], Figure]], subject: Drawn) -> dict[str, str]:
    """Figures of a subject (fit, discovery or report) as SVG text, by name.

    The same subject gives the same text.
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

    [] for a count of 0.
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def arm_lines(chain: SerialChain, q: FloatArray, offsets: FloatArray | None = None) -> FloatArray:
    """Base, joints and tip of arms at n configurations (n, k), in R, m, (n, k + 2, 3).

    ``q``: rad, m for slides; ``offsets``: zero-offsets to add, (k,), or None.
    """
    joints = chain.frames(q, offsets)[..., :3, 3]
    tips = chain.forward(q, offsets)[:, None, :3, 3]
    return np.concatenate((np.zeros((len(q), 1, 3)), joints, tips), axis=1)


def posteriors(result: FitResult) -> Figure:
    """Draw the marginal posterior of each joint's offset with mean and 95 % interval (Fig. 4)."""
    figure, axes = _joint_panels(result, 1.55, left=0.1, top=0.3)
    scale = result.chain.shown_scale
    draws, shown = scale * result.joint_offset_draws, uncertainty(result)
    for i, ax in enumerate(axes):
        sample = draws[..., i].ravel()
        if np.ptp(sample) == 0.0:
            _write_instead(ax, _short(result.why[i]))
            continue
        color = AFTER if result.identifiable[i] else BEFORE
        ax.hist(sample, bins=60, density=True, histtype='stepfilled', color=color, alpha=0.55)
        mean, std = scale[i] * result.joint_offsets[i], scale[i] * shown.std[i]
        low, high = scale[i] * shown.interval95[i]
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
    figure, axes = _joint_panels(result, 1.35, left=0.8, top=0.5)
    chains, records = result.trace.shape[:2]
    step = max(1, -(-records // TRACE_POINTS))
    x = np.arange(0, records, step)
    columns = {name: i for i, name in enumerate(result.parameter_names)}
    for i, (joint, ax) in enumerate(zip(result.joint_names, axes, strict=True)):
        if joint not in columns:
            _write_instead(ax, _short(result.why[i]))
            continue
        values = result.chain.shown_scale[i] * result.trace[:, ::step, columns[joint]]
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
        legend = figure.legend(handles, labels, loc='upper right', ncols=min(chains, 8))
        for line in legend.get_lines():
            line.set_linewidth(2.0)
    figure.supxlabel('recorded state of the chain, from its start', fontsize=8)
    return figure


def errors_by_configuration(result: FitResult) -> Figure:
    """Draw the error of each row before and after, by configuration and sensor."""
    m = result.session.measurements
    before, after = _norms_mm(result)
    splits = _splits(result)
    figure, axes = _stacked(len(splits), 2.5)
    for ax, (title, rows) in zip(axes, splits, strict=True):
        chosen = np.flatnonzero(rows)
        note = ''
        if len(chosen) > SCATTER_POINTS:
            note = f', {SCATTER_POINTS} of {len(chosen)} rows shown'
            chosen = chosen[evenly(len(chosen), SCATTER_POINTS)]
        legend = [legend_entry('_', BEFORE, 'before'), legend_entry('_', AFTER, 'after')]
        for sensor, name in enumerate(result.session.sensor_names):
            selection = chosen[m.sensor[chosen] == sensor]
            if not len(selection):
                continue
            marker = SENSOR_MARKERS[sensor % len(SENSOR_MARKERS)]
            for errors, color in ((before, BEFORE), (after, AFTER)):
                ax.plot(
                    m.configuration[selection],
                    errors[selection],
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
    """Draw the distribution of the errors with and without the offsets."""
    before, after = _norms_mm(result)
    splits = _splits(result)
    figure, axes = _stacked(len(splits), 2.1)
    for ax, (title, rows) in zip(axes, splits, strict=True):
        error_histograms(ax, before[rows], after[rows])
        ax.set_title(title)
        legend_above(ax)
    return figure


def tool_places_of_one(result: FitResult) -> Figure:
    """Draw possible positions of the marker at one configuration, in three views (Fig. 5)."""
    m = result.measurements
    lengths = np.linalg.norm(result.residuals_before, axis=1)
    fitted = np.flatnonzero(~m.is_validation)
    # The row whose error before is the median.
    row = int(fitted[np.argsort(lengths[fitted])[len(fitted) // 2]])
    places = tool_places(result.predictive, m, row, TOOL_DRAWS, np.random.default_rng(0))
    before, after, drawn, noisy = (1e3 * (place - places.after) for place in places)
    figure, axes = _panels(3.2, (1, 3), left=0.65, bottom=0.5, top=0.4)
    for ax, (i, j) in zip(axes, ((0, 1), (0, 2), (1, 2)), strict=True):
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
    figure.legend(handles=handles, loc='upper right', ncols=len(handles))
    configuration = int(m.configuration[row])
    sensor = list(result.T_R_N)[m.sensor[row]]
    figure.suptitle(f'configuration {configuration}, {sensor}', fontsize=8, ha='left', x=0.01)
    return figure


def accuracy_map(result: FitResult) -> Figure:
    """Draw the predicted error over the workspace, from the side and from above."""
    m = result.measurements
    found = predicted_accuracy(result.predictive, m, MAP_POINTS, np.random.default_rng(0))
    error_mm = 1e3 * found.error
    markers = np.array(list(result.marker_positions.values()))
    measured = result.chain.positions(m.q, markers[m.marker], result.joint_offsets)
    figure, axes = _panels(4.0, (1, 2), left=0.65, bottom=0.5, top=0.15, right=1.0)
    views: tuple[tuple[str, str, Callable[[FloatArray], FloatArray]], ...] = (
        (
            'distance from the axis of the base (m)',
            'height (m)',
            lambda p: np.column_stack((np.hypot(p[:, 0], p[:, 1]), p[:, 2])),
        ),
        ('x (m)', 'y (m)', lambda p: p[:, :2]),
    )
    low, high = np.quantile(error_mm, (0.02, 0.98))
    for ax, (across, up, seen) in zip(axes, views, strict=True):
        places = seen(found.place)
        across_tiles, up_tiles = MAP_TILES * np.ptp(places, axis=0) / np.ptp(found.place[:, 0])
        tiles = ax.hexbin(
            places[:, 0],
            places[:, 1],
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
    colorbar_axes = figure.add_axes((1.0 - 0.85 / WIDTH_IN, 0.2, 0.15 / WIDTH_IN, 0.7))
    bar = figure.colorbar(tiles, cax=colorbar_axes, label='predicted error (mm)')
    # Drawn as a picture it would be the only one of a page that is not lines.
    if bar.solids is not None:
        bar.solids.set(rasterized=False, edgecolor='face')
    return figure


def error_histograms(ax: Axes, before: FloatArray, after: FloatArray) -> None:
    """Draw the distributions of 3-D errors before and after, mm, (n,) each, with their means.

    The axis is logarithmic; errors below the 0.2 % quantile are drawn there.
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


def _panels(
    height_in: float,
    shape: tuple[int, int],
    *,
    left: float,
    bottom: float,
    top: float,
    right: float = 0.1,
    down: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Figure of panels (rows, columns), with margins and the space below a panel, inches.

    They are fixed, as finding them takes longer than drawing the figure.
    """
    rows, columns = shape
    across = left + 0.1
    width = (WIDTH_IN - left - right - (columns - 1) * across) / columns
    height = (height_in - top - bottom - (rows - 1) * down) / rows
    figure = Figure(figsize=(WIDTH_IN, height_in))
    figure.subplots_adjust(
        left=left / WIDTH_IN,
        right=1.0 - right / WIDTH_IN,
        bottom=bottom / height_in,
        top=1.0 - top / height_in,
        wspace=across / width,
        hspace=down / height,
    )
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def _joint_panels(
    result: FitResult, height_in: float, left: float, top: float
) -> tuple[Figure, list[Axes]]:
    """Figure with a titled panel for each joint, two in a row, and the k panels.

    ``height_in``: of a row, inches; ``left``, ``top``: margins, inches.
    """
    joints = result.joint_names
    rows = -(-len(joints) // 2)
    figure, axes = _panels(
        height_in * rows + 0.5, (rows, 2), left=left, bottom=0.55, top=top, right=0.25, down=0.5
    )
    for spare in axes[len(joints) :]:
        spare.set_visible(False)
    for joint, ax in zip(joints, axes, strict=False):
        ax.set_title(joint)
    return figure, axes[: len(joints)]


def _stacked(count: int, height_in: float) -> tuple[Figure, list[Axes]]:
    """Figure of `count` panels one below the other, each `height_in` inches high, and its axes."""
    return _panels(height_in * count + 0.2, (count, 1), left=0.65, bottom=0.5, top=0.3, down=0.8)


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


def _write_instead(ax: Axes, text: str) -> None:
    """Write a text in a panel in place of a drawing."""
    ax.set_axis_off()
    lines = textwrap.fill(text, 50)
    ax.text(0.0, 0.8, lines, transform=ax.transAxes, va='top', linespacing=1.4)


def _short(why: str) -> str:
    """Sentence 'Not identifiable: …' with the reason up to its first ';', before the remedy."""
    reason = why.split(';')[0]
    return f'Not identifiable: {reason}.'


def log_axis(ax: Axes, which: str) -> None:
    """Make an axis ('y', else x) logarithmic, labelled in plain numbers at 1, 2 and 5."""
    axis = ax.yaxis if which == 'y' else ax.xaxis
    (ax.set_yscale if which == 'y' else ax.set_xscale)('log')
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axis.set_minor_formatter(NullFormatter())


def _norms_mm(result: FitResult) -> tuple[FloatArray, FloatArray]:
    """3-D error of each row before and after, mm, at least 1e-6."""
    before, after = map(lengths_mm, (result.residuals_before, result.residuals_after))
    return np.maximum(before, 1e-6), np.maximum(after, 1e-6)


def _splits(result: FitResult) -> list[tuple[str, BoolArray]]:
    """Title and mask (n,) of the splits that have rows, held-out ones first.

    Gross errors are not among the fitted rows.
    """
    m = result.session.measurements
    left_out = np.isin(m.observation, [observation for observation, _ in result.left_out])
    splits = [
        ('Validation poses (never fitted)', m.is_validation),
        ('Optimization poses (fitted)', ~m.is_validation & ~left_out),
    ]
    return [(title, rows) for title, rows in splits if rows.any()]


# Figures of a discovery: errors by driver, causes with their bands, the gain.

ARC_MINUTE = np.radians(1.0 / 60.0)
BINS = 12
CAUSE_POINTS = 800
MOST_CAUSES = 8
# In a larger session curves are drawn at the searched rows only.
MOST_DRAWN = 20_000
# Distance from the last measured value, in knots, at which a curve's line ends.
NEAR = 0.5
# Largest gap between measurements, as a share of the range, across which a wave is drawn.
WIDE_GAP = 1.0 / 30.0
# Largest gap across which any other curve is drawn.
EMPTY = 1.0 / 8.0
# A part of the range that is no wider counts as a single place.
PLACE = 0.01


def draw_discovery(discovery: Discovery) -> dict[str, str]:
    """All figures of a discovery as SVG text, by file name without ending."""
    return as_svg(discovery_figures(discovery), discovery)


def discovery_figures(discovery: Discovery) -> dict[str, Callable[[Discovery], Figure]]:
    """Function that draws each figure of a discovery, by file name without ending.

    'causes' only if there are any.
    """
    figures: dict[str, Callable[[Discovery], Figure]] = {'gain': gain, 'drivers': drivers}
    if discovery.groups:
        figures['causes'] = causes
    return figures


def gain(discovery: Discovery) -> Figure:
    """Draw the errors before and after, and the noise that the readings of a pose share."""
    figure = Figure(figsize=(WIDTH_IN, 2.6), layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    data = discovery.residuals
    held_out = data.context.measurements.is_validation
    rows = held_out if held_out.any() else np.isin(np.arange(len(held_out)), data.rows.source)
    errors = discovery.residuals_before, discovery.fit.residuals_after
    lengths = [lengths_mm(error[rows]) for error in errors]
    error_histograms(left, *(np.maximum(values, 1e-4) for values in lengths))
    left.set_title('Held-out poses' if held_out.any() else 'Fitted poses')
    legend_above(left)

    model = data.noise_model
    fits = discovery.empty, discovery.solution
    noises = [model.sensor_noise(fit.noise) for fit in fits]
    # Where a sensor has one reading at every pose, what they share is not known.
    separable = {model.channels[index].sensor for index in model.separable}
    labels, values = [], []
    for sensor, name in enumerate(data.context.sensor_names):
        within = [np.hypot(noise.sigma, noise.frame_sigma)[sensor] for noise in noises]
        if sensor in separable:
            labels += [f'{name[:20]}, shared', f'{name[:20]}, within']
            values += [[noise.pose_sigma[sensor] for noise in noises], within]
        else:
            labels.append(name[:20])
            values.append(within)
    y = np.arange(len(values))
    for column, (color, label) in enumerate(((BEFORE, 'before'), (AFTER, 'after'))):
        noise_mm = 1e3 * np.array(values)[:, column]
        right.barh(y + 0.36 * column - 0.18, noise_mm, 0.34, color=color, label=label)
    right.set_yticks(y.tolist(), labels)
    right.invert_yaxis()
    right.grid(False, axis='y')
    right.set_xlabel('RMS per axis (mm)')
    right.set_title('Shared by a pose, and within' if separable else 'Errors of a reading')
    return figure


def drivers(discovery: Discovery) -> Figure:
    """Draw the errors along each joint's motion against each driver, before and after.

    A row of panels for each driver that the session has (own angle, gravity, last move, time,
    temperature), a column for each joint.
    """
    data = discovery.residuals
    context = data.part
    shown = context.chain.shown_scale
    angle, torque, move = 'angle (°)', 'torque (N m)', '(°)'
    if context.chain.slides.any():
        angle, torque, move = 'angle (°) or place (mm)', 'torque (N m) or force (N)', '(°, mm)'
    candidates: list[tuple[bool, str, Callable[[int], FloatArray]]] = [
        (True, f'own {angle}', lambda j: shown[j] * context.measurements.q[:, j]),
        (context.has_gravity, f'gravity {torque}', lambda j: context.gravity_torque[:, j]),
        (context.has_approach, f'last move {move}', lambda j: shown[j] * context.last_move[:, j]),
        (context.has_time, 'time (h)', lambda j: context.elapsed_s / 3600.0),
        (context.has_temperature, 'temperature (K)', lambda j: context.warming),
    ]
    kept = [(label, value) for known, label, value in candidates if known]
    joints = context.joints
    height = 1.05 * len(kept) + 0.6
    figure = Figure(figsize=(WIDTH_IN, height))
    # Fixed margins: to find them for so many panels takes longer than to draw them.
    axes = figure.subplots(len(kept), joints, squeeze=False, sharey=True)
    figure.subplots_adjust(
        left=0.07,
        right=0.985,
        bottom=0.4 / height,
        top=1.0 - 0.38 / height,
        hspace=0.7,
        wspace=0.1,
    )
    motion = context.jacobian
    length = np.maximum(np.linalg.norm(motion, axis=1), 1e-6)
    fits = [(discovery.empty, BEFORE, 'before')]
    if discovery.groups:
        fits.append((discovery.solution, AFTER, 'after'))
    for fit, color, _ in fits:
        residuals = data.left(fit)
        along = 1e3 * np.einsum('nij,ni->nj', motion, residuals) / length
        for row, (_, value) in enumerate(kept):
            for joint in range(joints):
                _binned(axes[row, joint], value(joint), along[:, joint], color)
    for row, (label, _) in enumerate(kept):
        for joint in range(joints):
            ax = axes[row, joint]
            ax.tick_params(labelsize=5.5, length=2)
            # Labels at the very ends would touch those of the next panel.
            ax.xaxis.set_major_locator(MaxNLocator(4, prune='both'))
            if ax.has_data():
                ax.axhline(0.0, color=INK, linewidth=0.5)
            else:
                ax.set_xticks([])
                ax.text(0.5, 0.5, 'constant', transform=ax.transAxes, ha='center', fontsize=5.5)
            if row == 0:
                ax.set_title(f'joint {joint + 1}', fontsize=7.5)
        axes[row, joints // 2].set_xlabel(label, fontsize=7)
    figure.supylabel('mean error along the motion of the joint (mm)', fontsize=7.5)
    handles = [Line2D([], [], color=color, marker='.', label=label) for _, color, label in fits]
    figure.legend(handles=handles, loc='upper right', ncols=2, fontsize=7, frameon=False)
    return figure


def _binned(ax: Axes, x: FloatArray, y: FloatArray, color: str) -> None:
    """Draw means of y with their standard errors in bins of equal counts of x, (n,) each.

    Nothing if x spans less than 0.001. Parts with a gap of over an eighth of the range (`EMPTY`)
    are separate lines.
    """
    if np.ptp(x) < 1e-3:
        return
    order = np.argsort(x)
    # No bin, and no line from bin to bin, across what was not measured.
    for part in np.split(order, np.flatnonzero(np.diff(x[order]) > EMPTY * np.ptp(x)) + 1):
        bins = max(1, min(round(BINS * len(part) / len(x)), len(part) // 8))
        groups = np.array_split(part, bins)
        centers = [float(x[g].mean()) for g in groups]
        means = [float(y[g].mean()) for g in groups]
        spread = [float(y[g].std() / np.sqrt(len(g))) for g in groups]
        ax.errorbar(
            centers, means, spread, color=color, linewidth=0.9, elinewidth=0.6, marker='.', ms=3
        )


def causes(discovery: Discovery) -> Figure:
    """Draw each cause of a joint, or of a moment: residuals without it, and the fit with its band.

    At most 16 panels (twice `MOST_CAUSES`). The sizes of all other causes are in one panel.
    """
    panels = [
        candidate
        for group in discovery.groups
        for candidate in group
        if candidate.place == 'joint_angle' or (candidate.happened and candidate.changes is None)
    ]
    constant = [
        effect
        for effect, group in zip(discovery.effects, discovery.groups, strict=False)
        if not any(candidate in panels for candidate in group)
    ]
    panels = panels[: 2 * MOST_CAUSES]
    count = len(panels) + bool(constant)
    lines = -(-count // 2)
    figure = Figure(figsize=(WIDTH_IN, 2.2 * lines + 0.2), layout='constrained')
    axes = list(figure.subplots(lines, 2 if count > 1 else 1, squeeze=False).flat)
    for candidate, ax in zip(panels, axes, strict=False):
        (_cause if candidate.place == 'joint_angle' else _step)(ax, discovery, candidate)
    if constant:
        _sizes(axes[len(panels)], discovery, constant)
    for spare in axes[count:]:
        spare.set_visible(False)
    return figure


def _sizes(ax: Axes, discovery: Discovery, effects: Sequence[FoundEffect]) -> None:
    """Draw the sizes of the causes without a curve, RMS at the marker, mm, and the noise."""
    sizes = [1e3 * effect.size_m for effect in effects]
    noise = 1e3 * discovery.gain.noise_floor_m
    y = np.arange(len(sizes) + 1)
    ax.barh(y[:-1], sizes, color=AFTER, height=0.4)
    ax.barh(y[-1:], [noise], color=GRID, edgecolor=INK, linewidth=0.5, height=0.4)
    names = [textwrap.fill(effect.title, 26) for effect in effects]
    ax.set_yticks(y.tolist(), [*names, 'noise alone'])
    # Few bars are no thicker than many.
    ax.set_ylim(max(len(y), 4) - 0.5, -0.7)
    ax.grid(False, axis='y')
    ax.set_xlabel('RMS at the marker (mm)')
    ax.set_title('Causes without a curve')


def _estimate(discovery: Discovery, candidate: Candidate) -> FloatArray:
    """Parameters (p,) of a cause in the whole model, perhaps those of a larger candidate."""
    solution = discovery.solution
    names = [name for member in solution.candidates for name in member.parameters]
    return solution.parameters[[names.index(name) for name in candidate.parameters]]


def _step(ax: Axes, discovery: Discovery, candidate: Candidate) -> None:
    """Draw a jump of a sensor, marker or base over time, along its direction, mm."""
    data, solution = discovery.residuals, discovery.solution
    context = data.part
    columns = candidate.columns(context).displacement(context)
    jump = columns @ _estimate(discovery, candidate)
    moved = np.linalg.norm(jump, axis=1) > 0.0
    # Before the moment all columns are zero: the rows that move later have the sensor and marker.
    affected = np.isin(context.sensor, context.sensor[moved]) & np.isin(
        context.marker, context.marker[moved]
    )
    way = jump[moved].mean(axis=0)
    way /= np.linalg.norm(way)
    along = 1e3 * (data.left(solution) + jump) @ way
    minutes = context.elapsed_s / 60.0
    ax.plot(minutes[affected], along[affected], '.', color=BEFORE, markersize=3, alpha=0.6)
    index = {name: i for i, name in enumerate(discovery.fit.theta_names)}
    draws = discovery.fit.theta_draws.reshape(-1, len(index))
    chosen = draws[:, [index[name] for name in candidate.parameters]]
    levels = 1e3 * np.einsum('nij,i->nj', columns[moved], way).mean(axis=0) @ chosen.T
    edge = candidate.moment / 60.0
    low, high = minutes[affected].min(), minutes[affected].max()
    ax.plot([low, edge], [0.0, 0.0], color=AFTER, linewidth=1.3)
    level, width = float(levels.mean()), 2.0 * float(levels.std())
    ax.fill_between([edge, high], level - width, level + width, color=AFTER, alpha=0.25)
    ax.plot([edge, high], [level, level], color=AFTER, linewidth=1.3)
    ax.axvline(edge, color=INK, linewidth=0.8, ls=(0, (4, 2)))
    ax.set_xlabel('minutes after the first reading')
    ax.set_ylabel('along the jump (mm)')
    ax.set_title(f'{candidate.subject or "base"}: jump after {edge:.1f} min')


def _driver(
    context: Context, candidate: Candidate, features: FloatArray
) -> tuple[str, FloatArray, float]:
    """Label and values (n,) of a cause's driver, and the driver's value for one shown unit.

    A driver of several numbers is drawn by the feature of the cause's first parameter, features
    being (n, p).
    """
    driver = driver_named(context, candidate.driver, candidate.joints[-1])
    if driver is None:
        name = candidate.driver.replace('_', ' ')
        return f'{name} (per unit of {candidate.parameters[0]})', features[:, 0], 1.0
    unit = f' ({driver.shown_unit})' if driver.shown_unit else ''
    return f'{driver.label}{unit}', driver.value(context), driver.per_shown


def _cause(ax: Axes, discovery: Discovery, candidate: Candidate) -> None:
    """Draw one cause at a joint's angle, in arc minutes, or in mm for a prismatic joint.

    Points are residuals without the cause; the line is the posterior mean, the band ± 2 standard
    deviations. A change is drawn only where it is present.
    """
    data, solution = discovery.residuals, discovery.solution
    all_rows = len(data.context) <= MOST_DRAWN
    context = data.context if all_rows else data.part
    remaining = data.unexplained(solution) if all_rows else data.left(solution)
    # A change is drawn at the rows after its moment, or before if it ends there.
    present = np.ones(len(context), dtype=bool)
    if candidate.changes is not None:
        present = (context.elapsed_s > candidate.moment) != candidate.ends
    fitted = present.copy()
    if all_rows:
        fitted &= np.isin(np.arange(len(context)), data.rows.source)
    shown_unit_value, unit = (
        (1e-3, 'mm') if context.slides(candidate.joints[0]) else (ARC_MINUTE, 'arc minutes')
    )
    parameters = _estimate(discovery, candidate) / shown_unit_value
    index = {name: i for i, name in enumerate(discovery.fit.theta_names)}
    chosen = [index[name] for name in candidate.parameters]
    draws = discovery.fit.theta_draws[..., chosen].reshape(-1, len(chosen)) / shown_unit_value
    mean = draws.mean(axis=0)
    draws = draws[:: max(1, len(draws) // 400)]
    columns = candidate.columns(context)
    assert columns.at is not None
    values = columns.values
    label, x, per_shown = _driver(context, candidate, values)
    if candidate.form == 'sin/cos':
        # Its mean is a zero-offset.
        values = values - values[fitted].mean(axis=0)
    effect = values @ mean
    motion = context.jacobian[:, :, columns.at]
    # What is left, as an angle of this joint: only where the marker is far from its axis.
    square = np.sum(motion**2, axis=1)
    far = fitted & (square > 0.1 * np.median(square))
    angle = np.sum(motion * remaining, axis=1)[far] / square[far] / shown_unit_value
    shown = slice(None, None, max(1, int(far.sum()) // CAUSE_POINTS))
    points = (values[far] @ parameters + angle)[shown]
    if candidate.driver.startswith('approach'):
        band = 2.0 * (values @ draws.T).std(axis=1)
        _sides(ax, x[present], effect[present], band[present], (x[far][shown], points))
    else:
        order = np.flatnonzero(present)[np.argsort(x[present])]
        at, line = x[order], effect[order]
        if candidate.curve is not None:
            # Everywhere, so that the band opens where nothing was measured; the line is not there.
            x, at = candidate.curve.in_turn(x), candidate.curve.grid()
            values = candidate.curve.columns(at)
            line = np.where(candidate.curve.seen(at, NEAR), values @ mean, np.nan)
        else:
            values = values[order]
            # No straight line where nothing was measured.
            widest = WIDE_GAP if candidate.form == 'sin/cos' else EMPTY
            gap = np.diff(at, prepend=at[0]) > widest * np.ptp(at)
            line = np.where(gap, np.nan, line)
        spread = 2.0 * (values @ draws.T).std(axis=1)
        middle = values @ mean
        if candidate.curve is None:
            # Nor a straight band: a curve's own is known everywhere.
            holes = np.flatnonzero(gap)
            _at_places(ax, at / per_shown, middle, spread, holes)
            around = np.insert(at, holes, at[holes])
            middle, spread = (np.insert(v, holes, np.nan) for v in (middle, spread))
        else:
            around = at
        ax.plot(x[far][shown] / per_shown, points, '.', color=BEFORE, markersize=2.5, alpha=0.6)
        low, high = middle - spread, middle + spread
        ax.fill_between(around / per_shown, low, high, color=AFTER, alpha=0.25, linewidth=0)
        # What jumps has no slope between two readings.
        jumps = candidate.happened and candidate.changes is None
        drawn = 'steps-mid' if jumps else 'default'
        ax.plot(at / per_shown, line, color=AFTER, linewidth=1.3, drawstyle=drawn)
    limit = np.quantile(np.abs(points), 0.99)
    ax.set_ylim(-1.2 * limit, 1.2 * limit)
    ax.set_xlabel(label)
    ax.set_ylabel(unit)
    slipped = candidate.happened and candidate.changes is None
    name = 'slip' if slipped else candidate.name.replace('_', ' ')
    if candidate.changes is not None:
        minutes = f'{candidate.moment / 60.0:.1f} min'
        name += f', until {minutes}' if candidate.ends else f', from {minutes} on'
    ax.set_title(f'joint {candidate.joints[0]}: {name}')


def _at_places(
    ax: Axes, at: FloatArray, middle: FloatArray, spread: FloatArray, holes: IntArray
) -> None:
    """Draw an estimate and its band where a joint stood only at single places, such as a rail.

    ``at``: driver of the rows, sorted, in parts that begin at ``holes``. Draws nothing if any part
    is wide enough for a line and a band.
    """
    parts = np.split(np.arange(len(at)), holes)
    if any(np.ptp(at[part]) > PLACE * np.ptp(at) for part in parts):
        return
    for first in (part[0] for part in parts):
        x, y, band = at[first], middle[first], spread[first]
        ax.errorbar(x, y, band, fmt='_', color=AFTER, markersize=14, elinewidth=4, alpha=0.6)


def _sides(
    ax: Axes,
    x: FloatArray,
    effect: FloatArray,
    band: FloatArray,
    shown: tuple[FloatArray, FloatArray],
) -> None:
    """Draw a step at x = -1 and 1: points spread out, and the level of each side, ± ``band``.

    ``shown``: places and values of the points.
    """
    places, points = shown
    spread_out = places + 0.3 * np.linspace(-1.0, 1.0, len(places))
    ax.plot(spread_out, points, '.', color=BEFORE, markersize=2.5, alpha=0.6)
    for side in (-1.0, 1.0):
        if np.any(x == side):
            level, width = float(effect[x == side][0]), float(band[x == side][0])
            span = [side - 0.4, side + 0.4]
            ax.fill_between(span, level - width, level + width, color=AFTER, alpha=0.25)
            ax.plot(span, [level, level], color=AFTER, linewidth=1.3)
    ax.set_xticks([-1.0, 1.0], ['from above', 'from below'])


# Figures of `remaster report`: errors by stage, over the session, and over the workspace.

MODEL, ALL_CAUSES = '#8a6fc4', '#2f9e78'
# Narrower than the figures of many panels: to be read on a phone.
NARROW_IN = 5.2
ARMS = 4
LETTERS = 'ABCDEFGHIJKLMNOPQRSTUVWXYZ'


class Subject(NamedTuple):
    """Data that the figures of a report show."""

    inputs: Inputs
    answer: Answer
    chain: SerialChain


def draw_answer(subject: Subject) -> dict[str, str]:
    """All figures of a report as SVG text, by name without ending: stages, session, workspace.

    'plan' as well if the session has a plan.
    """
    figures: dict[str, Callable[[Subject], Figure]] = {
        'session': over_session,
        'workspace': workspace,
    }
    if subject.inputs.plan is not None:
        figures['plan'] = planned
    return draw_stages(subject.answer) | as_svg(figures, subject)


def draw_stages(answer: Answer) -> dict[str, str]:
    """Figure of the errors by stage as SVG text, by its name 'stages'."""
    return as_svg({'stages': stages}, answer)


def stages(answer: Answer) -> Figure:
    """Draw the errors of the judged rows at each stage, with mean and 95 % quantile."""
    shown = answer.stages
    figure = Figure(figsize=(NARROW_IN, 0.62 * len(shown) + 0.75), layout='constrained')
    ax = figure.subplots()
    colors = (BEFORE, AFTER, *((MODEL,) if len(shown) > 3 else ()), ALL_CAUSES)
    for row, (stage, color) in enumerate(zip(shown, colors, strict=False)):
        errors = np.maximum(np.sort(stage.errors), 1e-4)
        errors = errors[evenly(len(errors), SCATTER_POINTS)]
        # Spread out evenly and without chance, so that no two figures of a session differ.
        height = row + 0.22 * np.sin(2.399963 * np.arange(len(errors)))
        ax.plot(errors, height, '.', color=color, markersize=3.0, alpha=0.55, markeredgewidth=0)
        ax.plot(2 * [stage.mean], [row - 0.36, row + 0.36], color=color, linewidth=2.2)
        ax.plot(
            2 * [stage.most], [row - 0.3, row + 0.3], color=color, linewidth=1.0, ls=(0, (2, 1))
        )
    if noise := [row.reading_mm for row in answer.noise if row.reading_mm > 0.0]:
        low, high = min(noise), max(noise)
        ax.axvspan(low / 1.01, high * 1.01, color=FAINT, alpha=0.35, linewidth=0)
    log_axis(ax, 'x')
    ax.set_yticks(range(len(shown)), [_two_lines(stage.title) for stage in shown])
    ax.set_ylim(len(shown) - 0.45, -0.55)
    ax.grid(False, axis='y')
    ax.spines['left'].set_visible(False)
    ax.tick_params(axis='y', length=0)
    ax.set_xlabel('3-D error of the marker (mm)')
    entries = [
        Line2D([], [], color=INK, linewidth=2.2, label='mean'),
        Line2D([], [], color=INK, linewidth=1.0, ls=(0, (2, 1)), label='95 %'),
    ]
    if answer.noise:
        entries.append(Line2D([], [], color=FAINT, alpha=0.5, linewidth=5, label='sensor noise'))
    figure.legend(handles=entries, loc='outside upper right', ncols=3)
    return figure


def over_session(subject: Subject) -> Figure:
    """Draw the error of each row in the order measured, today and after the action."""
    inputs, answer = subject.inputs, subject.answer
    m = inputs.session.measurements
    timed = inputs.session.timed
    x = (m.stamp_s - m.stamp_s.min()) / 60.0 if timed else m.configuration.astype(float)
    figure = Figure(figsize=(WIDTH_IN, 2.5), layout='constrained')
    ax = figure.subplots()
    shown = evenly(len(m), SCATTER_POINTS)
    entries = [legend_entry('_', BEFORE, 'today'), legend_entry('_', AFTER, 'after')]
    for sensor, name in enumerate(inputs.session.sensor_names):
        selection = shown[m.sensor[shown] == sensor]
        if not len(selection):
            continue
        marker = SENSOR_MARKERS[sensor % len(SENSOR_MARKERS)]
        for errors, color in ((inputs.before_mm, BEFORE), (answer.final_mm, AFTER)):
            for held_out in (False, True):
                rows = selection[m.is_validation[selection] == held_out]
                ax.plot(
                    x[rows],
                    np.maximum(errors[rows], 1e-4),
                    marker,
                    color=color,
                    markersize=3.2,
                    markerfacecolor=color if held_out else 'none',
                    markeredgewidth=0.7,
                    alpha=0.85,
                )
        entries.append(legend_entry(marker, INK, name))
    _mark_moments(ax, subject)
    log_axis(ax, 'y')
    ax.set_ylabel('3-D error (mm)')
    ax.set_xlabel('minutes after the first reading' if timed else 'joint configuration')
    ax.margins(x=0.01)
    figure.legend(handles=entries, loc='outside upper right', ncols=len(entries))
    return figure


def _mark_moments(ax: Axes, subject: Subject) -> None:
    """Mark the moments of causes that came at once by dashed lines with their titles."""
    found = subject.inputs.found
    for effect in found.effects if found is not None else ():
        if effect.moment_s is None:
            continue
        at = effect.moment_s / 60.0
        ax.axvline(at, color=INK, linewidth=1.0, ls=(0, (4, 2)))
        low, high = ax.get_xlim()
        left = at > 0.5 * (low + high)
        ax.annotate(
            effect.title,
            (at, 1.0),
            xycoords=('data', 'axes fraction'),
            xytext=(-4 if left else 4, 3),
            textcoords='offset points',
            ha='right' if left else 'left',
            fontweight='bold',
        )


def workspace(subject: Subject) -> Figure:
    """Draw the markers' positions from above and from the side, coloured by remaining error.

    At most 1,500 rows (`SCATTER_POINTS`) and 4 arms (`ARMS`), evenly spread.
    """
    inputs, chain = subject.inputs, subject.chain
    m = inputs.session.measurements
    frames = inputs.T_R_N
    # A sensor that has measured nothing has no place, and no rows either.
    T_R_N = np.array([frames.get(name, np.eye(4)) for name in inputs.session.sensor_names])
    shown = evenly(len(m), SCATTER_POINTS)
    points = apply(T_R_N[m.sensor[shown]], m.position[shown])
    errors = subject.answer.final_mm[shown]
    order = np.argsort(errors)
    rows = inputs.fit.joint_offsets
    offsets = np.array([row.mean_and_std[0] if row.identifiable else 0.0 for row in rows])
    arms = arm_lines(chain, m.q[evenly(len(m), ARMS)], offsets)
    everything = np.concatenate((points, arms.reshape(-1, 3)))
    figure = Figure(figsize=(WIDTH_IN, 4.0), layout=_with_room())
    top = float(np.quantile(errors, 0.98))
    axes = two_views(figure, everything, frames)
    for ax, (a, b) in axes:
        for arm in arms:
            ax.plot(arm[:, a], arm[:, b], color=FAINT, linewidth=2.0, alpha=0.6)
            ax.plot(arm[:, a], arm[:, b], 'o', color=FAINT, markersize=3, alpha=0.6)
        dots = ax.scatter(
            points[order, a],
            points[order, b],
            c=errors[order],
            s=11,
            cmap='plasma_r',
            vmin=0.0,
            vmax=top,
            linewidths=0.3,
            edgecolors=INK,
        )
    bar = figure.colorbar(dots, ax=[ax for ax, _ in axes], shrink=0.85, pad=0.02, extend='max')
    bar.set_label('error after (mm)')
    bar.outline.set_linewidth(0.5)
    entries = sensor_entries(frames)
    figure.legend(handles=entries, loc='outside lower center', ncols=3, handletextpad=0.2)
    return figure


def planned(subject: Subject) -> Figure:
    """Draw planned tool positions from above and from the side, and how they ended.

    The session has to have a plan. A pose is 'not measured' if none of its solutions was recorded.
    """
    from remaster_ros.planning.tour_order import FITTED, REFERENCE

    plan, chain = subject.inputs.plan, subject.chain
    assert plan is not None
    missing = 'not measured'
    # Marker, colour and words.
    shown_as = {
        FITTED: ('o', AFTER, 'poses to fit'),
        'validation': ('s', BEFORE, 'held out'),
        REFERENCE: ('D', INK, 'references'),
        missing: ('x', '#c0392b', missing),
    }
    kinds: dict[str, list[FloatArray]] = {}
    solutions = []
    for split, poses in plan.tour.plans.items():
        for index, pose in enumerate(poses.poses):
            results = {plan.outcomes.get((split, index, i)) for i in range(len(pose.solutions))}
            lost = split != REFERENCE and not results & {'recorded', 'partial'}
            kinds.setdefault(missing if lost else split, []).append(pose.T_R_T[:3, 3])
            solutions.append(pose.solutions[0])
    arms = arm_lines(chain, np.array(solutions)[evenly(len(solutions), ARMS)])
    frames = subject.inputs.T_R_N
    figure = Figure(figsize=(WIDTH_IN, 4.9), layout=_with_room())
    everything = np.concatenate((*map(np.array, kinds.values()), arms.reshape(-1, 3)))
    for ax, (a, b) in two_views(figure, everything, frames):
        for arm in arms:
            ax.plot(arm[:, a], arm[:, b], 'o-', color=FAINT, linewidth=2, markersize=3, alpha=0.5)
        for kind, (marker, color, _) in shown_as.items():
            at = np.array(kinds.get(kind, np.empty((0, 3))))
            ax.plot(at[:, a], at[:, b], marker, color=color, markersize=4.5, mew=1.3, mfc='none')
    entries = [
        Line2D([], [], marker=marker, color=color, ls='', mfc='none', mew=1.3, label=words)
        for kind, (marker, color, words) in shown_as.items()
        if kind in kinds
    ]
    figure.legend(handles=entries, loc='outside upper right', ncols=4, handletextpad=0.2)
    entries = sensor_entries(frames)
    figure.legend(handles=entries, loc='outside lower center', ncols=3, handletextpad=0.2)
    return figure


def two_views(
    figure: Figure, everything: FloatArray, frames: dict[str, FloatArray]
) -> list[tuple[Axes, tuple[int, int]]]:
    """Panels from above and from the side, with the sensors, each with its two axes (indices).

    ``everything``: points that must be inside, in the robot base, m, (n, 3); ``frames``: T_R_N by
    sensor.
    """
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    reach = 0.55 * float(np.ptp(everything, axis=0).max())
    views = ((0, 1, 'from above'), (0, 2, 'from the side'))
    found = []
    for ax, (a, b, name) in zip(figure.subplots(1, 2), views, strict=True):
        ax.set_xlim(middle[a] - reach, middle[a] + reach)
        ax.set_ylim(middle[b] - reach, middle[b] + reach)
        # Of equal spans: one metre is as long in both.
        ax.set_box_aspect(1.0)
        ax.set_title(f'{name}, in the robot base')
        ax.set_xlabel(f'{"xyz"[a]} (m)')
        ax.set_ylabel(f'{"xyz"[b]} (m)')
        _sensors(ax, frames, middle, reach, (a, b))
        found.append((ax, (a, b)))
    return found


def _with_room() -> ConstrainedLayoutEngine:
    """Layout for figures with a title on top: printers draw letters a little higher."""
    return ConstrainedLayoutEngine(h_pad=0.1)


def sensor_entries(frames: dict[str, FloatArray]) -> list[Line2D]:
    """Legend entries of `two_views` for the sensors: letter, name and distance from the base."""
    labels = [
        f'{letter}: {name[:24]}, {np.linalg.norm(T[:3, 3]):.1f} m from the base'
        for letter, (name, T) in zip(LETTERS, frames.items(), strict=False)
    ]
    return [Line2D([], [], color=ALL_CAUSES, marker='D', ls='', label=text) for text in labels]


def _sensors(
    ax: Axes,
    frames: dict[str, FloatArray],
    middle: FloatArray,
    reach: float,
    plane: tuple[int, int],
) -> None:
    """Draw each sensor's letter at its position, or an arrow to one outside the panel.

    ``middle``: of the panel in R, (3,), m; ``reach``: half its width, m; ``plane``: its two axes.
    """
    for letter, T in zip(LETTERS, frames.values(), strict=False):
        centre = middle[list(plane)]
        way = T[:3, 3][list(plane)] - centre
        outside = float(np.abs(way).max()) / reach
        start, end = (tuple(centre + way * share / outside) for share in (0.86, 0.98))
        if outside > 0.98:
            arrow = {'arrowstyle': '-|>', 'color': ALL_CAUSES, 'linewidth': 1.5}
            ax.annotate('', end, xytext=start, arrowprops=arrow)
        else:
            start = tuple(centre + way)
            ax.plot(*start, 'D', color=ALL_CAUSES, markersize=5)
        ax.annotate(
            letter,
            start,
            # Several sensors on one side: one letter above, the next below.
            xytext=(0, 4 if LETTERS.index(letter) % 2 == 0 else -11),
            textcoords='offset points',
            ha='center',
            color=ALL_CAUSES,
            fontweight='bold',
        )


def _two_lines(text: str) -> str:
    """Title broken near its middle; one of fewer than three words is unchanged."""
    words = text.split(' ')
    if len(words) < 3:
        return text
    breaks = [(abs(len(' '.join(words[:i])) - len(text) / 2), i) for i in range(1, len(words))]
    i = min(breaks)[1]
    return ' '.join(words[:i]) + '\n' + ' '.join(words[i:])
