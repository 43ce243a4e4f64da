# SPDX-License-Identifier: Apache-2.0
"""Content of discovery.json (format ``remaster-discovery/1``)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.predictions import Coverage, Predictions, predict
from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.decision import Decision
from remaster_ros.discovery.discover import Discovery
from remaster_ros.reports import schemas
from remaster_ros.reports.discovery_judgement import judgement
from remaster_ros.reports.fit_json import (
    DISCOVERY_FILE,
    clocks_content,
    estimates,
    of_joints,
    read_result,
)
from remaster_ros.reports.loadable import loadable
from remaster_ros.reports.schemas import Discovered
from remaster_ros.session.json_records import checked
from remaster_ros.version import __version__


def _with_exact_drawing(
    discovery: Discovery, rows: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Copies of rows of zero-offsets, with their std for an arm of exactly nominal geometry.

    ``rows``: one for each joint. Added as ``std_if_exactly_drawn_deg`` (or ``_mm``); left out for
    an offset that is not identifiable or whose std is not finite.
    """
    drawn = of_joints(discovery.fit.chain, std_if_exactly_drawn=discovery.std_if_drawn)
    found = []
    for row, exact in zip(rows, drawn, strict=True):
        key = f'std_if_exactly_drawn_{row["unit"]}'
        known = row['identifiable'] and np.isfinite(exact[key])
        found.append({**row, key: exact[key]} if known else {**row})
    return found


def predictions_of(discovery: Discovery) -> Predictions:
    """Predict every row of the session, held-out rows as well, by the sampled fit."""
    context = discovery.residuals.context
    return predict(discovery.fit, context.measurements)


def discovery_content(
    discovery: Discovery,
    confirmation: Confirmation | None = None,
    predictions: Predictions | None = None,
    decided: Sequence[Decision] = (),
) -> Discovered:
    """Return the content of discovery.json, checked against its schema.

    ``confirmation``: by another session; ``predictions``: computed if None; ``decided``:
    decisions between causes and look-alikes.
    """
    predictions = predictions_of(discovery) if predictions is None else predictions
    fit = estimates(discovery.fit)
    before, before_std = discovery.offsets_before
    content: dict[str, Any] = {
        'format': schemas.DISCOVERY_FORMAT,
        'version': __version__,
        'robot': fit['robot'],
        'session': fit['session'],
        'verdict': discovery.verdict,
        'effects': discovery.effects,
        'gain': discovery.gain,
        'loadable': loadable(discovery),
        'metrics': discovery.metrics,
        'noise': {
            'pose_common_fraction': discovery.pose_common_fraction,
            'outliers': [observation for observation, _ in discovery.outliers],
            'heteroscedastic': discovery.noise_by_range,
            'sensors': fit['noise'],
        },
        'untestable': discovery.untestable,
        'unexplained': discovery.unexplained,
        'search': discovery.search,
        'joint_offsets_before': [
            {'joint': name, **row}
            for name, row in zip(
                discovery.fit.joint_names,
                of_joints(discovery.fit.chain, mean=before, std=before_std),
                strict=True,
            )
        ],
        'joint_offsets_alone': estimates(discovery.alone)['joint_offsets'],
        'joint_offsets_after': _with_exact_drawing(discovery, fit['joint_offsets']),
        'sampler': fit['sampler'],
        'registration': fit['registration'],
        'markers': fit['markers'],
        'covariance': _covariance(discovery),
        'predicted_regions95': _regions(discovery, predictions),
    }
    if discovery.thinning is not None:
        content['rows_searched'] = discovery.thinning
    if discovery.clocks:
        content['clocks'] = clocks_content(discovery.clocks)
    if decided:
        content['decided'] = decided
    if confirmation is not None:
        content['confirmation'] = confirmation
    found = checked(content, Discovered)
    found.judgement = judgement(discovery, confirmation, found)
    return found


def _covariance(discovery: Discovery) -> dict[str, Any]:
    """Return the posterior covariance of identifiable offsets and the named causes' parameters.

    Keys: names, units and matrix (to six significant digits). compensation.json has that of
    all terms of the model.
    """
    fit = discovery.fit
    units = {n: c.unit for group in discovery.groups for c in group for n in c.parameters}
    known = np.flatnonzero(fit.identifiable)
    causes = [i for i, name in enumerate(fit.theta_names) if name in units]
    draws = np.concatenate((fit.joint_offset_draws[..., known], fit.theta_draws[..., causes]), -1)
    size = draws.shape[-1]
    # A few poses may determine no joint, and show no cause.
    matrix = np.atleast_2d(np.cov(draws.reshape(-1, size), rowvar=False)) if size else ()
    names = [fit.theta_names[i] for i in causes]
    return {
        'names': [*(fit.joint_names[i] for i in known), *names],
        'units': [*(fit.chain.units[i] for i in known), *(units[name] for name in names)],
        'matrix': [[float(f'{value:.5e}') for value in row] for row in matrix],
    }


def _regions(discovery: Discovery, predictions: Predictions) -> dict[str, Any]:
    """Return the shares of held-out and of fitted rows that lie in their predicted 95 % regions.

    Without gross errors; with the factor by which the regions are widened.
    """
    measurements = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    kept = ~np.isin(measurements.observation, gross)
    held_out = measurements.is_validation
    return {
        'widening': predictions.widening,
        'held_out': Coverage.of(predictions.inside[kept & held_out]),
        'fitted': Coverage.of(predictions.inside[kept & ~held_out]),
    }


def read_discovery(path: str | os.PathLike[str]) -> Discovered:
    """Read discovery.json and check it against its schema; unknown keys are dropped.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(
        Path(path), Discovered, schemas.DISCOVERY_FORMAT, DISCOVERY_FILE, 'discover'
    )
