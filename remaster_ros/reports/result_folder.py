# SPDX-License-Identifier: Apache-2.0
"""Folder of results: checked before the long work, written after it."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from remaster_ros.compensation.export import APPLY_FOLDER, MODEL_FILE, exports
from remaster_ros.compensation.file import COMPENSATION_FILE
from remaster_ros.errors import InputError
from remaster_ros.reports.fit_json import (
    DISCOVERY_FILE,
    FIT_FILE,
    FORMATS,
    REPORT_FILE,
    WRITTEN,
    fit_content,
    require_own,
)
from remaster_ros.reports.loadable import compensation_text, geometry_of, model_text, uncertainty
from remaster_ros.reports.rows_csv import (
    PREDICTIONS_FILE,
    RESIDUALS_FILE,
    predictions_text,
    residuals_text,
)
from remaster_ros.reports.sentences import std_remark
from remaster_ros.session.files import make_folder, write_atomically, writing
from remaster_ros.session.json_records import encoded

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.confirmation import Confirmation
    from remaster_ros.discovery.decision import Decision
    from remaster_ros.discovery.discover import Discovery


def prepare_folder(folder: str | os.PathLike[str], result: str) -> None:
    """Create a folder for results and check that files can be written there, before the long work.

    Parameters
    ----------
    result
        File that the command writes there, `FIT_FILE` or `DISCOVERY_FILE`. A folder that has it,
        and not that of the other command, belongs to the command.

    Raises
    ------
    InputError
        The folder cannot be written to, or has files of another command that would be replaced.
    """
    folder = Path(folder)
    make_folder(folder)
    with writing(folder):
        there = sorted(path.name for path in folder.iterdir())
    (other,) = {FIT_FILE, DISCOVERY_FILE} - {result}
    foreign = [
        name for name in there if name == other or (name in WRITTEN and result not in there)
    ]
    if result in there:
        require_own(folder / result, FORMATS[result])
    if foreign:
        raise InputError(
            f'{folder}: holds {", ".join(foreign)}, not written by this command, some of which it '
            'would replace; name another folder'
        )
    with writing(folder):
        # A file without a name: an interrupt leaves nothing behind.
        tempfile.TemporaryFile(dir=folder).close()


def _remove_report(folder: Path) -> None:
    """Remove report.html of an earlier run, if any, which would contradict the new result."""
    with writing(folder / REPORT_FILE):
        (folder / REPORT_FILE).unlink(missing_ok=True)


def save_fit(result: FitResult, folder: str | os.PathLike[str], figures: bool = True) -> Path:
    """Write fit.json, residuals.csv, the files to apply, and the report with figures.

    Without figures there is no report; that of an earlier fit in the folder is removed, as it
    would contradict fit.json.

    Returns
    -------
    Path
        The report; fit.json without figures.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    folder = Path(folder)
    make_folder(folder)
    text = encoded(fit_content(result))
    write_atomically(folder / FIT_FILE, text)
    result_sha256 = hashlib.sha256(text).hexdigest()
    write_atomically(folder / RESIDUALS_FILE, residuals_text(result))
    geometry = geometry_of(result)
    remarks = [] if geometry is None else [std_remark(geometry.tolerance_m)]
    files = exports(result, remarks, uncertainty(result).std)
    if geometry is not None and geometry.is_better:
        files[MODEL_FILE] = model_text(result, geometry)
    files[COMPENSATION_FILE] = compensation_text(result, result_sha256)
    _write_applied(folder, files)
    if not figures:
        _remove_report(folder)
        return folder / FIT_FILE
    # Matplotlib and the templates take a second to import: only where a report is made.
    from remaster_ros.reports.fit_page import write_fit_report

    return write_fit_report(result, folder)


def save_discovery(
    discovery: Discovery,
    folder: str | os.PathLike[str],
    confirmation: Confirmation | None = None,
    figures: bool = True,
    decided: Sequence[Decision] = (),
) -> Path:
    """Write discovery.json, predictions.csv, the files to apply and, with figures, the report.

    ``decided`` are decisions between causes and look-alikes of an earlier search.

    Returns
    -------
    Path
        The report; discovery.json without figures.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    # `fit` does not need what discovers.
    from remaster_ros.reports.discovery_json import discovery_content, predictions_of
    from remaster_ros.reports.loadable import applied

    folder = Path(folder)
    make_folder(folder)
    predictions = predictions_of(discovery)
    content = discovery_content(discovery, confirmation, predictions, decided)
    text = encoded(content)
    write_atomically(folder / DISCOVERY_FILE, text)
    result_sha256 = hashlib.sha256(text).hexdigest()
    gross = {observation for observation, _ in discovery.fit.left_out}
    rows = predictions_text(discovery.fit.session, predictions, gross)
    write_atomically(folder / PREDICTIONS_FILE, rows)
    _write_applied(folder, applied(discovery, predictions.widening, result_sha256))
    if not figures:
        _remove_report(folder)
        return folder / DISCOVERY_FILE
    # Matplotlib and the templates take a second to import: only where a report is made.
    from remaster_ros.reports.discovery_page import write_discovery_report

    return write_discovery_report(discovery, content, folder)


def _write_applied(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write the files to apply into the folder's ``apply``, by name.

    Robot model and compensation.json of an earlier run, which would contradict them, are removed
    first. Raises DiskError if the folder cannot be written to.
    """
    make_folder(folder / APPLY_FOLDER)
    for name in (MODEL_FILE, COMPENSATION_FILE):
        (folder / APPLY_FOLDER / name).unlink(missing_ok=True)
    for name, content in files.items():
        write_atomically(folder / APPLY_FOLDER / name, content)
