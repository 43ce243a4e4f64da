"""What a discovery is worth, in a headline: green where held-out poses bear it out, else amber."""

from __future__ import annotations

import msgspec
import numpy as np

from remaster_ros.calibration.measured_again import MeasuredAgain
from remaster_ros.calibration.noise_check import SPOILT
from remaster_ros.discovery.confirmation import Confirmation, in_words
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import UNCERTAIN
from remaster_ros.discovery.gain import held_out_words
from remaster_ros.discovery.words import sentence_case
from remaster_ros.reports.discovery_schema import Discovered
from remaster_ros.reports.schemas import Judgement

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
    if any(effect.sigmas < UNCERTAIN for effect in discovery.effects):
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
    names = [
        sentence_case(effect.title) for effect in discovery.effects if effect.sigmas < UNCERTAIN
    ]
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
