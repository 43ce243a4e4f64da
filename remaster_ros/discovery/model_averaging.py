"""What look-alikes add to the posterior: averaging over sets that explain as much.

Where another cause in the place of one that was found has an evidence of exp(Δ) times, the data
say as little which of the two it is. The posterior is a mixture of both (Hoeting et al. 1999,
Statist. Sci. 14, 382). About the estimate of the set that was chosen its covariance is larger by::

    Σ w_k (θ_k - θ)(θ_k - θ)',   w_k = exp(Δ_k) / (1 + Σ exp(Δ_j))

with all parameters θ_k of the set with look-alike k, those of the cause itself 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import softmax

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.selection import Selection
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.undetected import natural_parameters
from remaster_ros.types import FloatArray


def moved_by_look_alikes(
    found: Estimate,
    data: Residuals,
    selection: Selection,
    effects: Sequence[FoundEffect],
    groups: Sequence[tuple[Cell, ...]],
) -> FloatArray:
    """Return how look-alikes in the place of causes move the parameters, one std of each.

    Other names of the same displacement, and free forms of which a cause is a special case, are
    no other answers.

    Parameters
    ----------
    found
        The fit that the search began with.
    data, selection
        What it worked on and found; look-alikes stand beside what the search of all rows found.
    effects, groups
        The causes, and the cells of each; causes without cells come last.

    Returns
    -------
    ndarray
        (size + m, c) for all natural parameters of the fit and the m of the solution's cells.
    """
    solution, chosen = selection.solution, selection.chosen
    own = natural_parameters(found, data, solution, chosen)
    moves = [np.zeros((len(own), 0))]
    for effect, group in zip(effects, groups, strict=False):
        rest = [cell for cell in chosen.cells if cell not in group]
        rivals = [
            (alike.log_evidence_gain - effect.log_evidence_gain, other)
            for alike in effect.confusable_with
            if not (alike.same or alike.general)
            if (other := _in_its_place(data, chosen, rest, alike)) is not None
        ]
        weights = softmax([0.0, *(gain for gain, _ in rivals)])[1:]
        moves += [
            np.sqrt(weight) * (natural_parameters(found, data, solution, other) - own)[:, None]
            for weight, (_, other) in zip(weights, rivals, strict=True)
        ]
    return np.concatenate(moves, axis=1)


def _in_its_place(
    data: Residuals, solution: Solution, rest: Sequence[Cell], alike: LookAlike
) -> Solution | None:
    """Return the best set with a look-alike beside the rest; None where it adds nothing."""
    fits = [
        solve(data, (*rest, cell), solution)
        for cell in EFFECTS[alike.name].cells(data.context)
        if cell.joints == alike.joints
    ]
    return max(
        (fit for fit in fits if fit is not None), key=lambda fit: fit.log_evidence, default=None
    )
