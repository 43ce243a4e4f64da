# SPDX-License-Identifier: Apache-2.0
"""Lines of a fit and of a discovery on the terminal, from the content of their files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from msgspec import UNSET, Struct, UnsetType

from remaster_ros.calibration.dynamics import late_words
from remaster_ros.calibration.gauge_words import in_a_line
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.thinning import Thinning
from remaster_ros.discovery.words import probability_text, shown
from remaster_ros.reports.schemas import Clock, Discovered, Fit, JointOffset, Judgement, Loadable
from remaster_ros.reports.sentences import (
    METRICS,
    MOST_PARAMETERS,
    NO_TIMES,
    as_drawn,
    coverage_words,
    load_words,
    loadable_of_fit,
    look_alike_name,
    size_words,
)

if TYPE_CHECKING:
    from remaster_ros.discovery.confirmation import Confirmation

EXACTLY_DRAWN = 'if the arm is exactly its drawing'


def fit_lines(fit: Fit) -> list[str]:
    """Return the lines of a fit for the terminal: offsets, errors, clocks, judgement.

    Then geometry, missing times and gross errors, if there are any. AssertionError for a fit
    without a judgement.
    """
    assert isinstance(fit.judgement, Judgement)
    width = max(len(row.joint) for row in fit.joint_offsets)
    lines = [f'{row.joint:{width}s} {_offset(row)}' for row in fit.joint_offsets]
    for split in ('optimization', 'validation'):
        metrics = getattr(fit.accuracy, split)
        if metrics is None:
            lines.append(f'{split}: no such rows')
            continue
        for metric in ('relative', 'post_registration'):
            if (sides := metrics[metric])['before'] and sides['after']:
                before, after = sides['before']['mean_mm'], sides['after']['mean_mm']
                change = f'{before:.3f} mm before, {after:.3f} mm after'
                lines.append(f'{split}, {METRICS[metric]}: {change}')
            turned = metrics.get(f'{metric}_orientation') or {}
            if turned.get('after'):
                before, after = turned['before']['mean_deg'], turned['after']['mean_deg']
                lines.append(f'… orientation: {before:.4f} deg before, {after:.4f} deg after')
    lines += clock_lines(fit.clocks)
    lines += [fit.judgement.headline, *fit.judgement.points]
    if isinstance(fit.geometry, Struct) and (moved := fit.geometry.imitations):
        lines.append(
            as_drawn(fit.geometry, [max(moved, key=lambda imitation: imitation.as_angle)])
        )
        if fit.geometry.file:
            lines += _to_load(loadable_of_fit(fit.geometry))
    if isinstance(fit.session, Struct) and fit.session.times == 'none':
        lines.append(f'the session is {NO_TIMES}')
    if fit.left_out:
        rows = ', '.join(str(row.observation) for row in fit.left_out)
        lines.append(f'left out as gross errors: observation {rows}')
    return lines


def clock_lines(clocks: dict[str, Clock] | UnsetType) -> list[str]:
    """Return a line for each sensor on how late its stamps are, and what to do.

    [] without clocks.
    """
    if not isinstance(clocks, dict):
        return []
    return [
        f"{name}'s stamps are {late_words(1e-3 * clock.late_ms, 1e-3 * clock.std_ms)} beside "
        'those of the joint states; taken out here. To do: synchronise the clocks (PTP), or state '
        'it to what joins their data (import --clock-offset)'
        for name, clock in clocks.items()
    ]


def _offset(row: JointOffset) -> str:
    """Return the offset of a joint ± its std as text, or why it is not identifiable."""
    if not row.identifiable:
        return f'   not identifiable: {in_a_line(row.why)}'
    mean, std, drawn = (
        getattr(row, f'{key}_{row.unit}') for key in ('mean', 'std', 'std_if_exactly_drawn')
    )
    narrower = '' if drawn is UNSET else f' ({drawn:.4f} {EXACTLY_DRAWN})'
    return f'{mean:+9.4f} ± {std:.4f} {row.unit}{narrower}'


def _to_load(rows: Sequence[Loadable], effects: Sequence[FoundEffect] = ()) -> list[str]:
    """Return a line for each result that can be loaded: name, error on held-out poses, file.

    ``effects``: causes; if errors of the measurement among them are taken out, the line says
    so.
    """
    lines = []
    for row in rows:
        what, to_do = load_words(row)
        mean = row.held_out_mean_mm
        error = '' if mean is None else f', mean error on held-out poses {mean:.3f} mm'
        if mean is not None and any(
            effect.of_measurement if row.result == 'everything' else effect.is_taken_out
            for effect in effects
        ):
            error += ' (measuring errors taken out)'
        lines.append(f'to load: {what}{error}: {to_do}')
    return lines


def discovery_lines(found: Discovered) -> list[str]:
    """Return the lines of a discovery for the terminal.

    Verdict, causes with look-alikes, unexplained errors, loadable results, coverage of
    held-out rows, and what another session shows. AssertionError for a discovery without a
    judgement.
    """
    assert isinstance(found.judgement, Judgement)
    lines = [f'verdict: {found.verdict}', found.judgement.headline, *clock_lines(found.clocks)]
    for effect in found.effects:
        lines.append(f'{effect.title}: {size_words(effect)}. {effect.cause}')
        if effect.remedy:
            lines.append(f'    to do: {effect.remedy}')
        lines += [
            f'    could be {look_alike_name(effect, other)}{_of_probability(other)}; to decide: '
            f'{other.separate_by}'
            for other in effect.confusable_with
        ]
    lines += [f'unexplained: {error.next}' for error in found.unexplained or ()]
    lines += _to_load(found.loadable or (), found.effects)
    regions = found.predicted_regions95
    if isinstance(regions, Struct) and (
        words := coverage_words(regions.held_out, found.gain.held_out_gross)
    ):
        lines.append(words)
    if isinstance(part := found.rows_searched, Thinning):
        lines.append(
            f'searched: {part.searched} of {part.rows} rows; the others fall from '
            f'{1e3 * part.others_rms_before_m:.3f} to {1e3 * part.others_rms_after_m:.3f} mm RMS '
            'with the causes as found, frozen'
        )
    lines += [f'not testable: {name}: {why}' for name, why in (found.untestable or {}).items()]
    lines += found.judgement.doubts
    lines += [f'other session: {line}' for line in found.judgement.points]
    if not isinstance(found.confirmation, UnsetType):
        lines += _side_by_side(found, found.confirmation)
    return lines + [decision.sentence for decision in found.decided or ()]


def _of_probability(other: LookAlike) -> str:
    """Probability of a look-alike as ' (probability 12 %)'; '' if unknown."""
    if other.probability is None:
        return ''
    return f' (probability {probability_text(other.probability)})'


def _side_by_side(found: Discovered, confirmation: Confirmation) -> list[str]:
    """Table, in lines, of the zero-offsets and the causes' parameters in both sessions.

    One line for a cause of more than 8 parameters (`MOST_PARAMETERS`); [] without any.
    """
    tables = [('zero-offsets', confirmation.joint_offsets)]
    tables += [
        (effect.title, cause.parameters)
        for effect, cause in zip(found.effects, confirmation.effects, strict=False)
    ]
    width = max((len(row.name) for _, rows in tables for row in rows), default=0)
    lines = []
    for name, rows in tables:
        if len(rows) > MOST_PARAMETERS:
            differences = [row.sigmas for row in rows if row.sigmas is not None]
            lines.append(
                f'    {name}: {len(rows)} values, which differ by '
                f'{np.sqrt(np.mean(np.square(differences))):.1f} standard deviations on the '
                'average'
            )
            continue
        for row in rows:
            here = ' ± '.join(shown(row.value, row.std, row.unit)[:2])
            value, std, unit = shown(row.other_value, row.other_std, row.unit)
            sigmas = '–' if row.sigmas is None else f'{row.sigmas:+.1f}'.replace('-', '−')
            there = f'{value} ± {std}'
            lines.append(f'    {row.name:{width}}  {here:>18}  {there:>18} {unit:7}  {sigmas} σ')
    return ['here and there, and the difference in standard deviations:', *lines] if lines else []
