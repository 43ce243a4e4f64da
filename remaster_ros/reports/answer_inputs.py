"""What the page of `remaster report` is made of: a session, its fit, and its discovery if any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.compensation.export import MODEL_FILE
from remaster_ros.errors import InputError
from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.reports.discovery_schema import Discovered, Loadable
from remaster_ros.reports.fit_json import (
    APPLY_FOLDER,
    DISCOVERY_FILE,
    FIT_FILE,
    FIT_LIMIT,
    read_fit,
)
from remaster_ros.reports.rows_csv import (
    AFTER,
    BEFORE,
    PREDICTED,
    PREDICTIONS_FILE,
    RESIDUALS_FILE,
    read_columns,
)
from remaster_ros.reports.schemas import Fit, FittedGeometry, Judgement
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.session.plan_journal import RecordedPlan
from remaster_ros.types import FloatArray, Session


@dataclass(frozen=True, eq=False)
class Inputs:
    """What was read; n rows.

    Attributes
    ----------
    session
        All rows.
    fit, found
        fit.json and discovery.json; None without the latter.
    before_mm, after_mm
        3-D error of every row with all offsets at zero and with those of the fit, (n,).
    causes_mm
        With the causes as well, (n,); None where there are none.
    model_mm
        With the robot model of all lengths, tilts and zero-offsets and nothing else, (n,); None
        where there is none that predicts held-out poses better.
    model
        That file.
    plan
        Of its collection; None where the session's folder has none.
    """

    session: Session
    fit: Fit
    found: Discovered | None
    before_mm: FloatArray
    after_mm: FloatArray
    causes_mm: FloatArray | None
    model_mm: FloatArray | None = None
    model: Path | None = None
    plan: RecordedPlan | None = None

    @property
    def judgement(self) -> Judgement:
        """Of the fit."""
        assert isinstance(self.fit.judgement, Judgement)
        return self.fit.judgement

    @property
    def gross(self) -> list[int]:
        """``observation`` of the gross errors: with the causes some are none that the fit has."""
        if self.found is not None:
            return self.found.noise.outliers
        checks = self.fit.explained_by_noise
        held_out = checks.values() if isinstance(checks, dict) else ()
        return [*self.fit_left_out, *(row for check in held_out for row in check.gross)]

    @cached_property
    def fit_left_out(self) -> dict[int, str]:
        """``observation`` of every row that was not fitted, and why."""
        return {row.observation: row.why for row in self.fit.left_out}


def located(path: Path) -> Path:
    """Return the file fit.json or discovery.json that a path is, or that is in a folder.

    Raises
    ------
    InputError
        Neither, or both.
    """
    if not path.is_dir():
        return path
    there = [path / name for name in (FIT_FILE, DISCOVERY_FILE) if (path / name).exists()]
    if len(there) != 1:
        raise InputError(
            f'{path}: holds {"both" if there else "neither"} {FIT_FILE} '
            f'{"and" if there else "nor"} {DISCOVERY_FILE}; give one of the files'
        )
    return there[0]


def read_inputs(
    session: Session, fit_path: Path, found_path: Path | None, plan: RecordedPlan | None = None
) -> Inputs:
    """Read the results of a session, and refuse those of another.

    Parameters
    ----------
    session
        As read from its folder.
    fit_path, found_path
        fit.json and discovery.json; residuals.csv and predictions.csv are beside them.
    plan
        Of the session.

    Raises
    ------
    InputError
        One line naming file and remedy.
    """
    fit = msgspec.convert(read_fit(fit_path), Fit)
    _require_same(session, fit, fit_path, 'fit')
    residuals = read_columns(fit_path.parent / RESIDUALS_FILE, session, BEFORE + AFTER, 'fit')
    before_mm, after_mm = _lengths_mm(residuals[:, :3]), _lengths_mm(residuals[:, 3:])
    if found_path is None:
        model, model_mm = _model(session, fit_path, _file_of(fit.geometry), 'fit')
        return Inputs(session, fit, None, before_mm, after_mm, None, model_mm, model, plan)
    found = msgspec.convert(read_discovery(found_path), Discovered)
    _require_same(session, found, found_path, 'discover')
    causes_mm = None
    if found.effects:
        path = found_path.parent / PREDICTIONS_FILE
        predicted = read_columns(path, session, PREDICTED, 'discover')
        causes_mm = _lengths_mm(session.measurements.position - predicted)
    rows = found.loadable if isinstance(found.loadable, list) else []
    model, model_mm = _model(
        session,
        found_path,
        ''.join(_file_of(r) for r in rows if r.result == 'geometry'),
        'discover',
    )
    return Inputs(session, fit, found, before_mm, after_mm, causes_mm, model_mm, model, plan)


def _file_of(source: Loadable | FittedGeometry | msgspec.UnsetType) -> str:
    return '' if isinstance(source, msgspec.UnsetType) else source.file


def _model(
    session: Session, result: Path, file: str, verb: str
) -> tuple[Path | None, FloatArray | None]:
    """Return a result's robot model and the errors with it, mm; None where it has none."""
    if not file:
        return None, None
    path = result.parent / APPLY_FOLDER / MODEL_FILE
    data = read_limited(path, FIT_LIMIT, f'{verb} again, which writes it')
    return path, errors_with_model_mm(session, decode_text(data, path))


def all_taken_out(found: Discovered | None) -> bool:
    """Whether all causes lie in how the arm was measured, and there is at least one."""
    return (
        found is not None
        and found.verdict != 'undetermined'
        and bool(found.effects)
        and all(effect.of_measurement for effect in found.effects)
    )


def errors_with_model_mm(session: Session, urdf: str) -> FloatArray:
    """Return the 3-D error of every row with another robot model, as it is, mm, (n,).

    Registrations and markers are fitted to the optimization rows, as for the error of today.
    """
    found = estimate(Problem.of(replace(session, urdf=urdf)))
    predicted = predicted_rows(found.problem, found.model, found.before.z)
    return _lengths_mm(session.measurements.position - predicted)


def _lengths_mm(errors: FloatArray) -> FloatArray:
    lengths: FloatArray = 1e3 * np.linalg.norm(errors, axis=1)
    return lengths


def _require_same(session: Session, result: Fit | Discovered, path: Path, verb: str) -> None:
    """Refuse the result of other data, or of a version whose files lack what the page has."""
    if (
        not isinstance(result.session, msgspec.Struct)
        or not isinstance(result.judgement, msgspec.Struct)
        or (isinstance(result, Discovered) and not all(e.title for e in result.effects))
    ):
        raise InputError(f'{path}: of an earlier version; {verb} this session again')
    if result.session.observations_sha256 != session.observations_sha256:
        raise InputError(
            f'{path}: of other data than this session (observations.csv has another SHA-256); '
            f'{verb} this session'
        )


def parts(paths: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Return which of at most two paths is fit.json and which discovery.json.

    Raises
    ------
    InputError
        Two of one kind, or a file of another name.
    """
    found: dict[str, Path] = {}
    for path in map(located, paths):
        if path.name not in (FIT_FILE, DISCOVERY_FILE):
            raise InputError(
                f'{path}: give {FIT_FILE} or {DISCOVERY_FILE}, or the folder of one of them'
            )
        if path.name in found:
            raise InputError(f'{path}: two files {path.name}; give one of each')
        found[path.name] = path
    return found.get(FIT_FILE), found.get(DISCOVERY_FILE)
