"""What a fit and its causes are worth, in words: green, amber or red, and why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from remaster_ros.calibration.gauge_words import listed
from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.noise_check import SPOILT, NoiseCheck
from remaster_ros.calibration.residual_structure import FEWEST_POSES
from remaster_ros.collection.reference_watch import changes
from remaster_ros.discovery.gain import held_out_words
from remaster_ros.discovery.words import sentence_case
from remaster_ros.reports.schemas import Discovered, Judgement

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.confirmation import Confirmation
    from remaster_ros.discovery.discover import Discovery


# Less than this is no gain a user would notice.
NOTICEABLE_GAIN = 1.1


def references(result: FitResult) -> tuple[int, list[str]]:
    """Return the rounds of the references, and what changed in the session, a sentence each."""
    rounds, found = changes(result.session, result.chain, result.T_R_N)
    return rounds, [f'While it was measured, {change.describe()}.' for change in found]


def verdict(result: FitResult) -> Judgement:
    """Judge a fit: what was gained, whether the chains agree, what is not identifiable."""
    validated = result.accuracy['validation'] is not None
    before, after = _mean_errors_mm(result, validated)
    gain = before / max(after, 1e-9)
    again = MeasuredAgain.of(result.session.measurements)
    where = 'on poses it never fitted' if validated else 'on the fitted poses'
    if again.most:
        where = 'on held-out poses, most of which were fitted as well'
    gross = sum(len(check.gross) for check in result.noise_checks) if validated else 0
    if gross:
        where += f' ({gross} gross error{"s" if gross > 1 else ""} not counted)'
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
            'So few poses do not show whether other errors than noise are left, which the offsets '
            f'would take up: measure at least {FEWEST_POSES} and fit again.'
        )
    disagreements = changes + spoilt + displaced
    points = findings + doubts + _widening(result) + disagreements
    doubtful = bool(unexplained or untold) or result.other_errors
    unproven = disagreements or few or again.most or not validated
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
        times = f'{gain:.1f} times' if gain < 10 else f'{gain:.0f} times'
        headline = f'The mean position error falls from {change}: {times} smaller.'
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
    if again.again:
        points.append(again.words)
    if note := result.session.correction_note:
        points.append(note)
    if not validated:
        points.append(
            'There are no validation poses, so the gain is not proven: measure some and fit again.'
        )
    sampler = result.sampler
    if sampler.converged and sampler.method == 'metropolis':
        points.append(f'The chains agree with each other ({sampler.message}).')
    elif sampler.converged:
        points.append(f'The weighted draws pass their check ({sampler.message}).')
    elif sampler.method != 'metropolis':
        points.append(
            f'Do not trust the uncertainties ({sampler.message}): measure poses that are spread '
            'further and turn the tool, or state what is known of these parameters (--prior).'
        )
    elif sampler.wandering:
        points.append(
            f'Do not trust offsets or uncertainties ({sampler.message}); '
            'fit again with more draws.'
        )
    else:
        points.append(f'The chains agree, but are shorter than asked for ({sampler.message}).')
    unknown = [
        joint
        for joint, known in zip(result.joint_names, result.identifiable, strict=True)
        if not known
    ]
    count = len(result.joint_names)
    if unknown:
        points.append(
            f'{count - len(unknown)} of {count} zero-offsets are measured; the data do not '
            f'distinguish {listed(unknown)} from what the table names.'
        )
    else:
        points.append(f'All {count} zero-offsets are measured.')
    if result.orientations_in_words:
        words = result.orientations_in_words
        points.append(f'{words[0].upper()}{words[1:]}.')
    if result.left_out:
        plural = 's are' if len(result.left_out) > 1 else ' is'
        points.append(
            f'{len(result.left_out)} observation{plural} left out as gross errors; '
            'they are listed below.'
        )
    return Judgement(mood, headline, points, findings, doubts, disagreements)


def _mean_errors_mm(result: FitResult, validated: bool) -> tuple[float, float]:
    """Return the mean 3-D error before and after, mm, of the rows judged less gross errors."""
    gross = [row for check in result.noise_checks for row in check.gross]
    if not (validated and gross):
        split = 'validation' if validated else 'optimization'
        metrics = result.accuracy[split]['post_registration']
        return metrics['before']['mean_mm'], metrics['after']['mean_mm']
    m = result.session.measurements
    rows = m.is_validation & ~np.isin(m.observation, gross)
    before, after = (
        1e3 * float(np.linalg.norm(residuals[rows], axis=1).mean())
        for residuals in (result.residuals_before, result.residuals_after)
    )
    return before, after


def _structure(result: FitResult) -> list[str]:
    """Return what the residuals follow."""
    found = result.structure.found if result.structure is not None else ()
    return [f'{test.words[0].upper()}{test.words[1:]} ({test.chance}).' for test in found]


def _widening(result: FitResult) -> list[str]:
    """Return what errors that the model leaves out do to the intervals."""
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


def _dominated(result: FitResult, unexplained: Sequence[NoiseCheck]) -> str:
    """Return why the error after is no success, and what to do."""
    if not result.other_errors:
        return 'Whether noise explains what is left, this session cannot show.'
    deed = 'run "remaster discover".'
    if result.chain.slides.any():
        deed = '"remaster discover" does not take an arm with a joint that slides.'
    if not any(check.noise_m is not None for check in unexplained):
        return (
            'But what is left has structure, which noise has not: other errors dominate; ' + deed
        )
    return f'But noise does not explain what is left: other errors dominate; {deed}'


def _compared(check: NoiseCheck) -> str:
    """Return the figures of a sensor whose error noise does not explain."""
    if check.noise_error_m is None:
        return (
            f'{check.sensor}: no reading has a standard deviation, and no pose was seen in two '
            f'joint solutions, so nothing shows how much of the {1e3 * check.error_m:.3f} mm is '
            'noise: measure poses in all their joint solutions.'
        )
    sources = [
        f'{1e3 * std:.3f} mm per axis {what}'
        for std, what in (
            (check.stated_m, 'by the scatter of the samples of a reading'),
            (check.within_m, 'within a pose'),
        )
        if std is not None
    ]
    return (
        f'{check.sensor}: the error after is {1e3 * check.error_m:.3f} mm; noise '
        f'({", ".join(sources)}) makes {1e3 * check.noise_error_m:.3f} mm. A sensor or base that '
        'was moved during the session, a soft joint or a worn gear leave such errors, and the '
        'offsets take up a part of them.'
    )


# What a discovery is worth: green where held-out poses bear it out, else amber.

# Regions meant for 95 % of the held-out rows that hold clearly less than this are too small.
FEWEST_INSIDE = 0.92
# So many times the noise the error on held-out poses may be, and more by chance with few rows.
MOST_OVER_NOISE = 1.25
# Where a cause could move the marker by more than this share of the noise and not be found, it
# proves nothing that none is.
MOST_UNSEEN = 0.5
# A cause is found from about so many standard deviations on.
DETECTED = 4.5


def judgement(
    discovery: Discovery, confirmation: Confirmation | None, content: Discovered
) -> Judgement:
    """Judge what was found: 'good' where all data agree with the verdict, else 'caution'.

    Parameters
    ----------
    discovery, confirmation
        What was found.
    content
        The same as discovery.json has it.
    """
    more = more_than_noise(content)
    again = MeasuredAgain.of(discovery.fit.session.measurements)
    proven = _is_proven(discovery, confirmation) and not more and not again.most
    # What discovers takes half a second to import, and a fit needs none of it.
    from remaster_ros.discovery.confirmation import in_words

    points = in_words(discovery, confirmation) if confirmation is not None else []
    note = discovery.fit.session.correction_note
    return Judgement(
        mood='good' if proven else 'caution',
        headline=headline(discovery, confirmation, more),
        points=points,
        doubts=[words for words in (again.words if again.again else '', note) if words],
    )


def more_than_noise(content: Discovered) -> str:
    """Return in what held-out rows show that the model does not have something; ''."""
    regions, gain = content.predicted_regions95, content.gain
    if isinstance(regions, msgspec.UnsetType) or regions.held_out.interval95 is None:
        return ''
    if regions.held_out.interval95[1] < FEWEST_INSIDE:
        return (
            'Fewer held-out rows than should lie where they were predicted: something is left '
            'that the model does not have.'
        )
    after = gain.held_out_kept_after_m
    if isinstance(after, msgspec.UnsetType):
        after = gain.held_out_rms_after_m
    most = MOST_OVER_NOISE + regions.held_out.rows**-0.5
    if after is not None and after > most * gain.noise_floor_m:
        return (
            f'The error on held-out poses is {after / gain.noise_floor_m:.1f} times that of the '
            'noise alone: something is left that the model does not have.'
        )
    return ''


def _is_proven(discovery: Discovery, confirmation: Confirmation | None) -> bool:
    """Whether poses that were never fitted, and the other session if there is one, agree."""
    if discovery.verdict in ('undetermined', 'unexplained') or discovery.unexplained:
        return False
    if not discovery.fit.sampler.converged:
        return False
    if not all(effect.is_certain for effect in discovery.effects):
        return False
    if any(effect.moment_s is not None for effect in discovery.effects):
        # What was measured before and after it does not agree.
        return False
    if confirmation is not None and (confirmation.other_joints or confirmation.gone):
        return False
    if confirmation is not None and not confirmation.same_offsets:
        return False
    before, after = discovery.gain.held_out_kept_before_m, discovery.gain.held_out_kept_after_m
    if before is None or after is None:
        return False
    if _spoilt(discovery):
        return False
    if discovery.verdict == 'none':
        return _would_show(discovery)
    return after < before and (confirmation is None or confirmation.confirmed)


def least_seen_m(discovery: Discovery) -> float:
    """Return how far, RMS, a cause moves the marker that is about to be found, m.

    Where everything else is fitted anew it leaves `DETECTED` standard deviations of all rows
    together.
    """
    numbers = discovery.residuals.errors.size
    return float(DETECTED * discovery.gain.noise_floor_m / np.sqrt(numbers))


def _spoilt(discovery: Discovery) -> bool:
    """Whether gross errors make up much of the error on held-out poses."""
    every, kept = discovery.gain.held_out_rms_after_m, discovery.gain.held_out_kept_after_m
    return every is not None and kept is not None and every > SPOILT * kept


def _gross(discovery: Discovery) -> str:
    """Return how many readings are gross errors, a sentence; '' of none."""
    count, of = len(discovery.outliers), len(discovery.residuals.context.measurements)
    if not count:
        return ''
    return (
        f' {count} of {of} readings {"are gross errors" if count > 1 else "is a gross error"}, '
        'which no cause explains: find out what was moved, hidden or paired wrongly then.'
    )


def _would_show(discovery: Discovery) -> bool:
    """Whether a cause that matters beside the noise would have been found."""
    return least_seen_m(discovery) < MOST_UNSEEN * discovery.gain.noise_floor_m


def _uncertain(discovery: Discovery) -> str:
    """Return which causes may be chance by their own standard deviations; ''."""
    names = [sentence_case(effect.title) for effect in discovery.effects if not effect.is_certain]
    return f' Not certain by its own standard deviation: {", ".join(names)}.' if names else ''


def headline(
    discovery: Discovery, confirmation: Confirmation | None = None, more: str = ''
) -> str:
    """Return the result in one or a few sentences; `more` is what held-out rows show beside it."""
    result = _result(discovery, confirmation, left=bool(more) or bool(discovery.outliers))
    return result + (f' {more}' if more else '') + _gross(discovery)


def _result(discovery: Discovery, confirmation: Confirmation | None, *, left: bool) -> str:
    gain = discovery.gain
    change = ''
    if words := held_out_words(gain):
        change = f' The error on poses it never fitted: {words}.'
    doubt = ''
    if not discovery.fit.sampler.converged:
        doubt = f' How uncertain the figures are is not known: {discovery.fit.sampler.message}.'
    change += doubt
    if discovery.verdict == 'none':
        if discovery.gain.held_out_rms_before_m is None:
            return (
                'Nothing was found beyond the zero-offsets and the noise, but no poses were held '
                f'out to check it: measure some and search again.{doubt}'
            )
        seen = f'that moves the marker by less than {1e3 * least_seen_m(discovery):.2f} mm RMS'
        if not _would_show(discovery):
            return (
                'Nothing was found beyond the zero-offsets and the noise, but '
                f'{len(discovery.residuals)} readings would not show a cause {seen}: measure more '
                f'poses.{doubt}'
            )
        nothing = 'Nothing was found' if left else 'Nothing is there'
        return (
            f'{nothing} beyond the zero-offsets and the noise; a cause {seen} would not '
            f'show.{change}'
        )
    if discovery.verdict == 'unexplained':
        return f'Something is there that no cause explains.{change}'
    count = len(discovery.effects)
    causes = 'one cause' if count == 1 else f'{count} causes'
    if discovery.verdict == 'undetermined':
        return (
            f'Something is there, but two explanations fit equally well: see which measurements '
            f'would decide.{change}'
        )
    change += _uncertain(discovery)
    if confirmation is not None and not confirmation.confirmed:
        change += f' The other session does not confirm {"it" if count == 1 else "them"}' + (
            '.'
            if confirmation.why
            else f': its error is {1e3 * confirmation.rms_after_m:.3f} mm RMS with and '
            f'{1e3 * confirmation.rms_before_m:.3f} mm without.'
        )
    elif confirmation is not None and confirmation.gone:
        change += ' Not all of it is there in the other session.'
    return f'Beyond the zero-offsets there {"is" if count == 1 else "are"} {causes}.{change}'
