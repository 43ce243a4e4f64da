"""report.html: one self-contained page with what the fit found and how reliable it is."""

from __future__ import annotations

import base64
import gzip
import importlib.resources
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from markupsafe import Markup

from remaster_ros.calibration.orientation_accuracy import METRICS as ORIENTATION
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.answer import answer_of
from remaster_ros.reports.answer_figures import draw_stages
from remaster_ros.reports.answer_inputs import Inputs
from remaster_ros.reports.figures import draw_figures
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.judgement import references
from remaster_ros.reports.pages import inlined, page, write_report
from remaster_ros.reports.schemas import Accuracy
from remaster_ros.types import FloatArray, IntArray, Session

# The 3-D view of a fit: arm, measured markers, magnified error vectors, sensors (for plotly.js).
#
# Only the description is made here, as plain data; the page brings the script.


if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

BEFORE, AFTER, ARM, SENSOR, TEXT = '#e07b39', '#3b82c4', '#7d8896', '#2f9e78', '#808a96'
ARMS_SHOWN = 5
ROWS_SHOWN = 600
# A sensor farther from the middle of the data than so many times their extent is not at its place.
FAR = 1.0


class View3D(NamedTuple):
    """A plotly figure as plain data, and the figures of its caption.

    Attributes
    ----------
    data, layout
        For ``Plotly.newPlot``.
    magnification
        By what the error vectors are drawn too long.
    rows_shown, rows
        How many observations are drawn, of how many.
    far_sensors
        Sensors so far off that only their direction is drawn: at its place one would leave the arm
        tiny.
    """

    data: list[dict[str, Any]]
    layout: dict[str, Any]
    magnification: int
    rows_shown: int
    rows: int
    far_sensors: list[str]


def draw_view(result: FitResult) -> View3D:
    """Return the 3-D view, everything in the robot base R, metres."""
    m = result.session.measurements
    shown = _evenly(len(m), ROWS_SHOWN)
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
    magnification = _round_factor(0.07 * extent / max(typical, 1e-9))

    data = [_arms(result), _points(result, points, shown)]
    for when, color, width in (('before', BEFORE, 2.0), ('after', AFTER, 3.0)):
        data.append(
            _trace(
                f'error {when}, {magnification}\N{MULTIPLICATION SIGN}',
                _segments(points, points + magnification * vectors[when]),
                mode='lines',
                line={'color': color, 'width': width},
                hoverinfo='skip',
            )
        )
    centre = points.mean(axis=0)
    nearest = FAR * max(extent, 0.5)
    far = []
    for sensor, T in result.T_R_N.items():
        way = T[:3, 3] - centre
        if np.linalg.norm(way) > nearest:
            far.append(sensor)
            data.append(_direction(sensor, T, centre, way * nearest / np.linalg.norm(way)))
        else:
            data.append(_sensor(sensor, T))
    return View3D(data, _layout(), magnification, len(shown), len(m), far)


def _trace(name: str, points: FloatArray, **rest: Any) -> dict[str, Any]:
    """Return a trace of points (n, 3) to the hundredth of a millimetre, gaps (NaN) as None."""
    columns = {
        axis: [None if np.isnan(value) else value for value in column]
        for axis, column in zip('xyz', np.round(points, 5).T.tolist(), strict=True)
    }
    return {'type': 'scatter3d', 'name': name, **columns, **rest}


def _arms(result: FitResult) -> dict[str, Any]:
    m = result.session.measurements
    chosen = m.q[_evenly(len(m), ARMS_SHOWN)]
    joints = result.chain.frames(chosen, result.joint_offsets)[..., :3, 3]
    tips = result.chain.forward(chosen, result.joint_offsets)[:, None, :3, 3]
    base = np.zeros((len(chosen), 1, 3))
    gap = np.full((len(chosen), 1, 3), np.nan)
    return _trace(
        f'arm, {len(chosen)} of its configurations',
        np.concatenate((base, joints, tips, gap), axis=1).reshape(-1, 3),
        mode='lines+markers',
        line={'color': ARM, 'width': 6.0},
        marker={'size': 3, 'color': ARM},
        opacity=0.75,
        hoverinfo='skip',
    )


def _points(result: FitResult, points: FloatArray, shown: IntArray) -> dict[str, Any]:
    m = result.session.measurements
    before, after = (
        1e3 * np.linalg.norm(residuals[shown], axis=1)
        for residuals in (result.residuals_before, result.residuals_after)
    )
    text = [
        f'observation {m.observation[row]}, pose {m.pose[row]}, '
        f'{_plain(result.session.sensor_names[m.sensor[row]])}'
        f'<br>error {b:.3f} mm before, {a:.3f} mm after'
        for row, b, a in zip(shown, before, after, strict=True)
    ]
    marker = {'size': 2.5, 'color': TEXT}
    return _trace(
        'markers as measured', points, mode='markers', marker=marker, text=text, hoverinfo='text'
    )


def _sensor(name: str, T_R_N: FloatArray) -> dict[str, Any]:
    name = _plain(name)
    marker = {'size': 6, 'symbol': 'diamond', 'color': SENSOR}
    return _labelled(name, name, T_R_N[None, :3, 3], mode='markers+text', marker=marker)


def _direction(name: str, T_R_N: FloatArray, start: FloatArray, way: FloatArray) -> dict[str, Any]:
    """Return a line from the middle of the data towards a sensor that is farther off."""
    name = _plain(name)
    text = f'to {name}, {np.linalg.norm(T_R_N[:3, 3]):.1f} m from the base'
    line = {'color': SENSOR, 'width': 3}
    points = start + np.array((0.5, 0.65))[:, None] * way
    return _labelled(name, text, points, mode='lines+text', line=line)


def _labelled(name: str, text: str, points: FloatArray, **rest: Any) -> dict[str, Any]:
    return _trace(
        f'sensor {name}',
        points,
        text=[*[''] * (len(points) - 1), text],
        textposition='top center',
        textfont={'color': SENSOR},
        hoverinfo='text',
        **rest,
    )


def _layout() -> dict[str, Any]:
    def axis(name: str) -> dict[str, Any]:
        return {
            'title': {'text': f'{name} (m)'},
            'color': TEXT,
            'gridcolor': 'rgba(128,138,150,0.35)',
            'zerolinecolor': 'rgba(128,138,150,0.7)',
            'showbackground': False,
        }

    return {
        'scene': {
            'xaxis': axis('x'),
            'yaxis': axis('y'),
            'zaxis': axis('z'),
            'aspectmode': 'data',
            'camera': {
                'eye': {'x': 1.45, 'y': 1.45, 'z': 0.85},
                'center': {'x': 0, 'y': 0, 'z': -0.1},
            },
        },
        'paper_bgcolor': 'rgba(0,0,0,0)',
        'font': {'color': TEXT},
        'modebar': {'bgcolor': 'rgba(0,0,0,0)', 'color': TEXT, 'activecolor': AFTER},
        'margin': {'l': 0, 'r': 0, 't': 0, 'b': 0},
        'legend': {'orientation': 'h', 'y': 0, 'yanchor': 'top'},
    }


def _segments(starts: FloatArray, ends: FloatArray) -> FloatArray:
    """Return start, end, gap, start, end, gap, … for one line trace."""
    gap = np.full_like(starts, np.nan)
    return np.stack((starts, ends, gap), axis=1).reshape(-1, 3)


def _evenly(count: int, most: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _round_factor(factor: float) -> int:
    """Return the largest of 1, 2, 5, 10, 20, … that is at most `factor`, at least 1."""
    if factor < 2:
        return 1
    power = 10 ** int(np.floor(np.log10(factor)))
    return int(power * max(step for step in (1, 2, 5) if step * power <= factor))


def _plain(text: str) -> str:
    """Plotly reads labels as a kind of HTML, and entities in some places only."""
    return text.replace('<', '‹').replace('>', '›')


def accuracy_rows(accuracy: Accuracy) -> list[dict[str, Any]]:
    """Return one row per split and metric, and the reason where there is no number."""
    titles = {
        'post_registration': 'Position, sensor registered (eq.\u00a018)',
        'post_registration_orientation': '… orientation',
        'relative': 'Distances between solutions of a pose (eq.\u00a017)',
        'relative_orientation': '… angles',
        'theoretical': 'What the posterior predicts (section V-C)',
        'paper_theoretical': '… in the robot base, offsets alone, as the paper has it',
        'theoretical_random': 'The same predicted at 1,000 random configurations',
        'paper_theoretical_random': '… in the robot base, as the paper has it',
    }
    rows = []
    for split in ('validation', 'optimization'):
        metrics = getattr(accuracy, split)
        if metrics is None:
            continue
        for metric, title in titles.items():
            at_random = metric.endswith('_random')
            if at_random and split == 'validation':
                continue  # They are the same for both.
            if metric in ORIENTATION and metric not in metrics:
                continue
            sides = metrics[metric]
            rows.append(
                {
                    'split': 'any' if at_random else split,
                    'title': title,
                    'angular': metric in ORIENTATION,
                    'cells': [sides.get(side) for side in ('before', 'after')],
                    'offsets_only': sides.get('after_offsets_only'),
                    'why': sides.get('why', ''),
                }
            )
    return rows


def marker_rows(fit: Mapping[str, Any], session: Session) -> list[dict[str, Any]]:
    """Return one row per marker of a fit.json: place, std, and how far from the nominal place."""
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


if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult


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
