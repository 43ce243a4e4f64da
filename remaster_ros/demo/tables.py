# SPDX-License-Identifier: Apache-2.0
"""Tables of a demo: estimates beside the hidden truth, and times."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from remaster_ros.calibration.gauge_words import in_a_line
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.compensation.verification import Visits, verify
from remaster_ros.demo.configuration_times import ConfigurationTimes
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.reports.result_lines import discovery_lines
from remaster_ros.reports.schemas import Discovered, Fit
from remaster_ros.simulation.chain_arm import tool_points
from remaster_ros.simulation.expected_findings import causes, describe, named_cause
from remaster_ros.simulation.hidden_effects import true_parameters
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.types import Session


def _table(title: str, *headings: str, left_aligned: int = 1) -> Table:
    """Return a table with these headings and no rows, to be filled and printed.

    Its first `left_aligned` columns are left-aligned, the others right-aligned.
    """
    table = Table(title=title)
    for column, heading in enumerate(headings):
        table.add_column(heading, justify='left' if column < left_aligned else 'right')
    return table


def print_times(console: Console, times: ConfigurationTimes) -> None:
    """Print the table of times per configuration: median, 95 % and largest, s."""
    columns = times.columns()
    title = f'time per configuration, s ({len(columns["motion"])} configurations)'
    table = _table(title, '', 'median', '95 %', 'largest')
    for name, values in columns.items():
        if len(values):
            unit = 'wall' if name == 'software' else 'world time'
            figures = (np.median(values), np.quantile(values, 0.95), values.max())
            table.add_row(f'{name} ({unit})', *(f'{figure:.3f}' for figure in figures))
    console.print(table)


def print_offsets(console: Console, fit: Fit, truth: SessionTruth) -> None:
    """Print tables of the offsets beside the true ones, and of the error on validation poses.

    Also why an offset is not identifiable.
    """
    title = 'joint zero-offsets, degrees'
    # The simulated arm is exactly its drawing: by that std the estimate is judged.
    drawn = 'std as drawn'
    table = _table(title, 'joint', 'estimate', 'std', drawn, 'hidden truth', 'off by')
    for row, hidden in zip(fit.joint_offsets, truth.joint_offsets):
        slides = row.unit == 'mm'
        mean, std, drawn_std, true = (1e3 if slides else np.degrees(1.0)) * np.array(
            [*row.mean_and_std, row.std_if_exactly_drawn, hidden]
        )
        if row.identifiable:
            estimate, spread, narrower = f'{mean:.4f}', f'{std:.4f}', f'{drawn_std:.4f}'
            off = f'{(mean - true) / drawn_std:+.1f} std'
        else:
            # The spread of an undetermined offset is a whole turn, which is no useful figure.
            estimate, spread = 'not identifiable', f'{std:.2f}' if std < 90 else 'n/a'
            narrower = off = ''
        name = f'{row.joint}, mm' if slides else row.joint
        table.add_row(name, estimate, spread, narrower, f'{true:.4f}', off)
    console.print(table)
    for row in fit.joint_offsets:
        if not row.identifiable:
            console.print(f'{row.joint}: {in_a_line(row.why)}', soft_wrap=True)
    title = 'error on validation poses, which were never fitted, mm (mean)'
    accuracy = _table(title, 'metric', 'before', 'after')
    for metric in ('relative', 'post_registration'):
        sides = (fit.accuracy.validation or {}).get(metric) or {}
        cells = [
            f'{sides[s]["mean_mm"]:.3f}' if sides.get(s) else '-' for s in ('before', 'after')
        ]
        accuracy.add_row(metric.replace('_', '-'), *cells)
    console.print(accuracy)


def print_hidden(console: Console, discovery: Discovered, truth: SessionTruth) -> None:
    """Print a table of the hidden causes, whether each was found, and with which parameters.

    Found causes that are not hidden are listed as such. Then lines on the discovery's results.
    """
    found: dict[Any, list[FoundEffect]] = {}
    for claim in discovery.effects:
        for cause in named_cause(msgspec.to_builtins(claim)):
            found.setdefault(cause, []).append(claim)
    hidden = [(cause, effect) for effect in truth.effects for cause in causes(effect)]
    headings = ('hidden truth', 'found', 'parameter', 'estimate', 'std', 'truth', 'unit')
    table = _table('beyond the zero-offsets', *headings, left_aligned=2)
    for cause, effect in hidden:
        claims = found.pop(cause, [])
        table.add_row(describe(cause), 'yes' if claims else 'no')
        true = true_parameters(effect)
        for row in (row for claim in claims for row in claim.parameters):
            if row.name in true:
                figures = (f'{figure:.4g}' for figure in (row.value, row.std, true[row.name]))
                table.add_row('', '', row.name, *figures, row.unit)
    for cause in found:
        table.add_row('nothing of the kind', describe(cause))
    console.print(table)
    for line in discovery_lines(discovery):
        console.print(line)


def true_errors(
    session: Session, compensator: Compensator, truth: SessionTruth
) -> tuple[float, float]:
    """Return the mean true error of the tool without and with a correction, mm.

    At the configurations of a session that was measured with the correction on: the distance
    of the tool's true position from that of the nominal arm at the wanted joint angles. Base
    and marker are fitted separately without and with the correction.
    """
    m = session.measurements
    assert m.wanted is not None
    first = np.unique(m.configuration, return_index=True)[1]
    commanded_and_reached = m.wanted[np.sort(first)], m.q[np.sort(first)]
    n, marker = len(first), next(iter(compensator.model.markers))
    result = verify(
        compensator,
        Visits(
            np.tile(commanded_and_reached[0], (2, 1)),
            np.repeat([False, True], n),
            np.tile(np.arange(n), 2),
            2 * n * ('truth',),
            2 * n * (marker,),
            np.concatenate(
                [
                    tool_points(compensator.model.chain, truth, q, marker)
                    for q in commanded_and_reached
                ]
            ),
        ),
    )
    assert result.error_off is not None
    return result.error_off.mean_mm, result.error_on.mean_mm
