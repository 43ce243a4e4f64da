"""Sizes in sentences: arc minutes and millimetres with their uncertainty.

Each effect has a function of context, candidate and draws of its parameters (draws, m) that
returns what the candidate amounts to in this session, as part of a sentence.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.types import FloatArray

ARC_MINUTE = np.radians(1.0 / 60.0)
MM = 1e-3
# Behind the point; what would take more is certain.
MOST_DIGITS = 9


def number(value: float, std: float, unit: str) -> str:
    """Return value and standard deviation as text, rounded by the latter: '5.1′ ± 0.3′'."""
    text, std_text = rounded(value, std)
    return f'{text}{unit} ± {std_text}{unit}'


def rounded(value: float, std: float, sign: str = '-') -> tuple[str, str]:
    """Return value and standard deviation as texts with as many decimals as the latter warrants.

    One significant digit of the standard deviation, two if it begins with 1; 3 decimals if it
    is 0 or not finite. With ``sign`` '+' a positive value has a sign, too.
    """
    digits = 3
    if std > 0.0 and np.isfinite(std):
        exponent = int(np.floor(np.log10(std)))
        leading = std / 10.0**exponent
        digits = min(max(0, -exponent + (leading < 2.0)), MOST_DIGITS)
    text = f'{value:{sign}.{digits}f}'
    if float(text) == 0.0:
        text = text.removeprefix('-')
    return text.replace('-', '−'), f'{std:.{digits}f}'


def angle(values: FloatArray) -> str:
    """Return mean ± standard deviation of angles, rad, (draws,), in arc minutes: '5.1′ ± 0.3′'."""
    return number(float(np.mean(values) / ARC_MINUTE), float(np.std(values) / ARC_MINUTE), '′')


def length(values: FloatArray) -> str:
    """Return mean ± standard deviation of lengths, m, (draws,), in mm: '1.2 mm ± 0.3 mm'."""
    return number(float(np.mean(values) / MM), float(np.std(values) / MM), ' mm')


def of_joint(context: Context, joint: int, values: FloatArray) -> str:
    """Return a joint's motion as text: as `angle`, or as `length` if the joint slides.

    ``joint``: 1-based; ``values``: draws, rad or m, (draws,).
    """
    return length(values) if context.slides(joint) else angle(values)


def span_of(context: Context, joint: int, span: float) -> str:
    """Return a joint's (1-based) span, rad or m, as text: '90°', or '600 mm' if it slides."""
    shown = context.chain.shown_scale[joint - 1] * span
    return f'{shown:.0f} mm' if context.slides(joint) else f'{shown:.0f}°'


def along_mean(draws: FloatArray) -> FloatArray:
    """Return the components of draws, (draws, c), along the direction of their mean, (draws,).

    Their mean and spread are those of a size. Lengths of the draws would be biased: too large on
    the average and too close to each other if the draws lie about zero.
    """
    mean = draws.mean(axis=0)
    along: FloatArray = draws @ (mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny))
    return along


def largest(values: FloatArray) -> float:
    """Return the largest absolute value; 0 if there are no values."""
    return float(np.abs(values).max(initial=0.0))


def at_most(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Return the largest error by a candidate as text: of a joint, less its mean, or of a marker.

    ``draws``: of its parameters, (draws, m). The error is taken in the row where it is largest at
    the mean of the draws, with its spread over the draws.
    """
    columns = candidate.columns(context)
    if columns.at is not None:
        turns = columns.values - columns.values.mean(axis=0)
        row = int(np.argmax(np.abs(turns @ draws.mean(axis=0))))
        return of_joint(context, columns.at + 1, along_mean(draws @ turns[[row]].T))
    row = int(np.argmax(np.linalg.norm(columns.values @ draws.mean(axis=0), axis=1)))
    return length(along_mean(draws @ columns.values[row].T))


def up_to(words: str) -> Callable[[Context, Candidate, FloatArray], str]:
    """Return a function for the size of a candidate as text: 'joint 2 errs by up to 5.1′ ± 0.3′'.

    ``words``: beginning of the text, in which ``{joint}``, ``{other}`` (the joint that drives)
    and ``{subject}`` are filled in. The function takes context, candidate and draws.
    """

    def size(context: Context, candidate: Candidate, draws: FloatArray) -> str:
        joint = candidate.joints[0] if candidate.joints else ''
        start = words.format(
            joint=joint,
            other=candidate.joints[-1] if candidate.joints else '',
            subject=candidate.subject,
        )
        return f'{start} by up to {at_most(context, candidate, draws)}'

    return size
