# SPDX-License-Identifier: Apache-2.0
"""Page of a fit: tables, figures, and its 3-D view of arm, markers and errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from remaster_ros.calibration.dynamics import MODES, late_words
from remaster_ros.calibration.motion_proof import MotionProof
from remaster_ros.calibration.orientation_accuracy import METRICS as ORIENTATION
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.answer import answer_of
from remaster_ros.reports.answer_figures import draw_stages
from remaster_ros.reports.figure_style import AFTER, BEFORE, arm_lines, evenly
from remaster_ros.reports.fit_figures import draw_fit
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.fit_judgement import references
from remaster_ros.reports.pages import compressed, inlined, page, write_report
from remaster_ros.reports.report_inputs import Inputs
from remaster_ros.reports.robot_scene import RobotScene
from remaster_ros.reports.rows_csv import lengths_mm
from remaster_ros.reports.scene_view import scene_to_dict, view_script
from remaster_ros.reports.schemas import Accuracy, Fit
from remaster_ros.reports.sentences import METRICS, as_drawn, load_words, loadable_of_fit
from remaster_ros.types import FloatArray, IntArray, Session

if TYPE_CHECKING:
    from remaster_ros.calibration.result import FitResult

ARMS_SHOWN = 5
ROWS_SHOWN = 600
# Distance from the middle of the data, in their extents, beyond which only a sensor's direction is
# drawn.
FAR = 1.0


class View3D(NamedTuple):
    """Data of a fit's 3-D view for fit_page.js, and the numbers of its caption."""

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
        """Data of the 3-D view (`picture`) as JSON, gzip-compressed and in base64 for the page."""
        return compressed(json.dumps(self.picture, separators=(',', ':'), allow_nan=False))

    @property
    def code(self) -> str:
        """Scripts of the 3-D view, gzip-compressed and in base64 for the page."""
        return compressed(view_script('fit_page.js'))


def draw_view(result: FitResult) -> View3D:
    """Make the 3-D view of a fit: arms, sensors, markers, and magnified errors before and after.

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
    """Return points, m, as nested lists, rounded to a hundredth of a millimetre."""
    return np.round(points, 5).tolist()


def _point_texts(result: FitResult, shown: IntArray) -> list[str]:
    """Return a text for each shown row: observation, pose, sensor, errors before and after, mm.

    ``shown``: indices of the rows.
    """
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
    """Return a table row for each split and metric of a fit's accuracy.

    Each has the metric before and after, None without a value, and ``why`` with the reason or ''.
    Validation first, if poses were held out; metrics at random configurations once, with split
    'any'.
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


def motion_rows(fit: Fit) -> list[tuple[str, str]]:
    """Results of the fit of a moving session besides offsets: (quantity, value) as texts.

    How late the stamps of each sensor are, lag and wind-up of each joint, the frequency at
    which the tool swings, and the held-out errors in motion and at standstill. [] for a
    session without motion.
    """
    if not isinstance(fit.clocks, dict) or not isinstance(fit.parameters, list):
        return []
    rows = [
        (f'stamps of {name}', late_words(1e-3 * clock.late_ms, 1e-3 * clock.std_ms))
        for name, clock in fit.clocks.items()
    ]
    effects = {p.name.removeprefix('effect.'): p for p in fit.parameters}
    for number, joint in enumerate(fit.joint_offsets, start=1):
        lag, windup = effects.get(f'lag_{number}'), effects.get(f'windup_{number}')
        if lag is None or windup is None:
            continue
        scale = 1e3 if joint.unit == 'mm' else np.degrees(1.0)
        rows.append(
            (
                joint.joint,
                f'reported {late_words(lag.mean, lag.std)}; wind-up by friction '
                f'{scale * abs(windup.mean):.4f} ± {scale * windup.std:.4f} '
                f'{joint.unit}',
            )
        )
    modes = [effects[name] for name in MODES[:3] if name in effects]
    swings = [1.0 / (2.0 * np.pi * np.sqrt(m.mean)) for m in modes if m.mean > 3.0 * m.std]
    if swings:
        rows.append(('the tool swings at', f'{min(swings):.1f} to {max(swings):.1f} Hz'))
    if isinstance(proof := fit.motion_proof, MotionProof):
        rows.append(
            (
                f'error in motion, at up to {proof.fastest_mm_s:.0f} mm/s',
                f'{proof.motion_mm:.3f} mm; at standstill {proof.standstill_mm:.3f} mm (held out, '
                'mean of the markers)',
            )
        )
    return rows


def write_fit_report(result: FitResult, folder: Path) -> Path:
    """Write report.html and the figures of a fit to a folder; return the path of report.html.

    ``folder``: made if missing. Raises DiskError if it cannot be written to.
    """
    drawings = draw_fit(result) | draw_stages(answer_of(inputs_of(result)))
    return write_report(folder, drawings, fit_html(result, drawings))


def inputs_of(result: FitResult) -> Inputs:
    """Return a fit as the `Inputs` of a report; what needs a discovery is None."""
    before_mm, after_mm = map(lengths_mm, (result.residuals_before, result.residuals_after))
    return Inputs(result.session, fit_content(result), None, before_mm, after_mm, None)


def fit_html(result: FitResult, drawings: dict[str, str]) -> str:
    """Return the text of a fit's page.

    ``drawings``: SVG text by name, of `draw_fit` and `draw_stages`; if {}, the page has no
    figures and no 3-D view.
    """
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
