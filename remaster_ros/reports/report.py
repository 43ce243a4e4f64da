# SPDX-License-Identifier: Apache-2.0
"""Page of `remaster report`, self-contained, also as PDF: the answer first, then its reasons."""

from __future__ import annotations

import base64
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
from markupsafe import Markup

from remaster_ros.compensation.export import APPLY_FOLDER, MODEL_FILE
from remaster_ros.compensation.file import COMPENSATION_FILE
from remaster_ros.compensation.file import FILE_LIMIT as COMPENSATION_BYTES
from remaster_ros.discovery.words import clock_time
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.answer import ALL_FILES, Answer, answer_of
from remaster_ros.reports.answer_figures import Subject, draw_answer
from remaster_ros.reports.fit_json import REPORT_FILE
from remaster_ros.reports.fit_page import accuracy_rows, marker_rows
from remaster_ros.reports.pages import inlined, page
from remaster_ros.reports.plan_facts import PLAN_FILE, copy_plan, plan_facts
from remaster_ros.reports.remaining_errors import NO_FILE
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.session.files import decode_text, make_folder, read_limited, write_atomically
from remaster_ros.types import FloatArray

PDF_FILE = 'report.pdf'
ANSWER_GENERATOR = 'remaster report'
WORST_ROWS = 10
# Figures written by `fit` and `discover` that this page shows.
FIT_FIGURES = ('posteriors', 'traces', 'tool_places', 'accuracy_map')
FOUND_FIGURES = ('causes', 'drivers')
FILE_LIMIT = 64 * 1024**2
PDF_REMEDY = "pip install 'remaster_ros[pdf]'"
# Elements that Matplotlib uses. A page must not run or load anything from a foreign file.
SVG_ELEMENTS = {
    *('svg', 'g', 'path', 'use', 'text', 'tspan', 'rect', 'clipPath', 'defs', 'style', 'title'),
    *('metadata', 'line', 'circle', 'image', 'pattern', 'linearGradient', 'stop'),
}


class WorstRow(NamedTuple):
    """Row of a session with a large error, for a report's table: numbers, place, errors."""

    observation: int
    pose: int
    configuration: int
    split: str
    sensor: str
    when: str
    place_mm: FloatArray
    before_mm: float
    after_mm: float
    remark: str


def write_answer(
    inputs: Inputs,
    fit_folder: Path,
    found_folder: Path | None,
    folder: Path,
    figures: bool = True,
    pdf: bool = False,
) -> Answer:
    """Write report.html, the files to apply and, on demand, report.pdf; return the answer.

    Parameters
    ----------
    inputs
        Session and results.
    fit_folder, found_folder
        Folders of the fit and of the discovery, with figures and files to apply.
    folder
        Destination, made if missing.
    figures, pdf
        Whether to have figures, and report.pdf.

    Raises
    ------
    InputError
        The folder has the report of another command or cannot be written to, a file to apply or a
        figure of the results cannot be used, or the library for PDF is missing.
    """
    printer = require_ready(folder, pdf)
    answer = answer_of(inputs)
    subject = Subject(inputs, answer, _chain(inputs))
    drawings: dict[str, str] = {}
    if figures:
        drawings = draw_answer(subject) | _figures_of(fit_folder, FIT_FIGURES)
        if found_folder is not None:
            drawings |= _figures_of(found_folder, FOUND_FIGURES)
    make_folder(folder)
    html = answer_html(subject, {name: inlined(name, svg) for name, svg in drawings.items()})
    source = found_folder if answer.uses_causes and found_folder else fit_folder
    compensation = next(
        (
            path
            for directory in (found_folder, fit_folder)
            if directory is not None
            and (path := directory / APPLY_FOLDER / COMPENSATION_FILE).exists()
        ),
        None,
    )
    _copy_apply(source / APPLY_FOLDER, inputs.model, compensation, answer, folder)
    copy_plan(inputs.plan, folder)
    write_atomically(folder / REPORT_FILE, html)
    if printer is not None:
        printed = {name: as_image(svg) for name, svg in drawings.items()}
        document = printer.HTML(string=answer_html(subject, printed, printing=True))
        write_atomically(folder / PDF_FILE, document.write_pdf())
    return answer


def require_ready(folder: Path, pdf: bool) -> Any:
    """Check the destination of a report before the long work; return the library for PDF.

    None unless ``pdf``.

    Raises
    ------
    InputError
        The folder has the report of another command, or the library is missing.
    """
    from remaster_ros.reports.plan_page import check_plan_page

    path = folder / REPORT_FILE
    if path.exists():
        head = read_limited(path, FILE_LIMIT, 'it was there')[:2000]
        if f'name="generator" content="{ANSWER_GENERATOR}"'.encode() not in head:
            raise InputError(
                f'{path}: is not of "remaster report"; name another folder with --out'
            )
    check_plan_page(folder / PLAN_FILE)
    return _pdf_library() if pdf else None


def answer_html(subject: Subject, drawings: dict[str, Markup], printing: bool = False) -> str:
    """Return the text of a report's page.

    ``drawings``: figures as HTML by name; ``printing``: for PDF.
    """
    inputs, answer = subject.inputs, subject.answer
    fit = msgspec.to_builtins(inputs.fit)
    found = msgspec.to_builtins(inputs.found) if inputs.found is not None else None
    if found is not None and MODEL_FILE not in answer.files:
        for effect in found['effects']:
            if effect['in_robot_model']:
                effect['remedy'] = NO_FILE
    source = fit
    if found is not None and answer.uses_causes:
        source = fit | {key: found[key] for key in ('registration', 'markers', 'sampler')}
        source |= {
            'joint_offsets': found['joint_offsets_after'],
            'noise': found['noise']['sensors'],
        }
    return page(
        'answer.html.jinja',
        generator=ANSWER_GENERATOR,
        answer=answer,
        session=inputs.session,
        fit=fit,
        found=found,
        source=source,
        how_sure=_how_sure(inputs, answer),
        accuracy=accuracy_rows(inputs.fit.accuracy),
        markers=marker_rows(source, inputs.session),
        worst=worst_rows(inputs, answer),
        left_out=_fitted_left_out(inputs, answer),
        plan=plan_facts(inputs),
        measured=measured_when(inputs),
        drawings=drawings,
        printing=printing,
    )


def _chain(inputs: Inputs) -> SerialChain:
    """Chain of the session's arm."""
    session = inputs.session
    return SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)


def _how_sure(inputs: Inputs, answer: Answer) -> list[str]:
    """Return further remarks on the fit, the discovery and the other session, a line each.

    Left out are remarks on the fit if the answer uses the causes, findings of the fit if there is
    a discovery, and disagreements, which the report lists elsewhere.
    """
    judgement, found = inputs.judgement, inputs.found
    answered = judgement.findings if found is not None else []
    lines = [] if answer.uses_causes else judgement.points
    lines = [line for line in lines if line not in (*answered, *judgement.disagreements)]
    if found is not None and isinstance(found.judgement, msgspec.Struct):
        lines += [found.judgement.headline, *found.judgement.points, *found.judgement.doubts]
    return lines


def measured_when(inputs: Inputs) -> str:
    """Return the times of the first and the last reading (UTC) as text.

    The session's date if it has no clock times.
    """
    stamps = inputs.session.measurements.stamp_s
    if inputs.session.timed and (first := clock_time(float(stamps.min()))):
        last = clock_time(float(stamps.max()))
        return f'{first} to {last.removesuffix(first[8:])}'.strip()
    return inputs.session.created


def _fitted_left_out(inputs: Inputs, answer: Answer) -> int:
    """Return the number of gross errors among the rows that were not held out.

    By the discovery if the answer uses its causes; else the rows that the fit left out.
    """
    m = inputs.session.measurements
    left_out = inputs.gross if answer.uses_causes else list(inputs.fit_left_out)
    return int(np.sum(~m.is_validation & np.isin(m.observation, left_out)))


def worst_rows(inputs: Inputs, answer: Answer) -> list[WorstRow]:
    """Return the rows with the largest errors after correction, at most 10 (`WORST_ROWS`).

    The largest first, of all rows of the session, fitted and held out. Errors are
    ``answer.final_mm``: with the zero-offsets, and with the causes or the robot model if the
    answer uses them; also if the action is to set nothing.
    """
    session, m = inputs.session, inputs.session.measurements
    final = answer.final_mm
    frames = inputs.T_R_N
    first = float(m.stamp_s.min())
    gross = inputs.found.noise.outliers if inputs.found is not None else ()
    left_out = {} if answer.uses_causes else inputs.fit_left_out
    rows = []
    for i in np.argsort(-final, kind='stable')[:WORST_ROWS]:
        number, sensor = int(m.observation[i]), session.sensor_names[m.sensor[i]]
        when = ''
        if session.timed:
            clock = clock_time(float(m.stamp_s[i]))[:8]
            when = clock or f'{(m.stamp_s[i] - first) / 60.0:.1f} min'
        remark = left_out.get(number, 'gross error' if number in gross else '')
        rows.append(
            WorstRow(
                number,
                int(m.pose[i]),
                int(m.configuration[i]),
                'held out' if m.is_validation[i] else 'fitted',
                sensor,
                when,
                1e3 * apply(frames[sensor], m.position[i]),
                float(inputs.before_mm[i]),
                float(final[i]),
                remark,
            )
        )
    return rows


def _copy_apply(
    source: Path, model: Path | None, compensation: Path | None, answer: Answer, folder: Path
) -> None:
    """Copy the files of the action to the folder's ``apply``, so that the report is complete.

    Those of an earlier report are removed first. ``source``: folder of the files, except of robot
    model and compensation.json, whose paths are ``model`` and ``compensation`` (None if there is
    none). Raises InputError if a file cannot be read.
    """
    make_folder(folder / APPLY_FOLDER)
    for name in ALL_FILES:
        # A file of an earlier page would contradict this one.
        (folder / APPLY_FOLDER / name).unlink(missing_ok=True)
    (folder / APPLY_FOLDER / COMPENSATION_FILE).unlink(missing_ok=True)
    if answer.files and compensation is not None:
        data = read_limited(compensation, COMPENSATION_BYTES, 'it was there')
        write_atomically(folder / APPLY_FOLDER / COMPENSATION_FILE, data)
    for name in answer.files:
        path = model if model is not None and name == MODEL_FILE else source / name
        data = read_limited(path, FILE_LIMIT, 'fit or discover again, which write it')
        write_atomically(folder / APPLY_FOLDER / name, data)


def _figures_of(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the texts of the SVG figures in a folder of results, by name; missing ones left out.

    ``names``: those to look for. Raises InputError if one has more than a drawing, see
    `checked_svg`.
    """
    texts = {}
    for name in names:
        path = folder / 'figures' / f'{name}.svg'
        if path.exists():
            data = read_limited(path, FILE_LIMIT, 'it was there')
            texts[name] = checked_svg(decode_text(data, path), path)
    return texts


def checked_svg(text: str, path: Path) -> str:
    """Return the text of a figure, unchanged, if it is safe to insert into a page.

    Raises InputError if it is no XML, or has more than a drawing: scripts, links or styles
    that load something, or elements not in `SVG_ELEMENTS`.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        raise InputError(f'{path}: no SVG figure; fit or discover again') from None
    for element in root.iter():
        space, _, name = str(element.tag).rpartition('}')
        drawn = name in SVG_ELEMENTS or not space.endswith('svg')
        for key, value in element.attrib.items():
            local = key.rpartition('}')[2].lower()
            outside = local == 'href' and not value.startswith(('#', 'data:image/png;'))
            drawn = drawn and not local.startswith('on') and not outside
        if not drawn or (name == 'style' and re.search(r'@import|url\(', element.text or '')):
            raise InputError(f'{path}: holds more than a drawing; fit or discover again')
    return text


def as_image(svg: str) -> Markup:
    """Return an SVG figure as an HTML <img> with the figure embedded.

    It keeps its colours, whatever the styles of the page.
    """
    data = base64.b64encode(svg.encode()).decode()
    return Markup('<img alt="" src="data:image/svg+xml;base64,{}">').format(data)


def _pdf_library() -> Any:
    """Module of WeasyPrint. Raises InputError, with the way to install it, if it is missing."""
    try:
        import weasyprint
    except ImportError:
        raise InputError(f'--pdf needs WeasyPrint: {PDF_REMEDY}') from None
    except OSError as error:
        # Of its wheel everything but Pango, which draws text.
        raise InputError(
            f'--pdf: WeasyPrint lacks a library of the system ({str(error).splitlines()[0]}): '
            'apt install libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0'
        ) from None
    # It warns of every rule of a style sheet that is for screens.
    logging.getLogger('weasyprint').setLevel(logging.ERROR)
    return weasyprint
