# SPDX-License-Identifier: Apache-2.0
"""Figures of `remaster report`: errors by stage, by time, over the workspace, and the plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.figure_style import (
    AFTER,
    BEFORE,
    FAINT,
    INK,
    SCATTER_POINTS,
    SENSOR_MARKERS,
    WIDTH_IN,
    arm_lines,
    as_svg,
    evenly,
    legend_entry,
    log_axis,
)
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from remaster_ros.reports.answer import Answer
    from remaster_ros.reports.report_inputs import Inputs

MODEL, ALL_CAUSES = '#8a6fc4', '#2f9e78'
# Narrower than the figures of many panels: to be read on a phone.
NARROW_IN = 5.2
ARMS = 4
LETTERS = 'ABCDEFGHIJKLMNOPQRSTUVWXYZ'


class Subject(NamedTuple):
    """Session with results, answer and arm that the figures of a report are drawn from."""

    inputs: Inputs
    answer: Answer
    chain: SerialChain


def draw_answer(subject: Subject) -> dict[str, str]:
    """Draw all figures of a report; return them as SVG text by name.

    Names: 'stages', 'session', 'workspace', and 'plan' if the session has a plan.
    """
    figures: dict[str, Callable[[Subject], Figure]] = {
        'session': over_session,
        'workspace': workspace,
    }
    if subject.inputs.plan is not None:
        figures['plan'] = planned
    return draw_stages(subject.answer) | as_svg(figures, subject)


def draw_stages(answer: Answer) -> dict[str, str]:
    """Draw the figure of the errors by stage; return {'stages': SVG text}."""
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
    """Mark by dashed lines with their titles when causes happened that came at one moment."""
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
    """Draw the planned tool positions from above and from the side, coloured by their outcome.

    The session has to have a plan. A pose is 'not measured' if none of its solutions was
    recorded.
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
    """Make two panels of a figure, from above and from the side, with the sensors drawn.

    Returns each panel with the indices of its two axes of the robot base. ``everything``:
    points that must be inside, in the robot base, m, (n, 3); ``frames``: T_R_N by sensor.
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
    """Return a layout with more room at the top, as printers draw letters a little higher."""
    return ConstrainedLayoutEngine(h_pad=0.1)


def sensor_entries(frames: dict[str, FloatArray]) -> list[Line2D]:
    """Return legend entries for the letters by which `two_views` marks sensors.

    Letter, name and distance from the base. ``frames``: T_R_N by sensor, in the same order.
    """
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
    """Draw each sensor's letter at its position, or an arrow towards one outside the panel.

    ``middle``: centre of the panel in the robot base, m, (3,); ``reach``: half its width, m;
    ``plane``: indices of its two axes.
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
    """Return a title with a line break near its middle; unchanged if it has under three words."""
    words = text.split(' ')
    if len(words) < 3:
        return text
    breaks = [(abs(len(' '.join(words[:i])) - len(text) / 2), i) for i in range(1, len(words))]
    i = min(breaks)[1]
    return ' '.join(words[:i]) + '\n' + ' '.join(words[i:])
