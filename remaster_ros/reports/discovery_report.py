"""report.html of a discovery: one self-contained page that a technician can read."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from remaster_ros.discovery.confirmation import Confirmation, in_words
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import driver_named
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.reports.discovery_apply import load_words
from remaster_ros.reports.discovery_schema import Discovered
from remaster_ros.reports.figures import (
    AFTER,
    BEFORE,
    GRID,
    INK,
    WIDTH_IN,
    as_svg,
    error_histograms,
    legend_above,
)
from remaster_ros.reports.pages import inlined, page, write_report
from remaster_ros.types import FloatArray

# The figures of a discovery as SVG text: errors by driver, causes with their bands, the gain.


if TYPE_CHECKING:
    from matplotlib.axes import Axes

ARC_MINUTE = np.radians(1.0 / 60.0)
BINS = 12
SCATTER_POINTS = 800
MOST_CAUSES = 8
# Of a larger session the curves are drawn at the rows that were searched.
MOST_DRAWN = 20_000
# A curve's line ends so many knots from the last value that was measured.
NEAR = 0.5
# A wave is not drawn across a larger share of its range without a measurement.
WIDE_GAP = 1.0 / 30.0
# Nor is anything else across such a share.
EMPTY = 1.0 / 8.0


def draw_discovery(discovery: Discovery) -> dict[str, str]:
    """Return every figure as SVG text, by file name without ending."""
    return as_svg(figures_of(discovery), discovery)


def figures_of(discovery: Discovery) -> dict[str, Callable[[Discovery], Figure]]:
    """Return what draws each figure of a discovery, by file name without ending."""
    figures: dict[str, Callable[[Discovery], Figure]] = {'gain': gain, 'drivers': drivers}
    if discovery.groups:
        figures['causes'] = causes
    return figures


def gain(discovery: Discovery) -> Figure:
    """Draw the errors before and after, and what a pose's readings share of them, where known."""
    figure = Figure(figsize=(WIDTH_IN, 2.6), layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    data = discovery.residuals
    held_out = data.context.measurements.is_validation
    rows = held_out if held_out.any() else np.isin(np.arange(len(held_out)), data.rows.source)
    errors = discovery.residuals_before, discovery.fit.residuals_after
    lengths = [1e3 * np.linalg.norm(error[rows], axis=1) for error in errors]
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
        lengths_mm = 1e3 * np.array(values)[:, column]
        right.barh(y + 0.36 * column - 0.18, lengths_mm, 0.34, color=color, label=label)
    right.set_yticks(y.tolist(), labels)
    right.invert_yaxis()
    right.grid(False, axis='y')
    right.set_xlabel('RMS per axis (mm)')
    right.set_title('Shared by a pose, and within' if separable else 'Errors of a reading')
    return figure


def drivers(discovery: Discovery) -> Figure:
    """Draw, joint by joint, the errors along the joint's motion against every driver."""
    data = discovery.residuals
    context = data.part
    candidates: list[tuple[bool, str, Callable[[int], FloatArray]]] = [
        (True, 'own angle (°)', lambda j: np.degrees(context.measurements.q[:, j])),
        (context.has_gravity, 'gravity torque (N m)', lambda j: context.gravity_torque[:, j]),
        (context.has_approach, 'last move (°)', lambda j: np.degrees(context.last_move[:, j])),
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
        left = data.left(fit)
        along = 1e3 * np.einsum('nij,ni->nj', motion, left) / length
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
    """Draw means with their standard errors in bins of equal counts."""
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
    """Draw each cause: what is left without it against what drives it, and the fit with band."""
    panels = [
        cell
        for group in discovery.groups
        for cell in group
        if cell.place == 'joint_angle' or cell.happened
    ]
    constant = [
        effect
        for effect, group in zip(discovery.effects, discovery.groups, strict=False)
        if not any(cell in panels for cell in group)
    ]
    panels = panels[: 2 * MOST_CAUSES]
    count = len(panels) + bool(constant)
    lines = -(-count // 2)
    figure = Figure(figsize=(WIDTH_IN, 2.2 * lines + 0.2), layout='constrained')
    axes = list(figure.subplots(lines, 2 if count > 1 else 1, squeeze=False).flat)
    for cell, ax in zip(panels, axes, strict=False):
        (_cause if cell.place == 'joint_angle' else _step)(ax, discovery, cell)
    if constant:
        _sizes(axes[len(panels)], discovery, constant)
    for spare in axes[count:]:
        spare.set_visible(False)
    return figure


def _sizes(ax: Axes, discovery: Discovery, effects: Sequence[FoundEffect]) -> None:
    """Draw how large the causes without a curve are, beside the noise."""
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


def _estimate(discovery: Discovery, cell: Cell) -> FloatArray:
    """Return a cause's parameters in the whole model, where they may be some of a larger cell."""
    solution = discovery.solution
    names = [name for one in solution.cells for name in one.parameters]
    return solution.parameters[[names.index(name) for name in cell.parameters]]


def _step(ax: Axes, discovery: Discovery, cell: Cell) -> None:
    """Draw a jump of a sensor, marker or base over time, along its own direction, mm."""
    data, solution = discovery.residuals, discovery.solution
    context = data.part
    columns = cell.columns(context).displacement(context)
    jump = columns @ _estimate(discovery, cell)
    moved = np.linalg.norm(jump, axis=1) > 0.0
    # Before the moment every column is zero: what moved later tells which rows it is about.
    own = np.isin(context.sensor, context.sensor[moved]) & np.isin(
        context.marker, context.marker[moved]
    )
    way = jump[moved].mean(axis=0)
    way /= np.linalg.norm(way)
    along = 1e3 * (data.left(solution) + jump) @ way
    minutes = context.elapsed_s / 60.0
    ax.plot(minutes[own], along[own], '.', color=BEFORE, markersize=3, alpha=0.6)
    index = {name: i for i, name in enumerate(discovery.fit.theta_names)}
    draws = discovery.fit.theta_draws.reshape(-1, len(index))
    chosen = draws[:, [index[name] for name in cell.parameters]]
    levels = 1e3 * np.einsum('nij,i->nj', columns[moved], way).mean(axis=0) @ chosen.T
    edge = cell.moment / 60.0
    low, high = minutes[own].min(), minutes[own].max()
    ax.plot([low, edge], [0.0, 0.0], color=AFTER, linewidth=1.3)
    level, width = float(levels.mean()), 2.0 * float(levels.std())
    ax.fill_between([edge, high], level - width, level + width, color=AFTER, alpha=0.25)
    ax.plot([edge, high], [level, level], color=AFTER, linewidth=1.3)
    ax.axvline(edge, color=INK, linewidth=0.8, ls=(0, (4, 2)))
    ax.set_xlabel('minutes after the first reading')
    ax.set_ylabel('along the jump (mm)')
    ax.set_title(f'{cell.subject or "base"}: jump after {edge:.1f} min')


def _driver(context: Context, cell: Cell, features: FloatArray) -> tuple[str, FloatArray, float]:
    """Return label and value (n,) of what drives a cause, and how much of it the label's unit is.

    What is no single number is drawn by what it adds per unit of its first parameter.
    """
    driver = driver_named(cell.driver, cell.joints[-1])
    if driver is None:
        name = cell.driver.replace('_', ' ')
        return f'{name} (per unit of {cell.parameters[0]})', features[:, 0], 1.0
    unit = f' ({driver.shown_unit})' if driver.shown_unit else ''
    return f'{driver.label}{unit}', driver.value(context), driver.per_shown


def _cause(ax: Axes, discovery: Discovery, cell: Cell) -> None:
    """Draw one cause at a joint's angle, in arc minutes."""
    data, solution = discovery.residuals, discovery.solution
    whole = len(data.context) <= MOST_DRAWN
    context = data.context if whole else data.part
    left = data.unexplained(solution) if whole else data.left(solution)
    fitted = np.ones(len(context), dtype=bool)
    if whole:
        fitted = np.isin(np.arange(len(context)), data.rows.source)
    parameters = _estimate(discovery, cell) / ARC_MINUTE
    index = {name: i for i, name in enumerate(discovery.fit.theta_names)}
    chosen = [index[name] for name in cell.parameters]
    draws = discovery.fit.theta_draws[..., chosen].reshape(-1, len(chosen)) / ARC_MINUTE
    mean = draws.mean(axis=0)
    draws = draws[:: max(1, len(draws) // 400)]
    columns = cell.columns(context)
    assert columns.at is not None
    values = columns.values
    label, x, per_shown = _driver(context, cell, values)
    if cell.form == 'sin/cos':
        # Its mean is a zero-offset.
        values = values - values[fitted].mean(axis=0)
    effect = values @ mean
    motion = context.jacobian[:, :, columns.at]
    # What is left, as an angle of this joint: only where the marker is far from its axis.
    square = np.sum(motion**2, axis=1)
    far = fitted & (square > 0.1 * np.median(square))
    angle = np.sum(motion * left, axis=1)[far] / square[far] / ARC_MINUTE
    shown = slice(None, None, max(1, int(far.sum()) // SCATTER_POINTS))
    points = (values[far] @ parameters + angle)[shown]
    if cell.driver.startswith('approach'):
        band = 2.0 * (values @ draws.T).std(axis=1)
        _sides(ax, x, effect, band, (x[far][shown], points))
    else:
        at, line = np.sort(x), effect[np.argsort(x)]
        if cell.curve is not None:
            # Everywhere, so that the band opens where nothing was measured; the line is not there.
            x, at = cell.curve.in_turn(x), cell.curve.grid()
            values = cell.curve.columns(at)
            line = np.where(cell.curve.seen(at, NEAR), values @ mean, np.nan)
        else:
            values = values[np.argsort(x)]
            # No straight line where nothing was measured.
            widest = WIDE_GAP if cell.form == 'sin/cos' else EMPTY
            gap = np.diff(at, prepend=at[0]) > widest * np.ptp(at)
            line = np.where(gap, np.nan, line)
        spread = 2.0 * (values @ draws.T).std(axis=1)
        middle = values @ mean
        if cell.curve is None:
            # Nor a straight band: a curve's own is known everywhere.
            holes = np.flatnonzero(gap)
            around = np.insert(at, holes, at[holes])
            middle, spread = (np.insert(v, holes, np.nan) for v in (middle, spread))
        else:
            around = at
        ax.plot(x[far][shown] / per_shown, points, '.', color=BEFORE, markersize=2.5, alpha=0.6)
        low, high = middle - spread, middle + spread
        ax.fill_between(around / per_shown, low, high, color=AFTER, alpha=0.25, linewidth=0)
        # What jumps has no slope between two readings.
        drawn = 'default' if not cell.happened else 'steps-mid'
        ax.plot(at / per_shown, line, color=AFTER, linewidth=1.3, drawstyle=drawn)
    limit = np.quantile(np.abs(points), 0.99)
    ax.set_ylim(-1.2 * limit, 1.2 * limit)
    ax.set_xlabel(label)
    ax.set_ylabel('arc minutes')
    name = 'slip' if cell.happened else cell.name.replace('_', ' ')
    ax.set_title(f'joint {cell.joints[0]}: {name}')


def _sides(
    ax: Axes,
    x: FloatArray,
    effect: FloatArray,
    band: FloatArray,
    shown: tuple[FloatArray, FloatArray],
) -> None:
    """Draw a step: the points of each side spread out, and the step's level beside them."""
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
    html = report_html(discovery, confirmation, content, drawings)
    return write_report(folder, drawings, html)


def report_html(
    discovery: Discovery,
    confirmation: Confirmation | None,
    content: Discovered,
    drawings: dict[str, str],
) -> str:
    """Return the page, with those drawings (of `draw_discovery`) that are given."""
    return page(
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
