# SPDX-License-Identifier: Apache-2.0
"""Pages of a fit, of a discovery and of both, self-contained; the last one also as PDF."""

from __future__ import annotations

import base64
import json
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
from markupsafe import Markup
from msgspec import UNSET

from remaster_ros.calibration.orientation_accuracy import METRICS as ORIENTATION
from remaster_ros.compensation.export import APPLY_FOLDER, MODEL_FILE
from remaster_ros.compensation.file import COMPENSATION_FILE
from remaster_ros.compensation.file import FILE_LIMIT as COMPENSATION_BYTES
from remaster_ros.discovery.words import clock_time
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.answer import (
    ALL_FILES,
    NO_FILE,
    Answer,
    Inputs,
    answer_of,
)
from remaster_ros.reports.figures import (
    AFTER,
    BEFORE,
    Subject,
    arm_lines,
    draw_answer,
    draw_discovery,
    draw_fit,
    draw_stages,
    evenly,
)
from remaster_ros.reports.fit_json import REPORT_FILE, fit_content
from remaster_ros.reports.pages import compressed, inlined, page, write_report
from remaster_ros.reports.robot_scene import RobotScene, scene_to_dict, view_script
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.reports.schemas import Accuracy, Discovered
from remaster_ros.reports.sentences import (
    METRICS,
    MOST_PARAMETERS,
    as_drawn,
    load_words,
    loadable_of_fit,
    motion_rows,
    references,
)
from remaster_ros.session.files import decode_text, make_folder, read_limited, write_atomically
from remaster_ros.types import FloatArray, IntArray, Session

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult
    from remaster_ros.discovery.discover import Discovery
    from remaster_ros.session.records.plan_journal import RecordedPlan


# The 3-D view of a fit: arm, measured markers, magnified error vectors, sensors.


ARMS_SHOWN = 5
ROWS_SHOWN = 600
# Distance from the middle of the data, in their extents, beyond which only a sensor's direction is
# drawn.
FAR = 1.0


class View3D(NamedTuple):
    """Data that fit_page.js shows, and figures of its caption."""

    # All in the robot base R, m: `scene` (`scene_to_dict`), `arms` (a, k + 2, 3), `points` (n, 3)
    # with `text`, ends of their error vectors (`before` and `after`, (n, 3)), `sensors` with
    # `text` and `line` (from, to), and the `legend`
    picture: dict[str, Any]
    magnification: int  # Factor by which the error vectors are enlarged
    # Numbers of observations that are drawn, and of all
    rows_shown: int
    rows: int
    # Sensors so far away that only their direction is drawn, as the arm would be tiny otherwise
    far_sensors: list[str]

    @property
    def data(self) -> str:
        """The picture as JSON, compressed and in base64 for the page."""
        return compressed(json.dumps(self.picture, separators=(',', ':'), allow_nan=False))

    @property
    def code(self) -> str:
        """The scripts of the 3-D view, compressed and in base64 for the page."""
        return compressed(view_script('fit_page.js'))


def draw_view(result: FitResult) -> View3D:
    """3-D view of a fit: arms, sensors, markers, and magnified errors before and after.

    At most `ROWS_SHOWN` rows and `ARMS_SHOWN` arms, evenly spread, are drawn.
    """
    m, chain = result.session.measurements, result.chain
    shown = evenly(len(m), ROWS_SHOWN)
    sensors = [result.session.sensor_names[i] for i in m.sensor[shown]]
    T_R_N = np.array([result.T_R_N[sensor] for sensor in sensors])
    T_before = np.array([result.T_R_N_before[sensor] for sensor in sensors])
    points = apply(T_R_N, m.position[shown])
    # From where the marker was measured to where the model has it: minus the residual.
    vectors = {
        when: -np.einsum('nij,nj->ni', T[:, :3, :3], residuals[shown])
        for when, T, residuals in (
            ('before', T_before, result.residuals_before),
            ('after', T_R_N, result.residuals_after),
        )
    }
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    typical = float(np.median(np.linalg.norm(vectors['before'], axis=1)))
    times = _round_factor(0.07 * extent / max(typical, 1e-9))
    arms = arm_lines(chain, m.q[evenly(len(m), ARMS_SHOWN)], result.joint_offsets)
    far: list[str] = []
    marked = []
    centre = points.mean(axis=0)
    nearest = FAR * max(extent, 0.5)
    for sensor, T in result.T_R_N.items():
        place, text = T[:3, 3], sensor
        line = place, place
        distance = np.linalg.norm(place - centre)
        if distance > nearest:
            far.append(sensor)
            # From the middle of the data towards it.
            way = (place - centre) * nearest / distance
            line = centre + 0.5 * way, centre + 0.65 * way
            text = f'to {sensor}, {np.linalg.norm(place):.1f} m from the base'
        marked.append({'text': text, 'line': _rounded(np.array(line))})
    picture = {
        'scene': scene_to_dict(RobotScene(chain, (), (), 0.0, ())),
        'arms': _rounded(arms),
        'points': _rounded(points),
        'text': _point_texts(result, shown),
        'errors': {when: _rounded(points + times * of) for when, of in vectors.items()},
        'sensors': marked,
        'legend': {
            'arm': f'arm, {len(arms)} of its configurations',
            'soft': 'markers as measured',
            'before': f'error before, {times}\N{MULTIPLICATION SIGN}',
            'after': f'error after, {times}\N{MULTIPLICATION SIGN}',
            'sight': 'sensors',
        },
    }
    return View3D(picture, times, len(shown), len(m), far)


def _rounded(points: FloatArray) -> Any:
    """Points as lists, to a hundredth of a millimetre."""
    return np.round(points, 5).tolist()


def _point_texts(result: FitResult, shown: IntArray) -> list[str]:
    """Description of each shown row (indices): numbers, sensor, errors before and after, mm."""
    m = result.session.measurements
    before, after = (
        lengths_mm(residuals[shown])
        for residuals in (result.residuals_before, result.residuals_after)
    )
    return [
        f'observation {m.observation[row]}, pose {m.pose[row]}, '
        f'{result.session.sensor_names[m.sensor[row]]}\n'
        f'error {b:.3f} mm before, {a:.3f} mm after'
        for row, b, a in zip(shown, before, after, strict=True)
    ]


def _round_factor(factor: float) -> int:
    """Largest of 1, 2, 5, 10, 20, … that is at most `factor`; at least 1."""
    if factor < 2:
        return 1
    power = 10 ** int(np.floor(np.log10(factor)))
    return int(power * max(step for step in (1, 2, 5) if step * power <= factor))


def accuracy_rows(accuracy: Accuracy) -> list[dict[str, Any]]:
    """A row for each split and metric, with the reason if there is no number.

    Validation first, if held out; metrics at random configurations once, with split 'any'.
    """
    rows = []
    for split in ('validation', 'optimization'):
        metrics = getattr(accuracy, split)
        if metrics is None:
            continue
        for metric in METRICS:
            at_random = metric.endswith('_random')
            if at_random and split == 'validation':
                continue  # They are the same for both.
            if metric in ORIENTATION and metric not in metrics:
                continue
            sides = metrics[metric]
            rows.append(
                {
                    'split': 'any' if at_random else split,
                    'metric': metric,
                    'angular': metric in ORIENTATION,
                    'cells': [sides.get(side) for side in ('before', 'after')],
                    'offsets_only': sides.get('after_offsets_only'),
                    'why': sides.get('why', ''),
                }
            )
    return rows


def marker_rows(fit: Mapping[str, Any], session: Session) -> list[dict[str, Any]]:
    """A row for each marker of a fit.json: position, std, distance from the nominal one, mm."""
    rows = []
    for name, marker in fit['markers'].items():
        position = np.array(marker['position_m'])
        rows.append(
            {
                'name': name,
                'position_mm': (1e3 * position).tolist(),
                'std_mm': (1e3 * np.array(marker['std_m'])).tolist(),
                'moved_mm': 1e3 * float(np.linalg.norm(position - session.markers[name])),
            }
        )
    return rows


def write_fit_report(result: FitResult, folder: Path) -> Path:
    """Write report.html and the figures of a fit to a folder, made if missing.

    Returns its path.
    """
    drawings = draw_fit(result) | draw_stages(answer_of(inputs_of(result)))
    return write_report(folder, drawings, fit_html(result, drawings))


def inputs_of(result: FitResult) -> Inputs:
    """`Inputs` of the first screen for a fit alone; what needs a discovery is None."""
    before_mm, after_mm = map(lengths_mm, (result.residuals_before, result.residuals_after))
    return Inputs(result.session, fit_content(result), None, before_mm, after_mm, None)


def fit_html(result: FitResult, drawings: dict[str, str]) -> str:
    """Page of a fit; with drawings (of `draw_fit`) also the 3-D view, without ({}) none."""
    scene: View3D | None = None
    if drawings:
        scene = draw_view(result)
    inputs = inputs_of(result)
    fit, geometry = msgspec.to_builtins(inputs.fit), inputs.fit.geometry
    loadable = [] if geometry is msgspec.UNSET else loadable_of_fit(geometry)
    return page(
        'report.html.jinja',
        fit=fit,
        as_drawn='' if geometry is msgspec.UNSET else as_drawn(geometry, geometry.imitations),
        to_load=[(row, *load_words(row)) for row in loadable],
        answer=answer_of(inputs),
        accuracy=accuracy_rows(inputs.fit.accuracy),
        motion=motion_rows(inputs.fit),
        markers=marker_rows(fit, result.session),
        references=references(result),
        session=result.session,
        drawings={name: inlined(name, text) for name, text in drawings.items()},
        scene=scene,
        before=BEFORE,
        after=AFTER,
    )


# Page of a discovery.


def write_discovery_report(discovery: Discovery, content: Discovered, folder: Path) -> Path:
    """Write report.html and figures of a discovery to a folder, made if missing; return its path.

    Raises DiskError if the folder cannot be written to.
    """
    drawings = draw_discovery(discovery)
    html = discovery_html(content, discovery.fit.session, drawings)
    return write_report(folder, drawings, html)


def discovery_html(content: Discovered, session: Session, drawings: dict[str, str]) -> str:
    """Page of a discovery, with the given drawings (of `draw_discovery`)."""
    return page(
        'discovery.html.jinja',
        found=msgspec.to_builtins(content),
        session=session,
        most_parameters=MOST_PARAMETERS,
        to_load=[(row, *load_words(row)) for row in content.loadable or ()],
        drawings={name: inlined(name, text) for name, text in drawings.items()},
    )


# The plan of a collection, its outcome, and the precision reached.

PLAN_FILE = 'plan.html'
RECORDED = ('recorded', 'partial')
NOT_VISITED = 'not visited'
AS_EXPECTED = 1.5
"""Largest factor between expected and reached standard deviations, in the median, that counts as
agreement."""


class PlannedRow(NamedTuple):
    """Planned and recorded configurations of a split, and numbers of lost ones by reason."""

    words: str
    poses: int
    planned: int
    recorded: int
    lost: dict[str, int]


class StdRow(NamedTuple):
    """Standard deviation of a joint's offset: expected, and of the fit; None if unknown."""

    joint: str
    unit: Literal['deg', 'mm']
    expected: float | None
    fit: float | None


@dataclass(frozen=True)
class PlanFacts:
    """Facts of a plan for the page."""

    name: str  # Fingerprint of the plan
    rows: tuple[PlannedRow, ...]  # One for each split
    visits: int  # Number of recorded visits to references
    minutes: float | None  # From the first reading to the last; None if times are unknown
    # Reason -> poses and configurations that were never in the plan
    dropped: dict[str, tuple[int, int]]
    stds: tuple[StdRow, ...]  # One for each joint; empty if none were expected
    # Median ratio of the fit's standard deviations to the expected ones; None if unknown
    ratio: float | None
    tool_mm: float | None  # Expected RMS error of the predicted markers; None if unknown
    enough: bool  # Whether poses were left out because the precision sufficed
    drawn: bool  # Whether there is a page that plays the plan

    @property
    def verdict(self) -> str:
        """Sentence on expected and reached standard deviations; '' if unknown.

        Within a factor of 1.5 (`AS_EXPECTED`) they agree.
        """
        if self.ratio is None:
            return ''
        if self.ratio < 1.0 / AS_EXPECTED:
            return (
                f'The fit states the offsets {1.0 / self.ratio:.1f} times better than was '
                'expected: the readings scatter less than noise_m and pose_noise_m of the cell '
                'file state.'
            )
        if self.ratio <= AS_EXPECTED:
            return 'The fit states the offsets about as well as was expected.'
        return (
            f'The fit states the offsets {self.ratio:.1f} times less well than was expected: the '
            'readings scatter more than noise_m and pose_noise_m of the cell file state, or '
            'configurations were lost.'
        )


def plan_facts(inputs: Inputs) -> PlanFacts | None:
    """Facts of the session's plan for the page; None if it has none.

    Numbers by split, reasons of dropped poses, minutes that it took (None without times), expected
    and reached standard deviations and their median ratio.
    """
    plan, session = inputs.plan, inputs.session
    if plan is None:
        return None
    # What plans is imported where there is a plan.
    from remaster_ros.collection.plan_confirmation import fingerprint
    from remaster_ros.reports.plan_page import WORDS

    splits = [split for split in WORDS if split in plan.tour.configurations]
    stds = _stds(inputs, plan)
    ratios = [row.fit / row.expected for row in stds if row.fit and row.expected]
    stamps = [session.measurements.stamp_s]
    stamps += [] if session.references is None else [session.references.stamp_s]
    tour = plan.tour
    return PlanFacts(
        fingerprint(tour),
        tuple(_row(plan, split, WORDS[split][0]) for split in splits),
        sum(plan.references[result] for result in RECORDED),
        float(np.ptp(np.concatenate(stamps))) / 60.0 if session.timed else None,
        {
            reason: (tour.dropped[reason], tour.dropped_solutions[reason])
            for reason in (tour.dropped_solutions + tour.dropped)
        },
        stds,
        float(np.median(ratios)) if ratios else None,
        1e3 * plan.expected.tool_rms_m if plan.expected is not None else None,
        plan.enough,
        bool(drawn_plan(plan)),
    )


def _row(plan: RecordedPlan, split: str, words: str) -> PlannedRow:
    """Planned and recorded configurations of a split, and those lost, by reason.

    ``words``: name of the split on the page. Those without an outcome count as not visited.
    """
    poses = plan.tour.plans[split].poses
    ends = Counter(
        result for (row_split, *_), result in plan.outcomes.items() if row_split == split
    )
    recorded = sum(ends.pop(result, 0) for result in RECORDED)
    planned = plan.tour.configurations[split]
    missing = planned - recorded - ends.total()
    lost = {result.replace('_', ' '): count for result, count in ends.most_common()}
    lost |= {NOT_VISITED: missing} if missing > 0 else {}
    return PlannedRow(words, len(poses), planned, recorded, lost)


def _stds(inputs: Inputs, plan: RecordedPlan) -> tuple[StdRow, ...]:
    """Expected and reached standard deviation of each joint's offset, deg or mm.

    Those of the model alone, of an arm exactly as drawn. () if none were expected.
    """
    if plan.expected is None:
        return ()
    expected = plan.expected.joint_std_rad
    rows = []
    for row in inputs.fit.joint_offsets:
        # Of the model and the drawing, as what is expected: of errors left, and of an arm that is
        # off its drawing, it is wider.
        keys = ('model_std', 'std_if_exactly_drawn', 'std')
        stds = [getattr(row, f'{key}_{row.unit}') for key in keys]
        std = next(value for value in stds if value is not UNSET)
        before = expected.get(row.joint)
        scale = 1e3 if row.unit == 'mm' else float(np.degrees(1.0))
        shown = None if before is None else scale * before
        rows.append(StdRow(row.joint, row.unit, shown, std if row.identifiable else None))
    return tuple(rows)


def drawn_plan(plan: RecordedPlan) -> bytes:
    """Page that plays the plan, if the planner left one with the session; b'' otherwise."""
    from remaster_ros.collection.plan_confirmation import fingerprint
    from remaster_ros.reports.plan_page import read_plan_page

    try:
        return read_plan_page(plan.page, fingerprint(plan.tour))
    except InputError:
        return b''


def copy_plan(plan: RecordedPlan | None, folder: Path) -> None:
    """Copy the page of the plan to a folder, so that the report is complete.

    An earlier copy is removed, also if there is no plan.
    """
    (folder / PLAN_FILE).unlink(missing_ok=True)
    if plan is not None and (html := drawn_plan(plan)):
        write_atomically(folder / PLAN_FILE, html)


def plan_to_dict(plan: PlanFacts) -> dict[str, Any]:
    """Facts of a plan in ``remaster report --json``."""
    return {
        'name': plan.name,
        'splits': [row._asdict() for row in plan.rows],
        'reference_visits': plan.visits,
        'minutes': plan.minutes,
        'dropped': {reason: counts[0] for reason, counts in plan.dropped.items()},
        'dropped_configurations': {reason: counts[1] for reason, counts in plan.dropped.items()},
        **{
            f'std_{unit}': {
                row.joint: {'expected': row.expected, 'fit': row.fit}
                for row in plan.stds
                if row.unit == unit
            }
            for unit in ('deg', 'mm')
            if unit == 'deg' or any(row.unit == unit for row in plan.stds)
        },
    }


# Page of `remaster report`: the answer first, then its reasons.

PDF_FILE = 'report.pdf'
ANSWER_GENERATOR = 'remaster report'
WORST_ROWS = 10
# Figures written by `fit` and `discover` that this page shows.
FIT_FIGURES = ('posteriors', 'traces', 'tool_places', 'accuracy_map')
FOUND_FIGURES = ('causes', 'drivers')
FILE_LIMIT = 64 * 1024**2
PDF_REMEDY = "pip install 'remaster_ros[pdf]'"


class WorstRow(NamedTuple):
    """A row with a large error."""

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
        The folder has the report of another command or cannot be written to, or the library for
        PDF is missing.
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
    """Library for PDF if asked for, else None; checks the destination before the long work.

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
    """Text of a report's page; ``drawings``: figures as HTML by name; ``printing``: for PDF."""
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
    """Further remarks on the fit, on the model with causes, and on the other session, a line each.

    Findings that the causes answer, and disagreements that are listed elsewhere, are left out.
    """
    judgement, found = inputs.judgement, inputs.found
    answered = judgement.findings if found is not None else []
    lines = [] if answer.uses_causes else judgement.points
    lines = [line for line in lines if line not in (*answered, *judgement.disagreements)]
    if found is not None and isinstance(found.judgement, msgspec.Struct):
        lines += [found.judgement.headline, *found.judgement.points, *found.judgement.doubts]
    return lines


def measured_when(inputs: Inputs) -> str:
    """Times of the first and the last reading (UTC); the session's date without clock times."""
    stamps = inputs.session.measurements.stamp_s
    if inputs.session.timed and (first := clock_time(float(stamps.min()))):
        last = clock_time(float(stamps.max()))
        return f'{first} to {last.removesuffix(first[8:])}'.strip()
    return inputs.session.created


def _fitted_left_out(inputs: Inputs, answer: Answer) -> int:
    """Number of gross errors among the rows to fit, of the model that the answer uses."""
    m = inputs.session.measurements
    left_out = inputs.gross if answer.uses_causes else list(inputs.fit_left_out)
    return int(np.sum(~m.is_validation & np.isin(m.observation, left_out)))


def worst_rows(inputs: Inputs, answer: Answer) -> list[WorstRow]:
    """The 10 rows (`WORST_ROWS`) with the largest errors after the action, the largest first."""
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

    Those of an earlier report are removed first. ``source``: folder with the files; ``model``,
    ``compensation``: paths, None without such a file. Raises InputError if one cannot be read.
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
    """Texts of those figures (SVG) of a fit or a discovery in a folder that exist, by name.

    Raises InputError if one has more than a drawing.
    """
    texts = {}
    for name in names:
        path = folder / 'figures' / f'{name}.svg'
        if path.exists():
            data = read_limited(path, FILE_LIMIT, 'it was there')
            texts[name] = checked_svg(decode_text(data, path), path)
    return texts


# Elements that Matplotlib uses. A page must not run or load anything from a foreign file.
SVG_ELEMENTS = {
    *('svg', 'g', 'path', 'use', 'text', 'tspan', 'rect', 'clipPath', 'defs', 'style', 'title'),
    *('metadata', 'line', 'circle', 'image', 'pattern', 'linearGradient', 'stop'),
}


def checked_svg(text: str, path: Path) -> str:
    """Text of a figure, unchanged. Raises InputError if it has more than a drawing.

    More: scripts, links or styles that load something, or elements not in `SVG_ELEMENTS`.
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
    """SVG figure as an embedded <img>: it keeps its colours, whatever the styles of the page."""
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
