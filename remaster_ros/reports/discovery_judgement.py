# SPDX-License-Identifier: Apache-2.0
"""Judgement of a discovery: green if held-out poses confirm its verdict, else amber."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec import Struct

from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.noise_check import SPOILT
from remaster_ros.discovery.words import probability_text, sentence_case
from remaster_ros.reports.schemas import Discovered, Judgement
from remaster_ros.reports.sentences import (
    FEWEST_HELD_OUT,
    hardly_proven,
    held_out_poses,
    not_counted,
)

if TYPE_CHECKING:
    from remaster_ros.discovery.confirmation import Confirmation
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.discovery.gain import Gain

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
    """Return the judgement of a discovery: 'good' if its verdict is proven and no data disagree.

    Else 'caution'. Data disagree by errors above the noise, by differences between repeated
    measurements, or by disagreements of the session. ``confirmation``: by another session, or
    None; ``content``: the content of discovery.json.
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
                hardly_proven(held_out_poses(discovery.fit.session)),
                note,
            )
            if words
        ],
    )


def more_than_noise(content: Discovered) -> str:
    """Return a sentence if held-out rows show an error that the model does not have, else ''.

    They do if the upper 95 % limit of the share inside their predicted regions is below 92 %
    (`FEWEST_INSIDE`), or their RMS error is above 1.25 (`MOST_OVER_NOISE`) plus 1 / √rows
    times the noise. '' without held-out rows.
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

    False also without enough held-out poses, for causes that are not certain or happened at a
    moment, for errors without a cause, and if the sampling has not converged.
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
    if _spoilt(discovery) or hardly_proven(held_out_poses(discovery.fit.session)):
        return False
    if discovery.verdict == 'none':
        return _would_show(discovery)
    return after < before and (confirmation is None or confirmation.confirmed)


def least_seen_m(discovery: Discovery) -> float:
    """Return the smallest RMS displacement of the marker by a cause that would be found, m.

    It is `DETECTED` times the noise over the square root of the number of measured coordinates.
    """
    numbers = discovery.residuals.errors.size
    return float(DETECTED * discovery.gain.noise_floor_m / np.sqrt(numbers))


def _spoilt(discovery: Discovery) -> bool:
    """Whether gross errors make the RMS error on held-out poses over 1.5 times larger (`SPOILT`).

    False without held-out poses.
    """
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
    """Whether a cause that moves the marker by half the noise (`MOST_UNSEEN`) would be found."""
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
    """Return the result of a discovery in one or a few sentences.

    ``confirmation``: by another session, or None; ``more``: result of `more_than_noise`.
    """
    result = _result(
        discovery, confirmation, something_left=bool(more) or bool(discovery.outliers)
    )
    return result + (f' {more}' if more else '') + _gross(discovery)


def _result(
    discovery: Discovery, confirmation: Confirmation | None, *, something_left: bool
) -> str:
    """Return sentences on the verdict and the errors on held-out poses.

    ``confirmation``: by another session, or None; ``something_left``: whether there are gross
    errors, or held-out errors above the noise.
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
