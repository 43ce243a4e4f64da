"""What of a discovery a robot can load, with its error on held-out poses, and the files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from remaster_ros.calibration.predictions import predict
from remaster_ros.compensation.export import (
    LAYER_FILE,
    MODEL_FILE,
    REMASTER_FILE,
    URDF_FILE,
    exports,
)
from remaster_ros.compensation.file import COMPENSATION_FILE
from remaster_ros.compensation.of_result import (
    Described,
    NotCorrected,
    corrected_residuals,
    everything,
    offsets_alone,
)
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.geometry_model import mean_length
from remaster_ros.discovery.words import sentence_case
from remaster_ros.reports.discovery_schema import Loadable
from remaster_ros.reports.fit_json import APPLY_FOLDER, correction_text, model_text
from remaster_ros.types import FloatArray


def applied(discovery: Discovery, widening: float, result_sha256: str) -> dict[str, str]:
    """Return the files of the folder ``apply``: name -> text.

    Parameters
    ----------
    discovery
        What was found.
    widening
        Of its predictions.
    result_sha256
        Of discovery.json.
    """
    files = exports(discovery.alone, _remarks(discovery))
    if discovery.loads_geometry:
        assert discovery.geometry is not None
        files[MODEL_FILE] = model_text(discovery.alone, discovery.geometry)
    described = compensation_of(discovery, widening)
    files[COMPENSATION_FILE] = correction_text(
        described, discovery.fit.session, 'discover', result_sha256
    )
    return files


def compensation_of(discovery: Discovery, widening: float) -> Described:
    """Return the arm that compensation.json holds: everything, where that predicts better.

    Causes and zero-offsets belong together: where the causes are left out the zero-offsets are
    those fitted without them.
    """
    if holds_everything(discovery):
        fit, cells = discovery.fit, discovery.solution.cells
        return everything(fit, cells, discovery.residuals, widening)
    alone = discovery.alone
    own = predict(alone, discovery.residuals.context.measurements).widening
    notes = []
    if discovery.solution.cells:
        notes.append(
            'zero-offsets alone: the model with everything that was found predicts held-out poses '
            'no better'
        )
    described = offsets_alone(alone, own, notes)
    left = tuple(
        NotCorrected(e.name, e.joints, e.size_m, _ALONE, e.remedy) for e in discovery.effects
    )
    return replace(described, not_corrected=left)


def holds_everything(discovery: Discovery) -> bool:
    """Whether compensation.json holds everything in the model, and not the offsets alone."""
    alone = _held_out_mean(discovery, discovery.alone.residuals_after)
    every = _held_out_mean(discovery, _corrected(discovery))
    better = bool(np.isnan(alone)) or round(every, 3) < round(alone, 3)
    return better and bool(discovery.solution.cells)


def _corrected(discovery: Discovery) -> FloatArray:
    """Return the residuals with what compensation.json corrects, where it holds everything."""
    return corrected_residuals(discovery.fit, discovery.solution.cells)


def _held_out_mean(discovery: Discovery, errors: FloatArray) -> float:
    """Return the mean error on held-out poses, mm; gross errors do not count."""
    m = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    return 1e3 * mean_length(errors[m.is_validation & ~np.isin(m.observation, gross)])


def loadable(discovery: Discovery) -> list[Loadable]:
    """Return the results that a robot can load, the plainest first."""
    results: list[tuple[Literal['offsets', 'geometry', 'everything'], FloatArray, str]] = [
        ('offsets', discovery.alone.residuals_after, f'{APPLY_FOLDER}/{URDF_FILE}')
    ]
    if discovery.geometry is not None:
        file = f'{APPLY_FOLDER}/{MODEL_FILE}' if discovery.loads_geometry else ''
        results.append(('geometry', discovery.geometry.errors, file))
    file = f'{APPLY_FOLDER}/{COMPENSATION_FILE}' if holds_everything(discovery) else ''
    results.append(('everything', _corrected(discovery), file))
    rows: list[Loadable] = []
    # To what is shown: a difference in the fourth figure is no reason to load anything else.
    least = np.inf
    for name, errors, file in results:
        mean_mm = round(_held_out_mean(discovery, errors), 3)
        shown = None if np.isnan(mean_mm) else mean_mm
        rows.append(Loadable(name, shown, mean_mm < least, file))
        least = min(least, mean_mm)
    return rows


def load_words(row: Loadable) -> tuple[str, str]:
    """Return what a result is, and what to do with it."""
    if row.result != 'offsets' and row.held_out_mean_mm is not None and not row.better:
        what_to_do = 'leave it: no better than what stands before it'
    elif row.file:
        what_to_do = f'{row.file}{_MORE.get(row.result, "")}'
    else:
        what_to_do = 'leave it: no file holds it'
    return _RESULTS[row.result], what_to_do


_RESULTS = {
    'offsets': 'zero-offsets alone',
    'geometry': 'all lengths, tilts and zero-offsets together',
    'everything': 'everything that a command can correct',
}
_MORE = {
    'offsets': f', {REMASTER_FILE} or {LAYER_FILE}',
    'everything': ', by remaster compensate or remaster_ros.read_compensation',
}
_ALONE = 'only zero-offsets are corrected here'


def _remarks(discovery: Discovery) -> list[str]:
    """Return what the files with the zero-offsets leave, a line each."""
    measured = [effect for effect in discovery.effects if effect.of_measurement]
    held = [effect for effect in discovery.effects if effect.in_robot_model]
    left = [effect for effect in discovery.effects if effect not in (*measured, *held)]
    remarks = []
    if measured:
        remarks.append(f'Taken out, as errors of the measurement: {_named(measured)}.')
    if held:
        where = (
            f'{MODEL_FILE} has them, with zero-offsets of its own: load it in place of this file'
            if discovery.loads_geometry
            else 'no robot model with them predicts held-out poses better'
        )
        remarks.append(f'Not corrected here: {_named(held)}; {where}.')
    if left:
        remarks.append(
            f'Not corrected here: {_named(left)}; {COMPENSATION_FILE} has all of it that can be '
            'corrected, with zero-offsets of its own: use it in place of this file.'
            if holds_everything(discovery)
            else f'Corrected in none of these files: {_named(left)}.'
        )
    return remarks


def _named(effects: Sequence[FoundEffect]) -> str:
    return ', '.join(sentence_case(effect.title) for effect in effects)
