# SPDX-License-Identifier: Apache-2.0
"""Session and results that a report is made of, read from their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from remaster_ros.compensation.export import APPLY_FOLDER, MODEL_FILE
from remaster_ros.compensation.loaded_errors import errors_with_urdf
from remaster_ros.errors import InputError
from remaster_ros.reports.fit_json import DISCOVERY_FILE, FIT_FILE, FIT_LIMIT, read_fit
from remaster_ros.reports.rows_csv import (
    AFTER,
    BEFORE,
    PREDICTED,
    PREDICTIONS_FILE,
    RESIDUALS_FILE,
    lengths_mm,
    read_columns,
)
from remaster_ros.reports.schemas import Discovered, Fit, FittedGeometry, Judgement, Loadable
from remaster_ros.session.files import decode_text, read_limited
from remaster_ros.types import FloatArray, Session

if TYPE_CHECKING:
    from remaster_ros.session.records.plan_journal import RecordedPlan


@dataclass(frozen=True, eq=False)
class Inputs:
    """Session and results (fit, discovery, plan) that a report is made of; n rows."""

    session: Session
    # Contents of fit.json and discovery.json (None without the latter)
    fit: Fit
    found: Discovered | None
    # 3-D error of each row with all offsets at zero, and with those of the fit, (n,)
    before_mm: FloatArray
    after_mm: FloatArray
    causes_mm: FloatArray | None  # Error with the causes as well, (n,); None without causes
    # Error with the robot model of all lengths, tilts and zero-offsets, (n,); None if no such
    # model predicts held-out poses better
    model_mm: FloatArray | None = None
    model: Path | None = None  # File of that model
    plan: RecordedPlan | None = None  # Plan of the collection; None if the session has none

    @property
    def judgement(self) -> Judgement:
        """Judgement of the fit; the fit has to have one (AssertionError)."""
        assert isinstance(self.fit.judgement, Judgement)
        return self.fit.judgement

    @property
    def gross(self) -> list[int]:
        """``observation`` of the gross errors, by the discovery or, without one, by the fit.

        By the fit: rows that were not fitted, then held-out rows of `NoiseCheck.gross`.
        """
        if self.found is not None:
            return self.found.noise.outliers
        checks = self.fit.explained_by_noise
        held_out = checks.values() if isinstance(checks, dict) else ()
        return [*self.fit_left_out, *(row for check in held_out for row in check.gross)]

    @cached_property
    def fit_left_out(self) -> dict[int, str]:
        """Rows that the fit left out as gross errors: number (``observation``) -> reason."""
        return {row.observation: row.why for row in self.fit.left_out}

    @property
    def T_R_N(self) -> dict[str, FloatArray]:
        """Fitted registration of each sensor, (4, 4)."""
        return {
            sensor: registration.T_R_N for sensor, registration in self.fit.registration.items()
        }


def located(path: Path) -> Path:
    """Return the path of fit.json or discovery.json, given the file or its folder.

    A path that is no folder is returned as it is. Raises InputError if a folder has both or
    neither.
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


def parts(paths: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Return the paths of fit.json and of discovery.json among some paths; None if absent.

    ``paths``: files, or folders of one of them.

    Raises
    ------
    InputError
        Two files of one kind, a file of another name, or a folder with both or neither.
    """
    found: dict[str, Path] = {}
    for path in map(located, paths):
        if path.name not in (FIT_FILE, DISCOVERY_FILE):
            missing = '' if path.exists() else 'there is no such file or folder; '
            raise InputError(
                f'{path}: {missing}give {FIT_FILE} or {DISCOVERY_FILE}, or the folder of '
                'one of them'
            )
        if path.name in found:
            raise InputError(f'{path}: two files {path.name}; give one of each')
        found[path.name] = path
    return found.get(FIT_FILE), found.get(DISCOVERY_FILE)


def read_inputs(
    session: Session, fit_path: Path, found_path: Path | None, plan: RecordedPlan | None = None
) -> Inputs:
    """Read the results of a session.

    Parameters
    ----------
    session
        Session as read from its folder.
    fit_path, found_path
        fit.json and discovery.json, with residuals.csv and predictions.csv in their folders.
    plan
        Plan of the session.

    Raises
    ------
    InputError
        Results of another session, or a damaged file; one line naming file and remedy.
    """
    fit = read_fit(fit_path)
    _require_same(session, fit, fit_path, 'fit')
    residuals = read_columns(fit_path.parent / RESIDUALS_FILE, session, BEFORE + AFTER, 'fit')
    before_mm, after_mm = lengths_mm(residuals[:, :3]), lengths_mm(residuals[:, 3:])
    if found_path is None:
        model, model_mm = _model(session, fit_path, _file_of(fit.geometry), 'fit')
        return Inputs(session, fit, None, before_mm, after_mm, None, model_mm, model, plan)
    from remaster_ros.reports.discovery_json import read_discovery

    found = read_discovery(found_path)
    _require_same(session, found, found_path, 'discover')
    causes_mm = None
    if found.effects:
        path = found_path.parent / PREDICTIONS_FILE
        predicted = read_columns(path, session, PREDICTED, 'discover')
        causes_mm = lengths_mm(session.measurements.position - predicted)
    rows = found.loadable if isinstance(found.loadable, list) else []
    model, model_mm = _model(
        session,
        found_path,
        ''.join(_file_of(r) for r in rows if r.result == 'geometry'),
        'discover',
    )
    return Inputs(session, fit, found, before_mm, after_mm, causes_mm, model_mm, model, plan)


def _file_of(source: Loadable | FittedGeometry | msgspec.UnsetType) -> str:
    """Return the file name of a loadable result; '' if it has none, or is unset."""
    return '' if isinstance(source, msgspec.UnsetType) else source.file


def _model(
    session: Session, result: Path, file: str, verb: str
) -> tuple[Path | None, FloatArray | None]:
    """Return the path of a result's robot model, and the error of each row with it, mm, (n,).

    (None, None) if ``file``, as the result names it, is ''. ``result``: path of the result;
    ``verb``: command that writes it. Raises InputError if the model is missing.
    """
    if not file:
        return None, None
    path = result.parent / APPLY_FOLDER / MODEL_FILE
    data = read_limited(path, FIT_LIMIT, f'{verb} again, which writes it')
    return path, errors_with_model_mm(session, decode_text(data, path))


def errors_with_model_mm(session: Session, urdf: str) -> FloatArray:
    """Return the 3-D error of each row with a robot model, mm, (n,).

    ``urdf``: text of the model. Registrations and markers are fitted to it, with offsets of 0.
    """
    return lengths_mm(errors_with_urdf(session, urdf))


def _require_same(session: Session, result: Fit | Discovered, path: Path, verb: str) -> None:
    """Raise InputError if a result is of other data, or of a version that lacks needed keys.

    ``path``: of the result; ``verb``: command that the message names as remedy.
    """
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
