"""What of a discovery a robot can load, with its error on held-out poses, and the files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from remaster_ros.compensation.export import (
    LAYER_FILE,
    MODEL_FILE,
    REMASTER_FILE,
    URDF_FILE,
    exports,
)
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.geometry_model import mean_length
from remaster_ros.discovery.words import sentence_case
from remaster_ros.reports.discovery_schema import Loadable
from remaster_ros.reports.fit_json import APPLY_FOLDER, model_text
from remaster_ros.types import FloatArray


def applied(discovery: Discovery) -> dict[str, str]:
    """Return the files of the folder ``apply``: name -> text."""
    files = exports(discovery.alone, _remarks(discovery))
    if discovery.loads_geometry:
        assert discovery.geometry is not None
        files[MODEL_FILE] = model_text(discovery.alone, discovery.geometry)
    return files


def loadable(discovery: Discovery) -> list[Loadable]:
    """Return the results that a robot can load, the plainest first."""
    m = discovery.residuals.context.measurements
    gross = [observation for observation, _ in discovery.outliers]
    held_out = m.is_validation & ~np.isin(m.observation, gross)
    results: list[tuple[Literal['offsets', 'geometry', 'everything'], FloatArray, str]] = [
        ('offsets', discovery.alone.residuals_after, f'{APPLY_FOLDER}/{URDF_FILE}')
    ]
    if discovery.geometry is not None:
        file = f'{APPLY_FOLDER}/{MODEL_FILE}' if discovery.loads_geometry else ''
        results.append(('geometry', discovery.geometry.errors, file))
    results.append(('everything', discovery.fit.residuals_after, ''))
    rows: list[Loadable] = []
    # To what is shown: a difference in the fourth figure is no reason to load anything else.
    least = np.inf
    for name, errors, file in results:
        mean_mm = round(1e3 * mean_length(errors[held_out]), 3)
        rows.append(Loadable(name, mean_mm if held_out.any() else None, mean_mm < least, file))
        least = min(least, mean_mm)
    return rows


def load_words(row: Loadable) -> tuple[str, str]:
    """Return what a result is, and what to do with it."""
    if row.result != 'offsets' and row.held_out_mean_mm is not None and not row.better:
        what_to_do = 'leave it: no better than what stands before it'
    elif row.file:
        what_to_do = f'{row.file}{_PAD if row.result == "offsets" else ""}'
    else:
        what_to_do = 'no file holds it: a compensation between planner and controller'
    return _RESULTS[row.result], what_to_do


_RESULTS = {
    'offsets': 'zero-offsets alone',
    'geometry': 'all lengths, tilts and zero-offsets together',
    'everything': 'everything in the model',
}
_PAD = f', {REMASTER_FILE} or {LAYER_FILE}'


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
            f'Corrected in none of these files: {_named(left)}. That takes a compensation between '
            'planner and controller.'
        )
    return remarks


def _named(effects: Sequence[FoundEffect]) -> str:
    return ', '.join(sentence_case(effect.title) for effect in effects)
