# SPDX-License-Identifier: Apache-2.0
"""Figures of a fit: posteriors, chains, errors, tool positions, accuracy over the workspace."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from remaster_ros.calibration.predictive_accuracy import predicted_accuracy, tool_places
from remaster_ros.reports.figure_style import (
    AFTER,
    BEFORE,
    FAINT,
    INK,
    SCATTER_POINTS,
    SENSOR_MARKERS,
    WIDTH_IN,
    as_svg,
    error_histograms,
    evenly,
    legend_above,
    legend_entry,
    log_axis,
)
from remaster_ros.reports.loadable import uncertainty
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from remaster_ros.calibration.result import FitResult

CHAINS = ('#3b82c4', '#e07b39', '#2f9e78', '#b05fb5', '#b08a1e', '#d1495b', '#5f7d95', '#7a6ff0')
TOOL_DRAWS = 400
MAP_POINTS, MAP_TILES = 4000, 22
TRACE_POINTS = 1500
WHOLE_TURN_DEG = 359.999


def draw_fit(result: FitResult) -> dict[str, str]:
    """Draw all figures of a fit; return them as SVG text by file name without ending."""
    return as_svg(fit_figures(result), result)


def fit_figures(_: FitResult) -> dict[str, Callable[[FitResult], Figure]]:
    """Return the functions that draw a fit's figures, by file name without ending.

    The same for every fit: the argument is unused.
    """
    return {
        'posteriors': posteriors,
        'traces': traces,
        'errors': errors_by_configuration,
        'residuals': residual_distribution,
        'tool_places': tool_places_of_one,
        'accuracy_map': accuracy_map,
    }


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
    """Draw the possible marker positions at the configuration of median error, in three views.

    Draws of the posterior with and without noise, and the positions with offsets zero and
    estimated (Fig. 5).
    """
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
    """Draw the predicted error over the workspace, from the side and from above.

    At random configurations, with the measured marker positions as points.
    """
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
    """Make a figure of panels, with fixed margins; return it and its panels, row by row.

    ``height_in``: of the figure, inches; ``shape``: rows and columns; ``left`` to ``right``:
    margins, ``down``: space below a panel, inches. Fixed, as finding them takes longer than
    drawing the figure.
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
    """Make a figure with a titled panel for each joint, two in a row; return it and the panels.

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


def _write_instead(ax: Axes, text: str) -> None:
    """Write a text in a panel in place of a drawing."""
    ax.set_axis_off()
    lines = textwrap.fill(text, 50)
    ax.text(0.0, 0.8, lines, transform=ax.transAxes, va='top', linespacing=1.4)


def _short(why: str) -> str:
    """Return 'Not identifiable: …' with a reason up to its first ';', where the remedy begins."""
    reason = why.split(';')[0]
    return f'Not identifiable: {reason}.'


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
