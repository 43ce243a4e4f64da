"""What the demo prints at its end: the time of a configuration, the offsets, the gain."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from remaster_ros.collection.events import (
    ConfigurationEnded,
    Event,
    PoseAnnounced,
    ShotMeasured,
    SolutionCommanded,
    SolutionSettled,
    State,
)
from remaster_ros.simulation.expected_findings import causes, describe, named_cause
from remaster_ros.simulation.hidden_effects import true_parameters
from remaster_ros.simulation.truth import SessionTruth


class ConfigurationTimes:
    """Where the time of each configuration went, from the nodes' events.

    Motion, settle and measuring are world time. Measuring is what the slowest instrument took:
    the dwell of a stream, or search and integration of a laser tracker. Software is wall time:
    from the bridge's report that the arm has settled to its next command, less the measuring.

    Parameters
    ----------
    rate
        World time over wall time.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._instrument_s = 0.0
        self._open: dict[tuple[str, int], dict[str, float]] = {}
        self._last: dict[str, float] | None = None
        self._registration: set[str] = set()
        self.rows: list[dict[str, float]] = []

    def add(self, event: Event | State) -> None:
        """Take what a node published; only events of a configuration count."""
        match event:
            case PoseAnnounced(split='registration', stamp=stamp):
                self._registration.add(stamp)
            case SolutionCommanded(stamp=stamp, solution=solution, since_settled_wall_s=since_s):
                if self._last is not None:
                    self._last['until_command'] = since_s
                self._last = None
                if stamp not in self._registration:
                    # A registration pose is followed by planning, which is not of its time.
                    self._last = self._open.setdefault((stamp, solution), {})
            case SolutionSettled(stamp=stamp, solution=solution):
                if (row := self._open.get((stamp, solution))) is not None:
                    row.update(motion=event.motion_s, settle=event.settle_s)
            case ShotMeasured(instrument_wall_s=wall_s):
                self._instrument_s = wall_s * self._rate
            case ConfigurationEnded(stamp=stamp, solution=solution, measuring_s=float(reading_s)):
                if (row := self._open.get((stamp, solution))) is not None:
                    row['measuring'] = max(reading_s, self._instrument_s)
                    self._instrument_s = 0.0
                    self.rows.append(row)

    def columns(self) -> dict[str, np.ndarray]:
        """Return motion, settle, measuring (world s) and software (wall s) of complete rows."""
        needed = ('motion', 'settle', 'measuring', 'until_command')
        rows = [row for row in self.rows if all(name in row for name in needed)]
        table = {name: np.array([row[name] for row in rows]) for name in needed}
        software = table.pop('until_command') - table['measuring'] / self._rate
        return {**table, 'software': software}


def _table(title: str, *headings: str, left: int = 1) -> Table:
    """Return an empty table, its first `left` columns aligned to the left."""
    table = Table(title=title)
    for column, heading in enumerate(headings):
        table.add_column(heading, justify='left' if column < left else 'right')
    return table


def print_times(console: Console, times: ConfigurationTimes) -> None:
    """Print the table of times per configuration."""
    columns = times.columns()
    title = f'time per configuration, s ({len(columns["motion"])} configurations)'
    table = _table(title, '', 'median', '95 %', 'largest')
    for name, values in columns.items():
        if len(values):
            unit = 'wall' if name == 'software' else 'world time'
            figures = (np.median(values), np.quantile(values, 0.95), values.max())
            table.add_row(f'{name} ({unit})', *(f'{figure:.3f}' for figure in figures))
    console.print(table)


def print_offsets(console: Console, fit: dict[str, Any], truth: SessionTruth) -> None:
    """Print the offsets beside the true ones, and the error on validation poses."""
    title = 'joint zero-offsets, degrees'
    table = _table(title, 'joint', 'estimate', 'std', 'hidden truth', 'off by, std')
    for row, true in zip(fit['joint_offsets'], np.rad2deg(truth.joint_offsets)):
        if row['identifiable']:
            estimate, std = f'{row["mean_deg"]:.4f}', f'{row["std_deg"]:.4f}'
            off = f'{(row["mean_deg"] - true) / row["std_deg"]:+.1f}'
        else:
            # An offset that the data leave free has the spread of a whole turn: no useful figure.
            std = f'{row["std_deg"]:.2f}' if row['std_deg'] < 90 else 'n/a'
            estimate, off = 'not identifiable', ''
        table.add_row(row['joint'], estimate, std, f'{true:.4f}', off)
    console.print(table)
    for row in fit['joint_offsets']:
        if not row['identifiable']:
            console.print(f'{row["joint"]}: {row["why"]}')
    title = 'error on validation poses, which were never fitted, mm (mean)'
    accuracy = _table(title, 'metric', 'before', 'after')
    for metric in ('relative', 'post_registration'):
        sides = (fit['accuracy']['validation'] or {}).get(metric) or {}
        cells = [
            f'{sides[s]["mean_mm"]:.3f}' if sides.get(s) else '-' for s in ('before', 'after')
        ]
        accuracy.add_row(metric.replace('_', '-'), *cells)
    console.print(accuracy)


def print_hidden(console: Console, discovery: dict[str, Any], truth: SessionTruth) -> None:
    """Print what was found beside what was hidden, and the gain."""
    found: dict[Any, list[dict[str, Any]]] = {}
    for effect in discovery['effects']:
        for cause in named_cause(effect):
            found.setdefault(cause, []).append(effect)
    hidden = [(cause, effect) for effect in truth.effects for cause in causes(effect)]
    headings = ('hidden truth', 'found', 'parameter', 'estimate', 'std', 'truth', 'unit')
    table = _table('beyond the zero-offsets', *headings, left=2)
    for cause, effect in hidden:
        claims = found.pop(cause, [])
        table.add_row(describe(cause), 'yes' if claims else 'no')
        true = true_parameters(effect)
        for row in (row for claim in claims for row in claim['parameters']):
            if row['name'] in true:
                figures = (f'{row[key]:.4g}' for key in ('value', 'std'))
                table.add_row(
                    '', '', row['name'], *figures, f'{true[row["name"]]:.4g}', row['unit']
                )
    for cause in found:
        table.add_row('nothing of the kind', describe(cause))
    console.print(table)
    for effect in discovery['effects']:
        console.print(effect['cause'])
        for other in effect['confusable_with']:
            console.print(
                f'  looks like {other["name"]}; to distinguish them: {other["separate_by"]}'
            )
    gain = discovery['gain']
    if gain['held_out_rms_before_m'] is not None:
        before, after, floor = (
            1e3 * gain[key]
            for key in ('held_out_rms_before_m', 'held_out_rms_after_m', 'noise_floor_m')
        )
        console.print(
            f'verdict: {discovery["verdict"]}; error on validation poses {before:.3f} mm with '
            f'offsets only, {after:.3f} mm with what was found, noise {floor:.3f} mm (RMS)'
        )
