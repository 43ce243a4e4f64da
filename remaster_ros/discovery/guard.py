"""No causes that do worse than the zero-offsets alone: the last check, on poses never fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from msgspec import Struct

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.gauge_words import listed
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.explain import FoundEffect, size_of
from remaster_ros.discovery.gain import Gain
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.words import sentence_case
from remaster_ros.errors import InsufficientDataError
from remaster_ros.types import FloatArray

# Kinds of errors that a sentence lists.
MOST_LISTED = 3
# Causes with an error on the held-out poses of so many times that of the offsets are not returned.
MOST_HARM = 1.05


class Unexplained(Struct, frozen=True):
    """Error that no cause explains, with its size and the next step, as in discovery.json."""

    # Where it shows, and what it follows as far as that is known
    where: str
    driver: str
    size_m: float  # RMS of the 3-D error, m
    p_value: float | None  # Of seeing as much by chance; None if too few poses are held out
    next: str  # What it means and what to do next, one or two sentences


def located(structure: Sequence[FoundEffect]) -> tuple[Unexplained, ...]:
    """Return an entry for each structure without a cause that the search has located.

    ``structure``: such as a sensor's field or wander.
    """
    return tuple(
        Unexplained(found.place, found.driver, found.size_m, found.p_value, found.cause)
        for found in structure
    )


def suggested(effects: Sequence[FoundEffect]) -> str:
    """Return the titles of causes as a list in words; '' for none.

    With the minute after the first reading for those that happened at a moment.
    """
    words = []
    for effect in effects:
        word = sentence_case(effect.title)
        if effect.moment_s is not None:
            word += f' {effect.moment_s / 60.0:.1f} min after the first reading'
        words.append(word)
    return listed(list(dict.fromkeys(words)))


def is_harmful(gain: Gain) -> bool:
    """Return whether causes make the error on held-out poses larger by more than 5 %.

    Gross errors are not counted. False if no poses are held out.
    """
    # Gross errors, which are there with and without causes, would hide what these do.
    before, after = gain.held_out_kept_before_m, gain.held_out_kept_after_m
    return before is not None and after is not None and after > MOST_HARM * before


def harm_of(
    found: Estimate, fit: FitResult, gain: Gain, effects: Sequence[FoundEffect]
) -> Unexplained:
    """Return an entry on errors whose suggested causes were discarded because they do harm.

    ``found``: fit with offsets only; ``fit``: sampled fit with the causes; ``gain``: its
    errors, with held-out rows; ``effects``: the causes.
    """
    measurements = found.problem.measurements
    rows = measurements.is_validation
    pose = np.unique(measurements.pose[rows], return_inverse=True)[1]

    def by_pose(errors: FloatArray) -> FloatArray:
        return np.bincount(pose, np.sum(errors[rows] ** 2, axis=1)) / np.bincount(pose)

    before = by_pose(
        measurements.position - predicted_rows(found.problem, found.model, found.mode.z)
    )
    change = np.log(by_pose(fit.residuals_after) / before)
    p_value = None
    if len(change) > 1 and np.ptp(change) > 0.0:
        count = len(change)
        student = np.mean(change) / np.std(change, ddof=1) * np.sqrt(count)
        p_value = float(scipy.special.stdtr(count - 1, -student))
    names = suggested(effects)
    before_m, after_m = gain.held_out_kept_before_m, gain.held_out_kept_after_m
    assert before_m is not None
    assert after_m is not None
    return Unexplained(
        where='held_out_poses',
        driver='unknown',
        size_m=before_m,
        p_value=p_value,
        next=(
            f'The residuals suggest {names}, but with that the error on the held-out poses goes '
            f'from {1e3 * before_m:.3f} to {1e3 * after_m:.3f} mm RMS: it is not taken as a '
            'cause. Measure poses that are spread as the arm is used, over the whole region and '
            'with the tool turned, and search again.'
        ),
    )


def unfitted(
    errors: FloatArray, effects: Sequence[FoundEffect], reason: InsufficientDataError
) -> Unexplained:
    """Return an entry on errors whose suggested causes cannot be fitted along with the offsets.

    ``errors``: residuals that the causes were to explain, m, (n, 3); ``effects``: the suggested
    causes; ``reason``: why they cannot be fitted.
    """
    names = suggested(effects)
    return Unexplained(
        where='residuals',
        driver='unknown',
        size_m=float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        p_value=None,
        next=(
            f'The residuals suggest {names}, but these poses do not determine that together with '
            f'everything else ({reason}): it is not taken as a cause. Measure poses that are '
            'spread further and turn the tool, and search again.'
        ),
    )


def nameless(data: Residuals, solution: Solution, p_value: float) -> Unexplained:
    """Return an entry on errors that are more than noise, but have no single likely cause.

    ``solution``: fit with the candidates of all kinds of errors at once; ``p_value``: probability
    of such a gain in pure noise.
    """
    kinds: dict[str, list[Candidate]] = {}
    for candidate in solution.candidates:
        kinds.setdefault(candidate.name, []).append(candidate)
    sizes = {name: size_of(data, solution, candidates) for name, candidates in kinds.items()}
    order = sorted(sizes, key=lambda name: -sizes[name])
    first, size = kinds[order[0]][0], size_of(data, solution, solution.candidates)
    words = [
        f'{name.replace("_", " ")} ({1e3 * sizes[name]:.3f} mm)' for name in order[:MOST_LISTED]
    ]
    return Unexplained(
        where=first.place,
        driver=first.driver,
        size_m=size,
        p_value=p_value,
        next=(
            f'Errors of {1e3 * size:.3f} mm RMS at the marker are more than noise, but no single '
            f'cause stands out of them; the most may be {listed(words)}. Offsets and predictions '
            'have them in their uncertainty. Measure more poses, spread further and with the tool '
            'turned, and search again.'
        ),
    )
