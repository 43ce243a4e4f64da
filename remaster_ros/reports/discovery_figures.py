# SPDX-License-Identifier: Apache-2.0
"""Figures of a discovery: errors before and after, errors by driver, causes with their bands."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from remaster_ros.discovery.effects.drivers import driver_named
from remaster_ros.reports.figure_style import (
    AFTER,
    BEFORE,
    GRID,
    INK,
    WIDTH_IN,
    as_svg,
    error_histograms,
    legend_above,
)
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.types import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.discovery.effects.base import Candidate
    from remaster_ros.discovery.effects.context import Context
    from remaster_ros.discovery.explain import FoundEffect

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
    """Draw all figures of a discovery; return them as SVG text by file name without ending."""
    return as_svg(discovery_figures(discovery), discovery)


def discovery_figures(discovery: Discovery) -> dict[str, Callable[[Discovery], Figure]]:
    """Return the functions that draw a discovery's figures, by file name without ending.

    'causes' is among them only if the discovery has causes.
    """
    figures: dict[str, Callable[[Discovery], Figure]] = {'gain': gain, 'drivers': drivers}
    if discovery.groups:
        figures['causes'] = causes
    return figures


def gain(discovery: Discovery) -> Figure:
    """Draw the error distributions before and after, and each sensor's noise.

    Noise shared by all readings of a pose and noise within a pose have separate bars, if the
    session can tell them apart.
    """
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
    """Draw each cause of a joint, and each step of a sensor, marker or base, with its data.

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
    """Draw the sizes of causes that have no panel of their own, and the noise, as bars.

    RMS at the marker, mm.
    """
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
    """Return the estimate of a candidate's parameters in the discovery's model, (p,).

    Looked up by name: they may belong to a larger candidate there.
    """
    solution = discovery.solution
    names = [name for member in solution.candidates for name in member.parameters]
    return solution.parameters[[names.index(name) for name in candidate.parameters]]


def _step(ax: Axes, discovery: Discovery, candidate: Candidate) -> None:
    """Draw a step of a sensor, marker or base over time: errors and fit along its direction, mm.

    The band is ± 2 standard deviations.
    """
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
    """Return label, values (n,) and scale of the quantity that a cause depends on.

    The scale is the value of one unit of the axis, such as 1 degree in rad. If the cause depends
    on no single quantity, the values are the first column of ``features``, (n, p): the columns of
    the cause's p parameters.
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
    deviations. A change in mid-session is drawn only in rows after it begins, or before it ends.
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
    """Draw an estimate and its band as bars, if the driver has only few separate values.

    ``at``: driver of the rows, sorted, (n,); ``middle``, ``spread``: estimate and half width of
    the band, (n,) each; ``holes``: indices in these at which a part begins after a gap. Draws
    nothing if any part is wide enough for a line.
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
    """Draw a cause that depends on the side of approach (1 or -1): points, and a line a side.

    ``x``, ``effect``, ``band``: side, effect and half width of its band in each row, (n,) each;
    ``shown``: sides and values of the points.
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
