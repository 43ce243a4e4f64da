"""What another session shows of the causes, in sentences."""

from __future__ import annotations

import numpy as np

from remaster_ros.discovery.confirmation import LEAST_GAIN, Confirmation, ConfirmedCause
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.words import percent


def in_words(discovery: Discovery, confirmation: Confirmation) -> list[str]:
    """Return sentences: whose zero-offsets these are, and how far each cause holds there."""
    found = confirmation
    if found.why:
        return [found.why]
    lines = [_summary(found)] if found.effects else []
    offsets = (
        f'they differ by {found.offsets_rms_sigmas:.1f} standard deviations on the average, and '
        f'the error is {1e3 * found.rms_frozen_offsets_m:.3f} mm RMS with those found here'
    )
    if not found.same_offsets and not found.carried_over > 0.5:
        return [
            f'The zero-offsets found here are not those of the other session: {offsets}, '
            f'{1e3 * min(found.rms_own_m, found.rms_before_m):.3f} mm with its own. '
            'That is another arm, or it was mastered anew in between: nothing is confirmed.'
        ]
    if not found.same_offsets:
        lines.append(
            f'The causes hold, but the zero-offsets are others: {offsets}, '
            f'{1e3 * found.rms_after_m:.3f} mm with its own. That is another arm of this kind, or '
            'it was mastered anew in between.'
        )
    elif found.joint_offsets:
        lines.append(
            'With the zero-offsets found here its error is '
            f'{1e3 * found.rms_frozen_offsets_m:.3f} mm RMS, and they are '
            f'{found.offsets_rms_sigmas:.1f} standard deviations apart on the average: it is the '
            'same arm.'
        )
    lines += [
        _share_in_words(effect, cause)
        for effect, cause in zip(discovery.effects, found.effects, strict=False)
    ]
    return lines


def _summary(found: Confirmation) -> str:
    """Return the errors with the causes fitted, frozen and left out."""
    carried = (
        'the causes could gain next to nothing there'
        if np.isnan(found.carried_over)
        else f'{percent(found.carried_over)} of what they could gain there'
    )
    return (
        f'{1e3 * found.rms_before_m:.3f} mm RMS without the causes, {1e3 * found.rms_after_m:.3f} '
        f'mm with them as found here, {1e3 * found.rms_own_m:.3f} mm with them fitted there: '
        f'{carried}. In {found.rows_common} of its {found.rows} rows all that drives them is in '
        'the range seen here; beyond its own range each is fitted to the other session.'
    )


def _share_in_words(effect: FoundEffect, cause: ConfirmedCause) -> str:
    share = cause.carried_over
    name = effect.title
    change = f'{1e3 * cause.rms_without_m:.3f} to {1e3 * cause.rms_frozen_m:.3f} mm RMS'
    if not np.isfinite(cause.rms_frozen_m):
        return f'{name}: the other session does not determine it.'
    if share > 0.5:
        return (
            f'{name}. Confirmed: {percent(share)} of what the other session could gain from it '
            f'({change}).'
        )
    if share > 0.1:
        return (
            f'{name}. Changed: as found here it brings {percent(share)} of what the other session '
            f'could gain from it ({change}).'
        )
    if cause.rms_frozen_m > (1.0 + LEAST_GAIN) * cause.rms_without_m:
        return f'{name}. Not there any more: as found here it goes from {change}.'
    return f'{name}: the other session gains nothing from it ({change}).'
