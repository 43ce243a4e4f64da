# SPDX-License-Identifier: Apache-2.0
"""Sentences on a fit and its causes: judgement (green, amber or red) and reasons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType

from remaster_ros.calibration.convergence import SamplerInfo
from remaster_ros.calibration.dynamics import MODES, late_words
from remaster_ros.calibration.gauge_words import counted, in_a_line, listed
from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.motion_proof import MotionProof
from remaster_ros.calibration.noise_check import SPOILT, NoiseCheck
from remaster_ros.calibration.predictions import Coverage
from remaster_ros.calibration.residual_structure import FEWEST_POSES
from remaster_ros.compensation.export import APPLY_FOLDER, LAYER_FILE, REMASTER_FILE, URDF_FILE
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.thinning import Thinning
from remaster_ros.discovery.words import (
    called,
    part_words,
    percent,
    probability_text,
    sentence_case,
    shown,
)
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.reports.schemas import (
    Clock,
    Discovered,
    Fit,
    FittedGeometry,
    Imitation,
    JointOffset,
    Judgement,
    Loadable,
    MeasuredSession,
)

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.confirmation import Confirmation
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.discovery.gain import Gain
    from remaster_ros.types import Session


# Least ratio of errors that counts as a noticeable gain.
NOTICEABLE_GAIN = 1.1
# Least number of held-out poses that prove a gain.
FEWEST_HELD_OUT = 3
FEW_POSES = 'So few poses do not show'
NOT_PROVEN = 'No poses were held out, so the gain is not proven: measure some, and run this again.'
NO_TIMES = 'without times, so nothing that changes with time can be seen'
# Titles of the metrics of fit.json.
METRICS = {
    'post_registration': 'position, sensor registered (eq. 18)',
    'post_registration_orientation': '… orientation',
    'relative': 'distances between solutions of a pose (eq. 17)',
    'relative_orientation': '… angles',
    'theoretical': 'what the posterior predicts (section V-C)',
    'paper_theoretical': '… in the robot base, offsets alone, as the paper has it',
    'theoretical_random': 'the same at 1,000 random configurations',
    'paper_theoretical_random': '… in the robot base, as the paper has it',
}
# A cause with more parameters, such as a curve, has one line in tables; discovery.json has all.
MOST_PARAMETERS = 8


def hardly_proven(held_out_poses: int) -> str:
    """Sentence that fewer than 3 poses were held out (`FEWEST_HELD_OUT`); '' if none or enough."""
    if not 0 < held_out_poses < FEWEST_HELD_OUT:
        return ''
    return (
        f'Only {counted(held_out_poses, "pose")} {"was" if held_out_poses == 1 else "were"} held '
        'out, which proves little: hold out some ten.'
    )


def _held_out_poses(session: Session) -> int:
    """Number of held-out poses of a session."""
    m = session.measurements
    return len(np.unique(m.pose[m.is_validation]))


def not_counted(gross: int) -> str:
    """Text such as '3 gross errors not counted'."""
    return f'{counted(gross, "gross error")} not counted'


def times_smaller(before: float, after: float) -> str:
    """Text such as '9.0 times smaller'."""
    times = before / max(after, 1e-9)
    return f'{times:.{1 if times < 10 else 0}f} times smaller'


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
    hardly = hardly_proven(_held_out_poses(result.session))
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


SEARCH = 'run "remaster discover"'


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


# Judgement of a discovery: green if held-out poses confirm it, else amber.

# Least share of held-out rows in their 95 % regions; below it the regions are too small.
FEWEST_INSIDE = 0.92
# Largest ratio of the error on held-out poses to the noise, apart from chance with few rows.
MOST_OVER_NOISE = 1.25
FEW_HELD_OUT = 'by chance, as so few poses were held out'
# If a cause could move the marker by more than this share of the noise without being found, the
# verdict "none" proves nothing.
MOST_UNSEEN = 0.5
# Estimated noise over what is left from which on it is no measure of the noise: by a dozen
# independent readings, as of an arm that moved for a minute, it is uncertain by a fifth.
NOT_ABOVE = 1.2
# Size in standard deviations from which on a cause is found.
DETECTED = 4.5


def judgement(
    discovery: Discovery, confirmation: Confirmation | None, content: Discovered
) -> Judgement:
    """Judgement of a discovery: 'good' if its verdict is proven and no data disagree.

    Else 'caution'. Data disagree by errors above the noise, by differences between repeated
    measurements, or by disagreements of the session. ``content``: the content of discovery.json.
    """
    more = more_than_noise(content)
    again = MeasuredAgain.of(discovery.fit.session.measurements)
    disagreements = discovery.fit.session.disagreements
    proven = _is_proven(discovery, confirmation) and not (more or again.most or disagreements)
    # What discovers takes half a second to import, and a fit needs none of it.
    from remaster_ros.discovery.confirmation import in_words

    points = in_words(discovery, confirmation) if confirmation is not None else []
    note = discovery.fit.session.correction_note
    return Judgement(
        mood='good' if proven else 'caution',
        headline=headline(discovery, confirmation, more),
        points=points,
        doubts=[
            words
            for words in (
                *disagreements,
                again.words if again.again else '',
                hardly_proven(_held_out_poses(discovery.fit.session)),
                note,
            )
            if words
        ],
    )


def more_than_noise(content: Discovered) -> str:
    """Sentence that held-out rows show an error that the model does not have; '' if not.

    Below 92 % of them surely in their regions (`FEWEST_INSIDE`), or an RMS error above 1.25 times
    the noise (`MOST_OVER_NOISE`), plus 1 / √rows.
    """
    finding = 'something is left that the model does not have.'
    if isinstance(content.session, Struct) and content.session.validation.poses < FEWEST_HELD_OUT:
        # The rows of a pose share its error, which may be large by chance.
        finding = f'{FEW_HELD_OUT}, or {finding}'
    regions, gain = content.predicted_regions95, content.gain
    if isinstance(regions, msgspec.UnsetType) or regions.held_out.interval95 is None:
        return ''
    if regions.held_out.interval95[1] < FEWEST_INSIDE:
        return f'Fewer held-out rows than should lie where they were predicted: {finding}'
    after = gain.held_out_kept_after_m
    if after is None:
        after = gain.held_out_rms_after_m
    most = MOST_OVER_NOISE + regions.held_out.rows**-0.5
    if after is not None and after > most * gain.noise_floor_m:
        return (
            f'The error on held-out poses is {after / gain.noise_floor_m:.1f} times that of the '
            f'noise alone: {finding}'
        )
    return ''


def _is_proven(discovery: Discovery, confirmation: Confirmation | None) -> bool:
    """Whether held-out poses, and the other session if there is one, agree with the verdict.

    False without held-out poses, for causes that are not certain or came at a moment, and if the
    sampling has not converged.
    """
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
    if _spoilt(discovery) or hardly_proven(_held_out_poses(discovery.fit.session)):
        return False
    if discovery.verdict == 'none':
        return _would_show(discovery)
    return after < before and (confirmation is None or confirmation.confirmed)


def least_seen_m(discovery: Discovery) -> float:
    """Smallest RMS displacement of the marker, m, by a cause that would be found.

    After everything else is fitted again it amounts to `DETECTED` standard deviations of all rows
    together.
    """
    numbers = discovery.residuals.errors.size
    return float(DETECTED * discovery.gain.noise_floor_m / np.sqrt(numbers))


def _spoilt(discovery: Discovery) -> bool:
    """Whether gross errors make the error on held-out poses over 1.5 times larger (`SPOILT`)."""
    every, kept = discovery.gain.held_out_rms_after_m, discovery.gain.held_out_kept_after_m
    return every is not None and kept is not None and every > SPOILT * kept


def _gross(discovery: Discovery) -> str:
    """Sentence on the number of gross errors, with a leading blank; '' if there are none."""
    count, of = len(discovery.outliers), len(discovery.residuals.context.measurements)
    if not count:
        return ''
    return (
        f' {count} of {of} readings {"are gross errors" if count > 1 else "is a gross error"}, '
        'which no cause explains: find out what was moved, hidden or paired wrongly then.'
    )


def _would_show(discovery: Discovery) -> bool:
    """Whether a cause of half the noise (`MOST_UNSEEN`) at the marker would have been found."""
    return least_seen_m(discovery) < MOST_UNSEEN * discovery.gain.noise_floor_m


def _uncertain(discovery: Discovery) -> str:
    """Sentence on causes that are not certain, with their probabilities and a leading blank.

    '' if there are none.
    """
    names = [
        f'{sentence_case(effect.title)} (probability {probability_text(effect.probability)})'
        for effect in discovery.effects
        if not effect.is_certain
    ]
    return f' Not certain: {", ".join(names)}.' if names else ''


def headline(
    discovery: Discovery, confirmation: Confirmation | None = None, more: str = ''
) -> str:
    """Result of a discovery in one or a few sentences.

    ``confirmation``: by another session; ``more``: finding on held-out rows, of `more_than_noise`.
    """
    result = _result(
        discovery, confirmation, something_left=bool(more) or bool(discovery.outliers)
    )
    return result + (f' {more}' if more else '') + _gross(discovery)


def _result(
    discovery: Discovery, confirmation: Confirmation | None, *, something_left: bool
) -> str:
    """Sentences on the verdict and the errors on held-out poses.

    ``something_left``: whether gross errors or more than noise are left.
    """
    gain = discovery.gain
    change = ''
    if words := _held_out(gain):
        change = f' The error on poses it never fitted: {words}.'
    doubt = ''
    if not discovery.fit.sampler.converged:
        doubt = (
            ' How uncertain these figures are is not known, as the sampling has not converged: '
            'search again with another --seed, or measure more poses.'
        )
    change += doubt
    if discovery.verdict == 'none':
        if discovery.gain.held_out_rms_before_m is None:
            return (
                'Nothing was found beyond the zero-offsets and the noise, but no poses were held '
                f'out to check it: measure some and search again.{doubt}'
            )
        least_mm = 1e3 * least_seen_m(discovery)
        digits = max(2, 1 - int(np.floor(np.log10(least_mm))))
        seen = f'that moves the marker by less than {least_mm:.{digits}f} mm RMS'
        if not _would_show(discovery):
            return (
                'Nothing was found beyond the zero-offsets and the noise, but '
                f'{len(discovery.residuals)} readings would not show a cause {seen}: measure more '
                f'poses.{doubt}'
            )
        nothing = 'Nothing was found' if something_left else 'Nothing is there'
        return (
            f'{nothing} beyond the zero-offsets and the noise; a cause {seen} would not '
            f'show.{change}'
        )
    if discovery.verdict == 'unexplained':
        return (
            'Errors remain that no known cause explains: see where they are and what to measure '
            f'next.{change}'
        )
    count = len(discovery.effects)
    causes = 'one cause' if count == 1 else f'{count} causes'
    if discovery.verdict == 'undetermined':
        return (
            'There is an error beyond the zero-offsets, but two causes explain it equally well: '
            f'see which measurements would decide.{change}'
        )
    change += _uncertain(discovery)
    them = 'it' if count == 1 else 'them'
    if confirmation is not None and not confirmation.why and confirmation.carries_over:
        if not confirmation.same_offsets:
            change += f' The other session has {them} too, with other zero-offsets.'
        elif confirmation.gone:
            change += ' Not all of it is there in the other session.'
    elif confirmation is not None:
        change += f' The other session does not confirm {them}' + (
            '.'
            if confirmation.why
            else f': its error is {1e3 * confirmation.rms_after_m:.3f} mm RMS with and '
            f'{1e3 * confirmation.rms_before_m:.3f} mm without.'
        )
    return f'Beyond the zero-offsets there {"is" if count == 1 else "are"} {causes}.{change}'


def _held_out(gain: Gain) -> str:
    """RMS errors on held-out poses before and after, and the noise, in words; '' without any."""
    before, after = gain.held_out_kept_before_m, gain.held_out_kept_after_m
    if before is None or after is None or gain.held_out_rms_after_m is None:
        return ''
    words = f'{1e3 * before:.3f} mm RMS before, {1e3 * after:.3f} mm after; '
    noise = f'{1e3 * gain.noise_floor_m:.3f} mm'
    if gain.noise_floor_m > NOT_ABOVE * after:
        words += f'the noise is hardly known: {noise} as estimated'
    else:
        words += f'the noise alone is {noise}'
    if gain.held_out_gross:
        words += (
            f'; {not_counted(gain.held_out_gross)} '
            f'(with them {1e3 * gain.held_out_rms_after_m:.3f} mm after)'
        )
    return words


# Texts of single facts, the same on the terminal, on a page and in a file.


def counts_words(session: MeasuredSession) -> str:
    """Numbers of fitted and held-out observations, as text."""
    fitted, held_out = (
        f'({counts.configurations} configurations of {counts.poses} poses)'
        for counts in (session.optimization, session.validation)
    )
    return (
        f'{session.optimization.observations} observations fitted {fitted}, '
        f'{session.validation.observations} held out {held_out}'
    )


def at_marker(size_m: float) -> str:
    """Size of an error, m, as text: '0.123 mm RMS at the marker'."""
    return f'{1e3 * size_m:.3f} mm RMS at the marker'


def size_words(effect: FoundEffect) -> str:
    """Size of a cause, and the share of the gain that is lost without it, as text.

    '' in files of other programs, which have no size.
    """
    if np.isnan(effect.size_m):
        return ''
    if effect.share is None:
        return at_marker(effect.size_m)
    lost = f'without it {percent(effect.share)} of the gain is lost'
    return f'{at_marker(effect.size_m)}, {lost}'


def look_alike_name(effect: FoundEffect, other: LookAlike) -> str:
    """Name of a look-alike of a cause, capitalized; one of its parts is named as such."""
    fewer = part_words(effect.name, effect.joints, other.name, other.joints)
    return fewer or sentence_case(other.title or called(other.name, other.joints))


def _of_probability(other: LookAlike) -> str:
    """Probability of a look-alike as ' (probability 12 %)'; '' if unknown."""
    if other.probability is None:
        return ''
    return f' (probability {probability_text(other.probability)})'


def coverage_words(held_out: Coverage, gross: int) -> str:
    """Share of held-out rows in their predicted regions, as text; '' if there are none.

    ``gross``: number of held-out rows that are gross errors.
    """
    if held_out.share is None:
        return ''
    return (
        f'{held_out.inside} of {held_out.rows} held-out rows ({percent(held_out.share)}) lie in '
        'the regions predicted for them with 95 %' + (f'; {not_counted(gross)}' if gross else '')
    )


EXACTLY_DRAWN = 'if the arm is exactly its drawing'


def std_remark(tolerance_m: float) -> str:
    """Sentence for files on what the standard deviations of offsets include."""
    return (
        'The standard deviations contain what links and axes that are off their drawing by '
        f'{1e3 * tolerance_m:.2g} mm would do to the offsets.'
    )


def as_drawn(geometry: FittedGeometry, imitations: Sequence[Imitation]) -> str:
    """Clause on what the standard deviations of the offsets contain of links off their drawing.

    ``imitations``: the largest ones, each a link or axis and its effect on a joint.
    """
    moved = '; '.join(
        f'{"link" if imitation.cause == "link_length" else "the axis of joint"} {imitation.of} is '
        f'{imitation.shown} at {imitation.joint}'
        for imitation in imitations
    )
    return (
        'the standard deviations contain links and axes off their drawing: '
        f'{geometry.tolerance_mm:.2g} mm at {moved}'
    )


def loadable_of_fit(geometry: FittedGeometry) -> list[Loadable]:
    """Results of a fit that a robot can load: zero-offsets alone, then the robot model."""
    return [
        Loadable(
            'offsets', geometry.drawing_held_out_mean_mm, True, f'{APPLY_FOLDER}/{URDF_FILE}'
        ),
        Loadable('geometry', geometry.held_out_mean_mm, bool(geometry.file), geometry.file),
    ]


def load_words(row: Loadable) -> tuple[str, str]:
    """Name of a loadable result, and its file or why to leave it, as text.

    It is left if it has no file, or held-out poses do not show that it is better than a plainer
    one.
    """
    file = f'{row.file}{_MORE.get(row.result, "")}'
    worse = row.result != 'offsets' and row.held_out_mean_mm is not None and not row.better
    if worse and row.result == 'everything' and row.file:
        # Better than the offsets alone, or the file would not hold it.
        what_to_do = f'only where no robot model can be loaded: {file}'
    elif worse:
        what_to_do = 'leave it: not clearly better than a plainer one'
    elif row.file:
        what_to_do = file
    elif row.held_out_mean_mm is None:
        what_to_do = 'leave it: no held-out poses show that it is better'
    else:
        what_to_do = 'leave it: no file holds it'
    return _RESULTS[row.result], what_to_do


_RESULTS = {
    'offsets': 'zero-offsets alone',
    'geometry': 'all lengths, tilts and zero-offsets together',
    'everything': 'everything that a command can correct',
}
_MORE = {
    'offsets': f', {REMASTER_FILE} or {LAYER_FILE}',
    'everything': ', by remaster compensate or remaster_ros.read_compensation',
}


# A whole result on the terminal, from the content of its file.


def fit_lines(fit: Fit) -> list[str]:
    """Offsets, errors and verdict of a fit, a line each; the fit has to have a judgement.

    Then clocks, geometry and gross errors, if there are any.
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
    """Lines on how late the stamps of each sensor are, and what to do; [] without clocks."""
    if not isinstance(clocks, dict):
        return []
    return [
        f"{name}'s stamps are {late_words(1e-3 * clock.late_ms, 1e-3 * clock.std_ms)} beside "
        'those of the joint states; taken out here. To do: synchronise the clocks (PTP), or state '
        'it to what joins their data (import --clock-offset)'
        for name, clock in clocks.items()
    ]


def motion_rows(fit: Fit) -> list[tuple[str, str]]:
    """What a fit of motion says besides the offsets: quantity and value, as text; [] without.

    How late the stamps of each sensor are, lag and wind-up of each joint, the frequency at which
    the tool swings, and the held-out errors in motion and at standstill.
    """
    if not isinstance(fit.clocks, dict) or not isinstance(fit.parameters, list):
        return []
    rows = [
        (f'stamps of {name}', late_words(1e-3 * clock.late_ms, 1e-3 * clock.std_ms))
        for name, clock in fit.clocks.items()
    ]
    effects = {p.name.removeprefix('effect.'): p for p in fit.parameters}
    for number, joint in enumerate(fit.joint_offsets, start=1):
        lag, windup = effects.get(f'lag_{number}'), effects.get(f'windup_{number}')
        if lag is None or windup is None:
            continue
        scale = 1e3 if joint.unit == 'mm' else np.degrees(1.0)
        rows.append(
            (
                joint.joint,
                f'reported {late_words(lag.mean, lag.std)}; wind-up by friction '
                f'{scale * abs(windup.mean):.4f} ± {scale * windup.std:.4f} '
                f'{joint.unit}',
            )
        )
    modes = [effects[name] for name in MODES[:3] if name in effects]
    swings = [1.0 / (2.0 * np.pi * np.sqrt(m.mean)) for m in modes if m.mean > 3.0 * m.std]
    if swings:
        rows.append(('the tool swings at', f'{min(swings):.1f} to {max(swings):.1f} Hz'))
    if isinstance(proof := fit.motion_proof, MotionProof):
        rows.append(
            (
                f'error in motion, at up to {proof.fastest_mm_s:.0f} mm/s',
                f'{proof.motion_mm:.3f} mm; at standstill {proof.standstill_mm:.3f} mm (held out, '
                'mean of the markers)',
            )
        )
    return rows


def _offset(row: JointOffset) -> str:
    """Offset of a joint ± its std as text, or why it is not identifiable."""
    if not row.identifiable:
        return f'   not identifiable: {in_a_line(row.why)}'
    mean, std, drawn = (
        getattr(row, f'{key}_{row.unit}') for key in ('mean', 'std', 'std_if_exactly_drawn')
    )
    narrower = '' if drawn is UNSET else f' ({drawn:.4f} {EXACTLY_DRAWN})'
    return f'{mean:+9.4f} ± {std:.4f} {row.unit}{narrower}'


def _to_load(rows: Sequence[Loadable], effects: Sequence[FoundEffect] = ()) -> list[str]:
    """Lines on the results that can be loaded: name, error on held-out poses, file.

    ``effects``: causes, of which measuring errors that were taken out are mentioned.
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
    """Verdict, causes, loadable results, and coverage of held-out rows, in lines."""
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
