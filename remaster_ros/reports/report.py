"""report.html: one self-contained page with what the fit found and how reliable it is."""

from __future__ import annotations

import base64
import gzip
import importlib.resources
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from markupsafe import Markup

from remaster_ros.reports.answer import answer_of
from remaster_ros.reports.answer_figures import draw_stages
from remaster_ros.reports.answer_inputs import Inputs
from remaster_ros.reports.figures import draw_figures
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.fit_tables import accuracy_rows, marker_rows
from remaster_ros.reports.judgement import references
from remaster_ros.reports.pages import inlined, page, write_report

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.reports.view_3d import View3D


def write_fit_report(result: FitResult, folder: Path) -> Path:
    """Write report.html and the figures of a fit to a folder, made if missing; return its path.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    drawings = draw_figures(result) | draw_stages(answer_of(inputs_of(result)))
    return write_report(folder, drawings, report_html(result, drawings))


def inputs_of(result: FitResult) -> Inputs:
    """Return a fit as the first screen takes it."""
    lengths = (
        1e3 * np.linalg.norm(residuals, axis=1)
        for residuals in (result.residuals_before, result.residuals_after)
    )
    before_mm, after_mm = lengths
    return Inputs(result.session, fit_content(result), None, before_mm, after_mm, None)


def report_html(result: FitResult, drawings: dict[str, str]) -> str:
    """Return the page; with drawings (of `draw_figures`) it also has the 3-D view."""
    scene: View3D | None = None
    if drawings:
        from remaster_ros.reports.view_3d import draw_view

        scene = draw_view(result)
    inputs = inputs_of(result)
    fit = msgspec.to_builtins(inputs.fit)
    return page(
        'report.html.jinja',
        fit=fit,
        answer=answer_of(inputs),
        accuracy=accuracy_rows(inputs.fit.accuracy),
        markers=marker_rows(fit, result.session),
        references=references(result),
        session=result.session,
        drawings={name: inlined(name, text) for name, text in drawings.items()},
        scene=scene,
        scene_json=_json({'data': scene.data, 'layout': scene.layout}) if scene else '',
        plotly=_plotly() if scene else '',
    )


def _plotly() -> str:
    """Return plotly.js, compressed and in base64: a third of its size in the page."""
    script = importlib.resources.files('plotly').joinpath('package_data', 'plotly.min.js')
    return base64.b64encode(gzip.compress(script.read_bytes(), 9, mtime=0)).decode()


def _json(content: Any) -> Markup:
    """Return JSON that no script element can be left with."""
    text = json.dumps(content, separators=(',', ':'), allow_nan=False)
    return Markup(text.replace('<', '\\u003c'))
