# SPDX-License-Identifier: Apache-2.0
"""Judgement of a fit: green, amber or red, a headline, and the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from remaster_ros.calibration.convergence import SamplerInfo
from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.noise_check import NoiseCheck
from remaster_ros.calibration.residual_structure import FEWEST_POSES
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.reports.schemas import Judgement
from remaster_ros.reports.sentences import (
    NOT_PROVEN,
    NOTICEABLE_GAIN,
    hardly_proven,
    held_out_poses,
    not_counted,
    times_smaller,
)

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

FEW_POSES = 'So few poses do not show'
SEARCH = 'run "remaster discover"'


def verdict(result: FitResult) -> Judgement:
    """Judgement of a fit: gain, convergence, and offsets that are not identifiable.

    'bad' if chains disagree, the error grows by over a tenth or offsets are implausible; 'good' if
    held-out poses show a gain of a tenth, noise explains the rest and nothing disagrees.
    """
    validated = result.accuracy['validation'] is not None
    before, after = _mean_errors_mm(result, validated)
    gain = before / max(after, 1e-9)
    again = MeasuredAgain.of(result.session.measurements)
    where = 'on poses it never fitted' if validated else 'on the fitted poses'
    if again.most:
        where = 'on held-out poses, most of which were fitted as well'
    gross = sum(len(check.gross) for check in result.noise_checks) if validated else 0
    if gross:
        where += f' ({not_counted(gross)})'
    change = f'{before:.3f} mm to {after:.3f} mm {where}'
    unexplained = [check for check in result.noise_checks if check.explained is False]
    untold = [check for check in result.noise_checks if check.explained is None]
    changes = references(result)[1]
    spoilt = [check.spoilt for check in result.noise_checks if check.spoilt]
    displaced = [f'{line}.' for line in result.displaced_markers]
    findings = [_compared(check) for check in unexplained] + _structure(result)
    doubts = [_compared(check) for check in untold]
    few = result.structure is not None and result.structure.too_few
    if few:
        doubts.append(
            f'{FEW_POSES} whether other errors than noise are left, which the offsets would '
            f'take up: measure at least {FEWEST_POSES} and fit again.'
        )
    disagreements = [*result.session.disagreements, *changes, *spoilt, *displaced]
    proof = result.motion_proof
    if proof is not None and proof.disagree:
        disagreements.append(proof.words)
    points = findings + doubts + _widening(result) + disagreements
    doubtful = bool(unexplained or untold) or result.other_errors
    hardly = hardly_proven(held_out_poses(result.session))
    unproven = disagreements or few or again.most or not validated or hardly
    mood: Literal['good', 'caution', 'bad'] = 'caution'
    if result.sampler.wandering and not result.sampler.converged:
        mood = 'bad'
        headline = (
            'The chains have not converged, so nothing is decided yet: '
            f'for now the mean position error goes from {change}.'
        )
    elif not result.sampler.converged and result.sampler.method != 'metropolis':
        headline = (
            'The data leave some parameters so open that their distribution is known only '
            f'approximately. The mean position error goes from {change}.'
        )
        if doubtful:
            headline += f' {_dominated(result, unexplained)}'
    elif gain >= NOTICEABLE_GAIN:
        headline = f'The mean position error falls from {change}: {times_smaller(before, after)}.'
        if doubtful:
            headline += f' {_dominated(result, unexplained)}'
        elif result.sampler.converged and not unproven:
            mood = 'good'
    elif gain > 1 / NOTICEABLE_GAIN:
        headline = (
            f'The zero-offsets hardly matter here: the mean position error goes from {change}.'
        )
        if doubtful:
            headline += f' {_dominated(result, unexplained)}'
        elif not few:
            headline += ' That is what noise explains.'
    else:
        mood = 'bad'
        headline = f'The offsets make it worse: the mean position error goes from {change}.'
    if result.implausible:
        mood = 'bad'
        headline += ' Do not apply the offsets yet: they are larger than a mastering is off by.'
        points = [*result.implausible, *points]
    if proof is not None and not proof.disagree:
        points.append(proof.words)
    if again.again:
        points.append(again.words)
    if note := result.session.correction_note:
        points.append(note)
    if not validated:
        points.append(NOT_PROVEN)
    elif hardly:
        points.append(hardly)
    points.append(_sampling(result.sampler))
    unknown = [
        joint
        for joint, known in zip(result.joint_names, result.identifiable, strict=True)
        if not known
    ]
    count = len(result.joint_names)
    if unknown:
        points.append(
            f'{count - len(unknown)} of {count} zero-offsets '
            f'{"is" if count - len(unknown) == 1 else "are"} measured; that of {listed(unknown)} '
            'cannot be told from other errors, which the table of zero-offsets names.'
        )
    else:
        points.append(f'All {count} zero-offsets are measured.')
    if result.orientations_in_words:
        words = result.orientations_in_words
        points.append(f'{words[0].upper()}{words[1:]}.')
    if result.left_out:
        left_out = len(result.left_out)
        points.append(
            f'{counted(left_out, "observation")} {"is" if left_out == 1 else "are"} left out as '
            'gross errors; they are listed below.'
        )
    return Judgement(mood, headline, points, findings, doubts, disagreements)


def references(result: FitResult) -> tuple[int, list[str]]:
    """Number of rounds of the references, and sentences on changes during the session.

    (0, []) without references.
    """
    if result.session.references is None:
        return 0, []
    # What judges them plans as well; few sessions have any.
    from remaster_ros.collection.reference_watch import changes

    rounds, found = changes(result.session, result.chain, result.T_R_N)
    return rounds, [f'While it was measured, {change.describe()}.' for change in found]


def _sampling(sampler: SamplerInfo) -> str:
    """Sentence on the convergence of the sampling, with the next step if it has not converged.

    Its figures, such as R-hat, are in the appendix of a report.
    """
    percent_of_std = 100 * (sampler.precision or np.nan)
    exact = f'every mean is exact to {percent_of_std:.1f} % of its standard deviation'
    if sampler.converged and sampler.method == 'metropolis':
        return f'The sampling of the offsets has converged: {exact}.'
    if sampler.converged:
        return f'The approximation of the uncertainties has passed its check: {exact}.'
    if sampler.method != 'metropolis':
        return (
            f'Do not trust the uncertainties ({sampler.message}): measure poses that are spread '
            'further and turn the tool, or state what is known of these parameters (--prior).'
        )
    if sampler.wandering:
        return (
            'Do not trust offsets or uncertainties, as the sampling has not converged: fit again '
            'with more draws (--draws).'
        )
    return (
        f'The sampling of the offsets is sound, but less exact than was asked for: {exact}. Fit '
        'again with more draws (--draws) if you need it.'
    )


def _mean_errors_mm(result: FitResult, validated: bool) -> tuple[float, float]:
    """Mean 3-D error before and after, mm, of held-out rows without gross errors.

    If nothing was held out (``validated`` false), of the fitted rows.
    """
    gross = [row for check in result.noise_checks for row in check.gross]
    if not (validated and gross):
        split = 'validation' if validated else 'optimization'
        metrics = result.accuracy[split]['post_registration']
        return metrics['before']['mean_mm'], metrics['after']['mean_mm']
    m = result.session.measurements
    rows = m.is_validation & ~np.isin(m.observation, gross)
    before, after = map(lengths_mm, (result.residuals_before[rows], result.residuals_after[rows]))
    return float(before.mean()), float(after.mean())


def _structure(result: FitResult) -> list[str]:
    """Sentences on the drivers that the residuals follow, each with its probability by chance."""
    found = result.structure.found if result.structure is not None else ()
    tests = [(test.words(result.session.timed), test.chance) for test in found]
    return [f'{words[0].upper()}{words[1:]} ({chance}).' for words, chance in tests]


def _widening(result: FitResult) -> list[str]:
    """Sentences on the effect of unmodelled errors on the intervals; [] without such errors."""
    lines = []
    if np.any(result.widening > 1.0):
        lines.append(
            'The standard deviations and intervals of the offsets include what the model leaves '
            f'out: they are up to {np.max(result.widening):.1f} times as wide as without it.'
        )
    if result.other_errors:
        lines.append(
            'Those of registrations and markers do not: they are lower limits. What the model '
            'leaves out may move these many times as far.'
        )
    return lines


def without_search(headline: str) -> str:
    """Headline of a fit without the advice '; run "remaster discover"'."""
    return headline.replace(f'; {SEARCH}', '')


def _dominated(result: FitResult, unexplained: Sequence[NoiseCheck]) -> str:
    """Sentence why the error after is no success, and the next step.

    ``unexplained``: checks of the sensors whose error noise does not explain.
    """
    if not result.other_errors:
        return 'Whether noise explains what is left, this session cannot show.'
    if result.structure is not None and result.structure.too_few:
        return 'Noise does not explain what is left; so few poses do not show what does.'
    if any(check.is_of_no_instrument for check in unexplained):
        return 'But what is left is no noise of any instrument: the model does not hold.'
    if not any(check.noise_std_m is not None for check in unexplained):
        return (
            'But what is left has structure, which noise has not: there are other errors beside '
            f'it; {SEARCH}.'
        )
    return f'But noise does not explain what is left: other errors dominate; {SEARCH}.'


def _compared(check: NoiseCheck) -> str:
    """Error and noise of a sensor as a sentence, for an error that noise does not explain.

    Or for one of which the noise is unknown, with what to measure.
    """
    if check.is_of_no_instrument:
        return check.no_instrument
    if check.noise_m is None:
        return (
            f'{check.sensor}: no reading has a standard deviation, and no pose was seen in two '
            f'joint solutions, so nothing shows how much of the {1e3 * check.after_m:.3f} mm is '
            'noise: measure poses in all their joint solutions.'
        )
    sources = [
        f'{1e3 * std:.3f} mm per axis {what}'
        for std, what in (
            (check.stated_std_m, 'by the scatter of the samples of a reading'),
            (check.within_pose_std_m, 'within a pose'),
        )
        if std is not None
    ]
    std = check.noise_std_m
    if len(sources) > 1 and std is not None and std != check.within_pose_std_m:
        sources.append(f'of which {1e3 * std:.3f} mm count')
    return (
        f'{check.sensor}: the error after is {1e3 * check.after_m:.3f} mm without its largest '
        f'values; noise ({", ".join(sources)}) makes {1e3 * check.noise_m:.3f} mm. A '
        'sensor or base that was moved during the session, a soft joint or a worn gear leave such '
        'errors, and the offsets take up a part of them.'
    )
