# SPDX-License-Identifier: Apache-2.0
"""Content of discovery.json, and its files that a robot can load (``remaster-discovery/1``)."""

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
from remaster_ros.compensation.file import COMPENSATION_FILE, of_text, written
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
    estimates,
    model_text,
    of_joints,
    read_result,
)
from remaster_ros.reports.schemas import Discovered, Loadable
from remaster_ros.reports.sentences import judgement
from remaster_ros.session.json_records import checked
from remaster_ros.types import FloatArray
from remaster_ros.version import __version__


def _with_exact_drawing(
    discovery: Discovery, rows: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Rows of zero-offsets with their std for an arm of exactly nominal geometry added."""
    drawn = of_joints(discovery.fit.chain, std_if_exactly_drawn=discovery.std_if_drawn)
    found = []
    for row, exact in zip(rows, drawn, strict=True):
        key = f'std_if_exactly_drawn_{row["unit"]}'
        known = row['identifiable'] and np.isfinite(exact[key])
        found.append({**row, key: exact[key]} if known else {**row})
    return found


def predictions_of(discovery: Discovery) -> Predictions:
    """Predictions of the final model for each row of the session."""
    context = discovery.residuals.context
    return predict(discovery.fit, context.measurements)


def discovery_content(
    discovery: Discovery,
    confirmation: Confirmation | None = None,
    predictions: Predictions | None = None,
    decided: Sequence[Decision] = (),
) -> Discovered:
    """Checked content of discovery.json, as an object; predictions are computed if not given."""
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
    """Posterior covariance of identifiable offsets and of the named causes' parameters.

    compensation.json has that of all terms of the model.
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
    """Share of held-out and fitted rows in their predicted 95 % regions."""
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


# Results of a discovery that a robot can load, with their errors on held-out poses, and the files.


def applied(discovery: Discovery, widening: float, result_sha256: str) -> dict[str, str]:
    """Files of the folder ``apply``: name -> text; ``widening``: factor of the predictions."""
    files = exports(discovery.alone, _remarks(discovery))
    if discovery.loads_geometry:
        assert discovery.geometry is not None
        errors = errors_to_load(discovery)
        geometry = replace(
            discovery.geometry, errors=errors['geometry'], drawing_errors=errors['offsets']
        )
        files[MODEL_FILE] = model_text(discovery.alone, geometry)
    described = compensation_of(discovery, widening)
    files[COMPENSATION_FILE] = written(described, discovery.fit.session, 'discover', result_sha256)
    return files


_ALONE = 'only zero-offsets are corrected here'


def compensation_of(discovery: Discovery, widening: float) -> CorrectedArm:
    """Arm in compensation.json: with all effects if that predicts held-out poses better.

    Causes and zero-offsets belong together: without the causes, the zero-offsets are those that
    were fitted without them.
    """
    if holds_everything(discovery):
        described = _arm_with_effects(discovery)
        return replace(described, model=replace(described.model, widening=widening))
    alone = discovery.alone
    rows = discovery.residuals.context.measurements
    drawn = discovery.geometry
    geometry = None if drawn is None else arm_of_geometry(alone, drawn, rows)
    notes = []
    if discovery.solution.candidates:
        notes.append(
            'zero-offsets alone: the model with everything that was found predicts held-out poses '
            'no better'
        )
    described = arm_of_offsets(alone, predict(alone, rows).widening, notes, geometry)
    uncorrected = tuple(
        NotCorrected(e.name, e.joints, 1e3 * e.size_m, _ALONE, e.remedy) for e in discovery.effects
    )
    return replace(described, not_corrected=uncorrected)


def holds_everything(discovery: Discovery) -> bool:
    """Whether compensation.json has all effects of the model, not zero-offsets only."""
    alone = _held_out_mean(discovery, errors_to_load(discovery)['offsets'])
    every = _held_out_mean(discovery, errors_to_load(discovery)['everything'])
    better = bool(np.isnan(alone)) or round(every, 3) < round(alone, 3)
    can_be_commanded = _arm_with_effects(discovery).model.largest_slope() < 1.0
    return better and can_be_commanded and bool(discovery.solution.candidates)


@lru_cache(maxsize=1)
def _arm_with_effects(discovery: Discovery) -> CorrectedArm:
    """Arm with all effects that can be corrected."""
    return arm_of_effects(discovery.fit, discovery.solution.candidates, discovery.residuals)


@lru_cache(maxsize=1)
def errors_to_load(discovery: Discovery) -> dict[str, FloatArray]:
    """Errors of all rows with each loadable file, by the names of `Loadable`, m, (n, 3).

    Each is computed with the text of the file, written or not. Errors of the measurement that the
    file does not contain are taken out: the certain ones, and for compensation.json all.
    """
    alone, fit, candidates = discovery.alone, discovery.fit, discovery.solution.candidates
    session, rows = alone.session, discovery.residuals.context.measurements
    # The fit of offsets alone contains no further parameters than certain errors of measuring.
    measured = without_errors_of_measuring(alone, slice(None))
    plain = replace(session, measurements=replace(session.measurements, position=measured))
    left_out = [observation for observation, _ in alone.left_out]
    found = {'offsets': errors_with_urdf(plain, exports(alone)[URDF_FILE], left_out)}
    if discovery.geometry is not None:
        found['geometry'] = errors_with_urdf(
            plain, model_text(alone, discovery.geometry), left_out
        )
    described = _arm_with_effects(discovery)
    if described.model.largest_slope() < 1.0:
        text = written(described, session, 'discover', '').encode()
        of_measuring = np.repeat(
            np.array([candidate.of_measurement for candidate in candidates], dtype=bool),
            [candidate.size for candidate in candidates],
        )
        model = of_text(text, Path(COMPENSATION_FILE)).model
        position = without_errors_of_measuring(fit, of_measuring)
        found['everything'] = errors_with_correction(model, replace(rows, position=position))
    else:
        # Such a file is not read.
        found['everything'] = np.full_like(measured, np.nan)
    return found


def _held_out_mean(discovery: Discovery, errors: FloatArray) -> float:
    """Mean error on held-out poses without gross errors, mm; NaN if there are none."""
    m = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    return 1e3 * mean_length(errors[m.is_validation & ~np.isin(m.observation, gross)])


def loadable(discovery: Discovery) -> list[Loadable]:
    """Results that a robot can load, the simplest first."""
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
    """Remarks on the effects that the files with zero-offsets do not correct, a line each."""
    measured = [effect for effect in discovery.effects if effect.of_measurement]
    in_model = [effect for effect in discovery.effects if effect.in_robot_model]
    not_in_model = [effect for effect in discovery.effects if effect not in (*measured, *in_model)]
    remarks = []
    if certain := [effect for effect in measured if effect.is_taken_out]:
        remarks.append(f'Taken out, as errors of the measurement: {_titles(certain)}.')
    if doubtful := [effect for effect in measured if not effect.is_taken_out]:
        remarks.append(f'Not taken out, as they are not certain: {_titles(doubtful)}.')
    if in_model:
        note = (
            f'{MODEL_FILE} has them, with zero-offsets of its own: load it in place of this file'
            if discovery.loads_geometry
            else 'no robot model with them predicts held-out poses better'
        )
        remarks.append(f'Not corrected here: {_titles(in_model)}; {note}.')
    if not_in_model:
        remarks.append(
            f'Not corrected here: {_titles(not_in_model)}; {COMPENSATION_FILE} has all of it that '
            'can be '
            'corrected, with zero-offsets of its own: use it in place of this file.'
            if holds_everything(discovery)
            else f'Corrected in none of these files: {_titles(not_in_model)}.'
        )
    return remarks


def _titles(effects: Sequence[FoundEffect]) -> str:
    """Titles of effects, separated by commas."""
    return ', '.join(sentence_case(effect.title) for effect in effects)


# Causes and their look-alikes, which a plan separates and a later session decides between.


def read_causes(
    path: str | os.PathLike[str],
    joint_names: Sequence[str] = (),
    observations_sha256: str = '',
) -> tuple[FoundCause, ...]:
    """Causes of a discovery.json that have look-alikes.

    Parameters
    ----------
    path
        The file.
    joint_names
        Joints that its arm must have; empty for any.
    observations_sha256
        Hash that its observations must have; '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, is of another arm or other observations, or has no cause with a
        look-alike.
    """
    found = _read(path, joint_names)
    found_sha256 = found.session and found.session.observations_sha256
    if observations_sha256 and found_sha256 != observations_sha256:
        raise InputError(
            f'{path} is not of the observations that the session has now; call /remaster/discover '
            'first'
        )
    causes = tuple(
        FoundCause(
            effect.name,
            effect.joints,
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
    """Pairs of causes and look-alikes of a discovery.json, open ones and decided ones.

    Parameters
    ----------
    path
        The file.
    joint_names
        Joints that its arm must have; empty for any.
    created
        Begin of its session; () is returned for another session. '' for any.

    Raises
    ------
    InputError
        It is no discovery.json, or is of another arm.
    """
    found = _read(path, joint_names)
    if created and (not found.session or found.session.created != created):
        return ()
    pairs = [(one.cause, one.look_alike) for one in found.decided or ()]
    pairs += [
        (Named(effect.name, effect.joints), Named(other.name, other.joints))
        for effect in found.effects
        for other in _separable(effect)
    ]
    return tuple(pairs)


def _read(path: str | os.PathLike[str], joint_names: Sequence[str]) -> Discovered:
    """Content of a discovery.json. Raises InputError if its arm has other joints."""
    found = read_discovery(path)
    names = found.robot.joint_names if found.robot else joint_names
    if joint_names and list(names) != list(joint_names):
        raise InputError(
            f'{path}: its causes are of an arm with the joints {", ".join(names)}, this one has '
            f'{", ".join(joint_names)}; give the discovery.json of this arm'
        )
    return found


def _separable(effect: FoundEffect) -> list[LookAlike]:
    """Look-alikes of an effect that are neither another name nor a general form of it."""
    return [other for other in effect.confusable_with if not other.same and not other.general]
