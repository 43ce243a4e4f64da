# SPDX-License-Identifier: Apache-2.0
"""discovery.json, and what of it a robot can load (format ``remaster-discovery/1``)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from remaster_ros.calibration.predictions import Coverage, Predictions, predict
from remaster_ros.compensation.export import (
    APPLY_FOLDER,
    MODEL_FILE,
    URDF_FILE,
    exports,
)
from remaster_ros.compensation.file import COMPENSATION_FILE, of_text
from remaster_ros.compensation.loaded_errors import (
    errors_with_correction,
    errors_with_urdf,
    without_errors_of_measuring,
)
from remaster_ros.compensation.of_result import (
    CorrectedArm,
    NotCorrected,
    arm_of_effects,
    arm_of_geometry,
    arm_of_offsets,
)
from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.decision import Decision, Named
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.geometry_model import mean_length
from remaster_ros.discovery.words import sentence_case
from remaster_ros.errors import InputError
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.reports import schemas
from remaster_ros.reports.fit_json import (
    DISCOVERY_FILE,
    clocks_content,
    correction_text,
    estimates,
    model_text,
    of_joints,
    read_result,
)
from remaster_ros.reports.schemas import Discovered, Loadable
from remaster_ros.reports.sentences import judgement
from remaster_ros.types import FloatArray
from remaster_ros.version import __version__


def _with_exact_drawing(
    discovery: Discovery, rows: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return the zero-offsets with their std if the arm is exactly its drawing."""
    drawn = of_joints(discovery.fit.chain, std_if_exactly_drawn=discovery.std_if_drawn)
    found = []
    for row, exact in zip(rows, drawn, strict=True):
        key = f'std_if_exactly_drawn_{row["unit"]}'
        known = row['identifiable'] and np.isfinite(exact[key])
        found.append({**row, key: exact[key]} if known else {**row})
    return found


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
        'search': discovery.search,
        'joint_offsets_before': [
            {'joint': name, **row}
            for name, row in zip(
                discovery.fit.joint_names,
                of_joints(discovery.fit.chain, mean=before, std=before_std),
                strict=True,
            )
        ],
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
        content['confirmation'] = confirmation_content(discovery.effects, confirmation)
    checked = schemas.checked(content, Discovered)
    checked.judgement = judgement(discovery, confirmation, checked)
    return checked


def confirmation_content(
    effects: Sequence[FoundEffect], confirmation: Confirmation
) -> dict[str, Any]:
    """Return how causes do in another session as discovery.json has it."""
    return vars(confirmation) | {
        'offsets_rms_sigmas': confirmation.offsets_rms_sigmas,
        'parameters_rms_sigmas': confirmation.parameters_rms_sigmas,
        'effects': [
            {'name': effect.name, 'joints': effect.joints, **vars(cause)}
            for effect, cause in zip(effects, confirmation.effects, strict=False)
        ],
    }


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
        'units': [*(fit.chain.units[i] for i in known), *(units[name] for name in names)],
        'matrix': [[float(f'{value:.5e}') for value in row] for row in matrix],
    }


def _regions(discovery: Discovery, predictions: Predictions) -> dict[str, Any]:
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
    """Read discovery.json and check it against the contract; further keys are left out.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(
        Path(path), Discovered, schemas.DISCOVERY_FORMAT, DISCOVERY_FILE, 'discover'
    )


# What of a discovery a robot can load, with its error on held-out poses, and the files.


def applied(discovery: Discovery, widening: float, result_sha256: str) -> dict[str, str]:
    """Return the files of the folder ``apply``: name -> text; ``widening``: of the predictions."""
    files = exports(discovery.alone, _remarks(discovery))
    if discovery.loads_geometry:
        assert discovery.geometry is not None
        errors = errors_to_load(discovery)
        geometry = replace(
            discovery.geometry, errors=errors['geometry'], drawing_errors=errors['offsets']
        )
        files[MODEL_FILE] = model_text(discovery.alone, geometry)
    described = compensation_of(discovery, widening)
    files[COMPENSATION_FILE] = correction_text(
        described, discovery.fit.session, 'discover', result_sha256
    )
    return files


_ALONE = 'only zero-offsets are corrected here'


def compensation_of(discovery: Discovery, widening: float) -> CorrectedArm:
    """Return the arm that compensation.json holds: everything, where that predicts better.

    Causes and zero-offsets belong together: where the causes are left out the zero-offsets are
    those fitted without them.
    """
    if holds_everything(discovery):
        described = _everything(discovery)
        return replace(described, model=replace(described.model, widening=widening))
    alone = discovery.alone
    rows = discovery.residuals.context.measurements
    drawn = discovery.geometry
    geometry = None if drawn is None else arm_of_geometry(alone, drawn, rows)
    notes = []
    if discovery.solution.cells:
        notes.append(
            'zero-offsets alone: the model with everything that was found predicts held-out poses '
            'no better'
        )
    described = arm_of_offsets(alone, predict(alone, rows).widening, notes, geometry)
    left = tuple(
        NotCorrected(e.name, e.joints, e.size_m, _ALONE, e.remedy) for e in discovery.effects
    )
    return replace(described, not_corrected=left)


def holds_everything(discovery: Discovery) -> bool:
    """Whether compensation.json holds everything in the model, and not the offsets alone."""
    alone = _held_out_mean(discovery, errors_to_load(discovery)['offsets'])
    every = _held_out_mean(discovery, errors_to_load(discovery)['everything'])
    better = bool(np.isnan(alone)) or round(every, 3) < round(alone, 3)
    can_be_commanded = _everything(discovery).model.largest_slope() < 1.0
    return better and can_be_commanded and bool(discovery.solution.cells)


@lru_cache(maxsize=1)
def _everything(discovery: Discovery) -> CorrectedArm:
    """Return the arm with everything corrected."""
    return arm_of_effects(discovery.fit, discovery.solution.cells, discovery.residuals)


@lru_cache(maxsize=1)
def errors_to_load(discovery: Discovery) -> dict[str, FloatArray]:
    """Return the error of every row with each of the files, as `Loadable` names them, m, (n, 3).

    Each is of the text that is written, or would be if it were worth it. Errors of the measurement
    that the file has nothing of are taken out: the certain ones, of compensation.json all.
    """
    alone, fit, cells = discovery.alone, discovery.fit, discovery.solution.cells
    session, rows = alone.session, discovery.residuals.context.measurements
    # Beside the offsets that are loaded alone nothing was fitted but certain errors of measuring.
    measured = without_errors_of_measuring(alone, slice(None))
    plain = replace(session, measurements=replace(session.measurements, position=measured))
    left_out = [observation for observation, _ in alone.left_out]
    found = {'offsets': errors_with_urdf(plain, exports(alone)[URDF_FILE], left_out)}
    if discovery.geometry is not None:
        found['geometry'] = errors_with_urdf(
            plain, model_text(alone, discovery.geometry), left_out
        )
    described = _everything(discovery)
    if described.model.largest_slope() < 1.0:
        text = correction_text(described, session, 'discover', '').encode()
        of_measuring = np.repeat(
            np.array([cell.of_measurement for cell in cells], dtype=bool),
            [cell.size for cell in cells],
        )
        model = of_text(text, Path(COMPENSATION_FILE)).model
        position = without_errors_of_measuring(fit, of_measuring)
        found['everything'] = errors_with_correction(model, replace(rows, position=position))
    else:
        # Such a file is not read.
        found['everything'] = np.full_like(measured, np.nan)
    return found


def _held_out_mean(discovery: Discovery, errors: FloatArray) -> float:
    """Return the mean error on held-out poses, mm; gross errors do not count."""
    m = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    return 1e3 * mean_length(errors[m.is_validation & ~np.isin(m.observation, gross)])


def loadable(discovery: Discovery) -> list[Loadable]:
    """Return the results that a robot can load, the plainest first."""
    files = {
        'offsets': f'{APPLY_FOLDER}/{URDF_FILE}',
        'geometry': f'{APPLY_FOLDER}/{MODEL_FILE}' if discovery.loads_geometry else '',
        'everything': f'{APPLY_FOLDER}/{COMPENSATION_FILE}' if holds_everything(discovery) else '',
    }
    rows: list[Loadable] = []
    # To what is shown: a difference in the fourth figure is no reason to load anything else.
    least = np.inf
    results: tuple[Literal['offsets', 'geometry', 'everything'], ...]
    results = ('offsets', 'geometry', 'everything')
    for name in results:
        if name not in errors_to_load(discovery):
            continue
        mean_mm = round(_held_out_mean(discovery, errors_to_load(discovery)[name]), 3)
        shown = None if np.isnan(mean_mm) else mean_mm
        # A gain by chance is none.
        better = mean_mm < least and (name != 'geometry' or discovery.loads_geometry)
        rows.append(Loadable(name, shown, better, files[name]))
        least = mean_mm if better else least
    return rows


def _remarks(discovery: Discovery) -> list[str]:
    """Return what the files with the zero-offsets leave, a line each."""
    measured = [effect for effect in discovery.effects if effect.of_measurement]
    held = [effect for effect in discovery.effects if effect.in_robot_model]
    left = [effect for effect in discovery.effects if effect not in (*measured, *held)]
    remarks = []
    if certain := [effect for effect in measured if effect.is_taken_out]:
        remarks.append(f'Taken out, as errors of the measurement: {_titles(certain)}.')
    if doubtful := [effect for effect in measured if not effect.is_taken_out]:
        remarks.append(f'Not taken out, as they are not certain: {_titles(doubtful)}.')
    if held:
        where = (
            f'{MODEL_FILE} has them, with zero-offsets of its own: load it in place of this file'
            if discovery.loads_geometry
            else 'no robot model with them predicts held-out poses better'
        )
        remarks.append(f'Not corrected here: {_titles(held)}; {where}.')
    if left:
        remarks.append(
            f'Not corrected here: {_titles(left)}; {COMPENSATION_FILE} has all of it that can be '
            'corrected, with zero-offsets of its own: use it in place of this file.'
            if holds_everything(discovery)
            else f'Corrected in none of these files: {_titles(left)}.'
        )
    return remarks


def _titles(effects: Sequence[FoundEffect]) -> str:
    return ', '.join(sentence_case(effect.title) for effect in effects)


# Causes and their look-alikes, to be separated and decided between.


def read_causes(
    path: str | os.PathLike[str],
    joint_names: Sequence[str] = (),
    observations_sha256: str = '',
) -> tuple[FoundCause, ...]:
    """Return the causes of a discovery.json that have look-alikes.

    Parameters
    ----------
    path
        The file.
    joint_names
        Of the arm that it has to be of; empty for any.
    observations_sha256
        Of the observations that it has to be of; '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, is of another arm or other observations, or has no cause with a
        look-alike.
    """
    found = _read(path, joint_names)
    of = found.session and found.session.observations_sha256
    if observations_sha256 and of != observations_sha256:
        raise InputError(
            f'{path} is not of the observations that the session has now; call /remaster/discover '
            'first'
        )
    causes = tuple(
        FoundCause(
            effect.name,
            tuple(effect.joints),
            {parameter.name: parameter.value for parameter in effect.parameters},
            tuple((other.name, other.joints, other.separate_by) for other in _separable(effect)),
            effect.driver,
        )
        for effect in found.effects
        if _separable(effect)
    )
    if not causes:
        raise InputError(
            f'{path}: none of its causes has a look-alike (confusable_with) that can be '
            'separated from it; there is nothing to separate, plan without it'
        )
    return causes


def earlier_pairs(
    path: str | os.PathLike[str], joint_names: Sequence[str] = (), created: str = ''
) -> tuple[tuple[Named, Named], ...]:
    """Return causes and look-alikes of a discovery.json, and those that it has decided between.

    Parameters
    ----------
    path
        The file.
    joint_names
        Of the arm that it has to be of; empty for any.
    created
        When the session was begun that it has to be of; of another there are none. '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, or is of another arm.
    """
    found = _read(path, joint_names)
    if created and (not found.session or found.session.created != created):
        return ()
    pairs = [(_named(one.cause), _named(one.look_alike)) for one in found.decided or ()]
    pairs += [
        (_named(effect), _named(other)) for effect in found.effects for other in _separable(effect)
    ]
    return tuple(pairs)


def _read(path: str | os.PathLike[str], joint_names: Sequence[str]) -> Discovered:
    found = read_discovery(path)
    names = found.robot.joint_names if found.robot else joint_names
    if joint_names and list(names) != list(joint_names):
        raise InputError(
            f'{path}: its causes are of an arm with the joints {", ".join(names)}, this one has '
            f'{", ".join(joint_names)}; give the discovery.json of this arm'
        )
    return found


def _named(cause: schemas.NamedCause | schemas.Effect | LookAlike) -> Named:
    return Named(cause.name, tuple(cause.joints))


def _separable(effect: schemas.Effect) -> list[LookAlike]:
    """Return the look-alikes of an effect that are neither another name nor a free form of it."""
    return [other for other in effect.confusable_with if not other.same and not other.general]
