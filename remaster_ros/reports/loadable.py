# SPDX-License-Identifier: Apache-2.0
"""Files that a robot can load, of a fit and of a discovery, and what they leave on held-out poses.

A fit has its zero-offsets, a robot model with lengths and tilts, and compensation.json; a
discovery the same with the causes that it found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from remaster_ros.calibration.predictions import predict
from remaster_ros.calibration.priors import DRAWING_TAILS
from remaster_ros.compensation.arm_model import Geometry
from remaster_ros.compensation.export import (
    APPLY_FOLDER,
    MODEL_FILE,
    URDF_FILE,
    calibrated_urdf,
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
    mounts_of,
)
from remaster_ros.discovery.geometry_model import GeometryModel, geometry_model, mean_length
from remaster_ros.discovery.words import sentence_case
from remaster_ros.reports.schemas import Loadable
from remaster_ros.types import FloatArray

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.discovery.explain import FoundEffect

_ALONE = 'only zero-offsets are corrected here'


@lru_cache(maxsize=2)
def geometry_of(result: FitResult) -> GeometryModel | None:
    """Return the lengths and tilts estimated from a fit's session; None without an estimate.

    Their errors are those of the robot model's file as written; the errors of the drawing are
    those of the URDF with offsets alone. Cached.
    """
    if result.found is None:
        return None
    geometry = geometry_model(result.found)
    if geometry is None:
        return None
    gross = [row for check in result.noise_checks for row in check.gross]
    # Each figure is that of the file which is loaded.
    left_out = [observation for observation, _ in result.left_out]
    drawn = errors_with_urdf(result.session, exports(result)[URDF_FILE], left_out)
    loaded = errors_with_urdf(result.session, model_text(result, geometry), left_out)
    return replace(geometry.beside(result, gross), errors=loaded, drawing_errors=drawn)


class Uncertainty(NamedTuple):
    """Uncertainty of the zero-offsets of k joints; rad, m for prismatic joints."""

    std: FloatArray  # (k,)
    interval95: FloatArray  # (k, 2)


def uncertainty(result: FitResult) -> Uncertainty:
    """Return a fit's uncertainty of its offsets, for an arm that may differ from its drawing.

    Lengths and tilts off their drawing may change an offset without any residual: their effect is
    added. It is not added to offsets that are not identifiable, or if lengths and tilts cannot be
    estimated.
    """
    drawn = Uncertainty(result.joint_offsets_std, result.joint_offsets_interval95)
    geometry = geometry_of(result)
    if geometry is None:
        return drawn
    moved = DRAWING_TAILS * np.linalg.norm(geometry.offset_moves, axis=1)
    std = np.where(result.identifiable, np.hypot(drawn.std, moved), drawn.std)
    mean, times = result.joint_offsets[:, None], (std / drawn.std)[:, None]
    return Uncertainty(std, mean + times * (drawn.interval95 - mean))


def model_text(result: FitResult, geometry: GeometryModel) -> str:
    """Return the text of a URDF with lengths, tilts and offsets fitted together.

    With a remark on its use and errors. Offsets that are not identifiable are 0.
    """
    remark = (
        f'Load this model in place of {URDF_FILE}, never beside another correction: lengths, '
        'tilts and zero-offsets were fitted together.'
    )
    if geometry.judged.any():
        remark += (
            f' Mean error on held-out poses: {1e3 * geometry.held_out_m:.3f} mm, with the '
            f'zero-offsets alone {1e3 * geometry.drawing_held_out_m:.3f} mm.'
        )
    offsets = np.where(result.identifiable, geometry.joint_offsets, 0.0)
    return calibrated_urdf(
        result.session.urdf,
        result.chain,
        offsets,
        [remark],
        Geometry(*(np.vstack((v, np.zeros(3))) for v in (geometry.shifts, geometry.turns))),
    )


def compensation_text(result: FitResult, result_sha256: str) -> str:
    """Return the text of compensation.json of a fit.

    It has lengths and tilts only if commands corrected for them make held-out errors clearly
    smaller (near singularities no command may reach a corrected pose), else zero-offsets alone.
    ``result_sha256``: of fit.json.
    """
    geometry, rows = geometry_of(result), result.measurements
    described = None if geometry is None else arm_of_geometry(result, geometry, rows)
    if described is not None and geometry is not None:
        text = _of_fit(described, result, result_sha256)
        model = of_text(text.encode(), Path(COMPENSATION_FILE)).model
        if replace(geometry, errors=errors_with_correction(model, rows)).is_better:
            return text
    offsets_arm = arm_of_offsets(result, predict(result, rows).widening, geometry=described)
    return _of_fit(offsets_arm, result, result_sha256)


def _of_fit(described: CorrectedArm, result: FitResult, result_sha256: str) -> str:
    """Return the text of compensation.json for a fit's corrected arm, with sensors on the tool."""
    described = replace(described, mounts=mounts_of(result, described.model))
    return written(described, result.session, 'fit', result_sha256)


def applied(discovery: Discovery, widening: float, result_sha256: str) -> dict[str, str]:
    """Return the text of each file of a discovery's folder ``apply``, by name.

    ``widening``: factor on predicted uncertainties; ``result_sha256``: of discovery.json.
    """
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


def compensation_of(discovery: Discovery, widening: float) -> CorrectedArm:
    """Return the arm that compensation.json describes: with all effects, or zero-offsets alone.

    With all effects if `holds_everything`. Else with the zero-offsets that are fitted without
    causes of the arm (`Discovery.alone`); lengths and tilts, if estimated, then only add to the
    expected error. ``widening``: factor on predicted uncertainties, used with all effects.
    """
    if holds_everything(discovery):
        described = _arm_with_effects(discovery)
        return replace(described, model=replace(described.model, widening=widening))
    offsets_fit = discovery.alone
    rows = discovery.residuals.context.measurements
    drawn = discovery.geometry
    geometry = None if drawn is None else arm_of_geometry(offsets_fit, drawn, rows)
    notes = []
    if discovery.solution.candidates:
        notes.append(
            'zero-offsets alone: the model with everything that was found predicts held-out poses '
            'no better'
        )
    described = arm_of_offsets(offsets_fit, predict(offsets_fit, rows).widening, notes, geometry)
    uncorrected = tuple(
        NotCorrected(e.name, e.joints, 1e3 * e.size_m, _ALONE, e.remedy) for e in discovery.effects
    )
    return replace(described, not_corrected=uncorrected)


def holds_everything(discovery: Discovery) -> bool:
    """Return whether compensation.json has all effects of the model, not zero-offsets only.

    It has if the model has effects, if its correction converges (slope below 1), and if its mean
    error on held-out poses, rounded to 0.001 mm, is smaller than with offsets alone, or no poses
    were held out.
    """
    offsets_error = _held_out_mean(discovery, errors_to_load(discovery)['offsets'])
    every = _held_out_mean(discovery, errors_to_load(discovery)['everything'])
    better = bool(np.isnan(offsets_error)) or round(every, 3) < round(offsets_error, 3)
    can_be_commanded = _arm_with_effects(discovery).model.largest_slope() < 1.0
    return better and can_be_commanded and bool(discovery.solution.candidates)


@lru_cache(maxsize=1)
def _arm_with_effects(discovery: Discovery) -> CorrectedArm:
    """Return the corrected arm with all effects of the model that commands can correct; cached."""
    return arm_of_effects(discovery.fit, discovery.solution.candidates, discovery.residuals)


@lru_cache(maxsize=1)
def errors_to_load(discovery: Discovery) -> dict[str, FloatArray]:
    """Errors of all rows with each loadable file, by the names of `Loadable`, m, (n, 3).

    Each is computed with the text of the file, even if that is not written. Errors of the
    measurement are taken out first: the certain ones, for 'everything' all. 'geometry' is missing
    if lengths and tilts cannot be estimated; 'everything' is NaN if its correction does not
    converge.
    """
    offsets_fit, fit, candidates = discovery.alone, discovery.fit, discovery.solution.candidates
    session, rows = offsets_fit.session, discovery.residuals.context.measurements
    # The fit of offsets alone contains no further parameters than certain errors of measuring.
    measured = without_errors_of_measuring(offsets_fit, slice(None))
    plain = replace(session, measurements=replace(session.measurements, position=measured))
    left_out = [observation for observation, _ in offsets_fit.left_out]
    found = {'offsets': errors_with_urdf(plain, exports(offsets_fit)[URDF_FILE], left_out)}
    if discovery.geometry is not None:
        found['geometry'] = errors_with_urdf(
            plain, model_text(offsets_fit, discovery.geometry), left_out
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
    """Mean length of errors on held-out poses, mm, gross errors left out; NaN if none are left.

    ``errors``: of every measurement of the session, m, (n, 3).
    """
    m = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    return 1e3 * mean_length(errors[m.is_validation & ~np.isin(m.observation, gross)])


def loadable(discovery: Discovery) -> list[Loadable]:
    """Results that a robot can load, the simplest first, with their mean errors on held-out poses.

    ``better`` of a result is True if its error, rounded to 0.001 mm, is smaller than those of the
    simpler results that are worth loading; for 'geometry' also `Discovery.loads_geometry` is
    required. False without held-out poses.
    """
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
    """Remarks for the files with zero-offsets, a line each: which effects they correct or not.

    On errors of the measurement that are taken out or not, and on effects of the arm that these
    files do not correct, with the file that does; [] without effects.
    """
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
