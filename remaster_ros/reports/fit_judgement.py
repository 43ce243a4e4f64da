# SPDX-License-Identifier: Apache-2.0
"""Judgement of a fit: green, amber or red, a headline, and the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from remaster_ros.calibration.convergence import SamplerInfo
from remaster_ros.calibration.gauge_words import counted, listed
from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.noise_check import NoiseCheck
from remaster_ros.calibration.residual_structure import FEWEST_POSES
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.reports.schemas import Judgement, Mood
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


class _Comparison(NamedTuple):
    """Mean errors before and after a fit, mm, by which it is judged."""

    validated: bool  # Whether they are of held-out poses
    again: MeasuredAgain  # Held-out configurations that were fitted as well
    before_mm: float
    after_mm: float
    where: str  # Poses of these errors as text

    @property
    def gain(self) -> float:
        """Ratio of the mean error before to that after."""
        return self.before_mm / max(self.after_mm, 1e-9)

    @property
    def change(self) -> str:
        """Text such as '0.912 mm to 0.101 mm on poses it never fitted'."""
        return f'{self.before_mm:.3f} mm to {self.after_mm:.3f} mm {self.where}'


class _Residuals(NamedTuple):
    """Comparison of a fit's residuals with the noise of each sensor: sentences and conclusions."""

    unexplained: list[NoiseCheck]  # Checks of the sensors whose error noise does not explain
    findings: list[str]  # These errors, and the drivers that the residuals follow
    doubts: list[str]  # Errors whose noise is unknown, and too few poses
    doubtful: bool  # Whether other errors than noise are left, or may be
    too_few_poses: bool  # Whether the poses are too few to show such errors


def verdict(result: FitResult) -> Judgement:
    """Return the judgement of a fit by its gain, convergence, residuals and data.

    'bad' if chains disagree, the error grows by over a tenth or offsets are implausible;
    'good' if held-out poses show a gain of a tenth, noise explains the rest and nothing
    disagrees; else 'caution'.
    """
    compared = _comparison(result)
    residuals = _residuals(result)
    disagreements = _disagreements(result)
    not_proven = _not_proven(result, compared)
    proven = not (disagreements or residuals.too_few_poses or compared.again.most or not_proven)
    mood, headline = _mood_and_headline(result, compared, residuals, proven)
    if result.implausible:
        mood = 'bad'
        headline += ' Do not apply the offsets yet: they are larger than a mastering is off by.'
    points = [
        *result.implausible,
        *residuals.findings,
        *residuals.doubts,
        *_widening(result),
        *disagreements,
        *_measurement_remarks(result, compared.again),
        *not_proven,
        _sampling(result.sampler),
        *_determined_offsets(result),
        *_left_out(result),
    ]
    return Judgement(mood, headline, points, residuals.findings, residuals.doubts, disagreements)


def _comparison(result: FitResult) -> _Comparison:
    """Return the mean errors before and after, on held-out poses if any, else on fitted ones.

    Held-out gross errors do not count.
    """
    validated = result.accuracy['validation'] is not None
    before, after = _mean_errors_mm(result, validated)
    again = MeasuredAgain.of(result.session.measurements)
    where = 'on poses it never fitted' if validated else 'on the fitted poses'
    if again.most:
        where = 'on held-out poses, most of which were fitted as well'
    gross = sum(len(check.gross) for check in result.noise_checks) if validated else 0
    if gross:
        where += f' ({not_counted(gross)})'
    return _Comparison(validated, again, before, after, where)


def _residuals(result: FitResult) -> _Residuals:
    """Comparison of the residuals with each sensor's noise, and tests of what they depend on."""
    unexplained = [check for check in result.noise_checks if check.explained is False]
    unknown = [check for check in result.noise_checks if check.explained is None]
    doubts = [_compared(check) for check in unknown]
    too_few_poses = result.structure is not None and result.structure.too_few
    if too_few_poses:
        doubts.append(
            f'{FEW_POSES} whether other errors than noise are left, which the offsets would '
            f'take up: measure at least {FEWEST_POSES} and fit again.'
        )
    return _Residuals(
        unexplained,
        findings=[_compared(check) for check in unexplained] + _structure(result),
        doubts=doubts,
        doubtful=bool(unexplained or unknown) or result.other_errors,
        too_few_poses=too_few_poses,
    )


def _disagreements(result: FitResult) -> list[str]:
    """Sentences on data that contradict each other; [] if there are none.

    Of the session, of its references, of gross errors, markers, and standstill against motion.
    """
    proof = result.motion_proof
    return [
        *result.session.disagreements,
        *references(result)[1],
        *(check.spoilt for check in result.noise_checks if check.spoilt),
        *(f'{line}.' for line in result.displaced_markers),
        *([proof.words] if proof is not None and proof.disagree else []),
    ]


def _not_proven(result: FitResult, compared: _Comparison) -> list[str]:
    """Sentence that no or too few poses were held out; [] if enough were."""
    if not compared.validated:
        return [NOT_PROVEN]
    hardly = hardly_proven(held_out_poses(result.session))
    return [hardly] if hardly else []


def _mood_and_headline(
    result: FitResult, compared: _Comparison, residuals: _Residuals, proven: bool
) -> tuple[Mood, str]:
    """Return mood and headline by convergence and gain.

    Before implausible offsets are considered. ``proven``: whether enough poses were held out
    and no data disagree.
    """
    sampler, change = result.sampler, compared.change
    rest = f' {_dominated(result, residuals.unexplained)}' if residuals.doubtful else ''
    if sampler.wandering and not sampler.converged:
        return 'bad', (
            'The chains have not converged, so nothing is decided yet: '
            f'for now the mean position error goes from {change}.'
        )
    if not sampler.converged and sampler.method != 'metropolis':
        return 'caution', (
            'The data leave some parameters so open that their distribution is known only '
            f'approximately. The mean position error goes from {change}.{rest}'
        )
    if compared.gain >= NOTICEABLE_GAIN:
        good = proven and sampler.converged and not residuals.doubtful
        smaller = times_smaller(compared.before_mm, compared.after_mm)
        return ('good' if good else 'caution'), (
            f'The mean position error falls from {change}: {smaller}.{rest}'
        )
    if compared.gain > 1 / NOTICEABLE_GAIN:
        if not residuals.doubtful and not residuals.too_few_poses:
            rest = ' That is what noise explains.'
        return 'caution', (
            'The zero-offsets hardly matter here: the mean position error goes from '
            f'{change}.{rest}'
        )
    return 'bad', f'The offsets make it worse: the mean position error goes from {change}.'


def _measurement_remarks(result: FitResult, again: MeasuredAgain) -> list[str]:
    """Return remarks on the measurement, [] if there are none.

    On motion against standstill, on held-out configurations that were fitted as well, and on a
    correction in use.
    """
    proof = result.motion_proof
    remarks = [
        proof.words if proof is not None and not proof.disagree else '',
        again.words if again.again else '',
        result.session.correction_note,
    ]
    return [remark for remark in remarks if remark]


def _determined_offsets(result: FitResult) -> list[str]:
    """Sentences on the number of identifiable offsets, and on what orientations add."""
    unknown = [
        joint
        for joint, known in zip(result.joint_names, result.identifiable, strict=True)
        if not known
    ]
    count = len(result.joint_names)
    if unknown:
        lines = [
            f'{count - len(unknown)} of {count} zero-offsets '
            f'{"is" if count - len(unknown) == 1 else "are"} measured; that of {listed(unknown)} '
            'cannot be told from other errors, which the table of zero-offsets names.'
        ]
    else:
        lines = [f'All {count} zero-offsets are measured.']
    if result.orientations_in_words:
        words = result.orientations_in_words
        lines.append(f'{words[0].upper()}{words[1:]}.')
    return lines


def _left_out(result: FitResult) -> list[str]:
    """Sentence on the number of observations left out as gross errors; [] if there are none."""
    left_out = len(result.left_out)
    if not left_out:
        return []
    return [
        f'{counted(left_out, "observation")} {"is" if left_out == 1 else "are"} left out as '
        'gross errors; they are listed below.'
    ]


def references(result: FitResult) -> tuple[int, list[str]]:
    """Return the number of rounds of reference poses, and sentences on changes they show.

    Reference poses are measured again and again in a session, to see if the set-up changes.
    (0, []) for a session without.
    """
    if result.session.references is None:
        return 0, []
    # What judges them plans as well; few sessions have any.
    from remaster_ros.collection.reference_watch import changes

    rounds, found = changes(result.session, result.chain, result.T_R_N)
    return rounds, [f'While it was measured, {change.describe()}.' for change in found]


def _sampling(sampler: SamplerInfo) -> str:
    """Return a sentence on whether the sampling has converged, with a next step if not.

    Numbers such as R-hat are in the appendix of a report.
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
    """Return sentences on what the residuals were found to depend on, with probabilities.

    Each with the probability of such a dependence by chance. [] if none was found, or if it was
    not tested.
    """
    found = result.structure.found if result.structure is not None else ()
    tests = [(test.words(result.session.timed), test.chance) for test in found]
    return [f'{words[0].upper()}{words[1:]} ({chance}).' for words, chance in tests]


def _widening(result: FitResult) -> list[str]:
    """Sentences on how errors that remain beyond noise widen the intervals; [] without such."""
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
    """Return a sentence on why noise does not explain the errors after a fit, with a next step.

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
    """Return a sentence on a sensor's error after the fit, and noise that does not explain it.

    If the noise is unknown, on what to measure for it.
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
