"""discovery.json: what was found, as other programs read it (format ``remaster-discovery/1``)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.calibration.predictions import Coverage, Predictions, predict
from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.decision import Decision
from remaster_ros.discovery.discover import Discovery
from remaster_ros.reports import schemas
from remaster_ros.reports.discovery_apply import loadable
from remaster_ros.reports.discovery_judgement import judgement
from remaster_ros.reports.discovery_schema import Discovered
from remaster_ros.reports.fit_json import (
    DISCOVERY_FILE,
    estimates,
    read_result,
    table_rows,
)
from remaster_ros.version import __version__


def predictions_of(discovery: Discovery) -> Predictions:
    """Return where the final model predicts every row of the session."""
    context = discovery.residuals.context
    return predict(discovery.fit, context.measurements)


def discovery_content(
    discovery: Discovery,
    confirmation: Confirmation | None = None,
    predictions: Predictions | None = None,
    decided: Sequence[Decision] = (),
) -> Discovered:
    """Return a discovery as discovery.json has it; predictions are made where none are given."""
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
        'metrics': discovery.gain.metrics,
        'noise': {
            'pose_common_fraction': discovery.pose_common_fraction,
            'outliers': [observation for observation, _ in discovery.outliers],
            'heteroscedastic': discovery.noise_by_range,
            'sensors': fit['noise'],
        },
        'untestable': discovery.untestable,
        'unexplained': discovery.unexplained,
        'joint_offsets_before': table_rows(
            joint=discovery.fit.joint_names,
            mean_deg=np.degrees(before),
            std_deg=np.degrees(before_std),
        ),
        'joint_offsets_after': fit['joint_offsets'],
        'sampler': fit['sampler'],
        'registration': fit['registration'],
        'markers': fit['markers'],
        'covariance': _covariance(discovery),
        'predicted_regions95': _regions(discovery, predictions),
    }
    if discovery.thinning is not None:
        content['rows_searched'] = discovery.thinning
    if decided:
        content['decided'] = [
            {
                'cause': one.cause._asdict(),
                'look_alike': one.look_alike._asdict(),
                'answer': one.answer,
                'log_evidence': one.log_evidence if np.isfinite(one.log_evidence) else None,
                'sigma': one.sigma,
                'sentence': one.describe(),
            }
            for one in decided
        ]
    if confirmation is not None:
        content['confirmation'] = vars(confirmation) | {
            'offsets_rms_sigmas': confirmation.offsets_rms_sigmas,
            'parameters_rms_sigmas': confirmation.parameters_rms_sigmas,
            'effects': [
                {'name': effect.name, 'joints': effect.joints, **vars(cause)}
                for effect, cause in zip(discovery.effects, confirmation.effects, strict=False)
            ],
        }
    checked = schemas.checked(content, Discovered)
    checked.judgement = judgement(discovery, confirmation, checked)
    return checked


def _covariance(discovery: Discovery) -> dict[str, Any]:
    """Return that of the offsets and the causes; of all kinds it stands in compensation.json."""
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
        'units': [*('rad' for _ in known), *(units[name] for name in names)],
        'matrix': [[float(f'{value:.5e}') for value in row] for row in matrix],
    }


def held_out_coverage(discovery: Discovery, predictions: Predictions) -> Coverage:
    """Return how many of the held-out rows lie in their 95 % regions."""
    return Coverage.of(predictions.inside[discovery.residuals.context.measurements.is_validation])


def _regions(discovery: Discovery, predictions: Predictions) -> dict[str, Any]:
    measurements = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.fit.left_out]
    fitted = ~measurements.is_validation & ~np.isin(measurements.observation, gross)
    return {
        'widening': predictions.widening,
        'held_out': held_out_coverage(discovery, predictions),
        'fitted': Coverage.of(predictions.inside[fitted]),
    }


def read_discovery(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read discovery.json and check it against the contract; further keys are kept as they are.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(
        Path(path), Discovered, schemas.DISCOVERY_FORMAT, DISCOVERY_FILE, 'discover'
    )
