"""discovery.json as the contract has it, and a report that stands alone."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from discovery_scenes import at_joint, session_with

from remaster_ros.calibration.noise import Noise, NoiseModel
from remaster_ros.discovery.confirmation import confirm
from remaster_ros.discovery.discover import discover_session
from remaster_ros.discovery.effects.base import Design
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.errors import InputError
from remaster_ros.reports import discovery_figures
from remaster_ros.reports.discovery_json import read_discovery, save_discovery


def bent(session):
    return at_joint(2, 1.5e-3 * np.sin(2.0 * session.measurements.q[:, 1]))


@pytest.fixture(scope='module')
def saved(tmp_path_factory):
    session = session_with(41, bent, poses=25, validation=15)
    found = discover_session(session, rng=np.random.default_rng(0))
    folder = tmp_path_factory.mktemp('discovery')
    # Arm and poses are drawn from the seed, in turn: the same arm needs as many poses.
    again = session_with(41, bent, poses=25, validation=15, pose_sigma_m=0.3e-3)
    assert save_discovery(found, folder, confirm(found, again)) == folder / 'report.html'
    return found, folder


def test_discovery_json_keeps_its_contract(saved):
    found, folder = saved
    content = json.loads((folder / 'discovery.json').read_text())
    assert content['format'] == 'remaster-discovery/1'
    assert content['verdict'] == found.verdict == 'effects'
    (effect,) = content['effects']
    assert (effect['name'], effect['joints']) == ('encoder_eccentricity', [2])
    assert (effect['place'], effect['form']) == ('joint_angle', 'sin/cos')
    assert effect['parameters'][0].keys() == {'name', 'value', 'std', 'unit'}
    for other in effect['confusable_with']:
        assert other.keys() == {'name', 'joints', 'log_evidence_gain', 'separate_by'}
        assert other['separate_by']
    assert content['gain']['held_out_rms_after_m'] < content['gain']['held_out_rms_before_m']
    assert content['joint_offsets_after'][1].keys() >= {'joint', 'mean_deg', 'std_deg'}
    assert content['confirmation']['confirmed'] is True
    assert read_discovery(folder / 'discovery.json') == content


def test_the_report_needs_nothing_else_and_names_the_cause(saved):
    found, folder = saved
    page = (folder / 'report.html').read_text()
    assert not re.findall(r'(?:src|href)="(?!#)[^"]', page)
    assert found.effects[0].cause in page
    assert 'sin2_2' in page
    for name in ('gain', 'drivers', 'causes'):
        ElementTree.parse(folder / 'figures' / f'{name}.svg')


def test_curves_of_a_large_session_are_drawn_at_the_rows_that_were_searched(saved, monkeypatch):
    """Through 100,000 rows they took 15 MB of SVG; in the rows searched they are the same."""
    found, _ = saved

    def curve():
        # Points of what is left, then the curve.
        _, line = discovery_figures.causes(found).axes[0].lines
        return line.get_xdata(), line.get_ydata()

    x, y = curve()
    assert len(x) == len(found.residuals.context)
    monkeypatch.setattr(discovery_figures, 'MOST_DRAWN', 0)
    few_x, few_y = curve()
    assert len(few_x) == len(found.residuals) < len(x)
    # A gap in the line begins with what was measured, so the two differ at gaps alone.
    known, few_known = np.isfinite(y), np.isfinite(few_y)
    assert few_known.mean() > 0.8
    expected = np.interp(few_x, x[known], y[known])
    np.testing.assert_allclose(few_y[few_known], expected[few_known], atol=1e-9)


def test_a_free_curve_is_drawn_where_it_was_measured_with_a_band_that_opens(saved):
    found, _ = saved
    data = found.residuals
    q = data.context.measurements.q[:, 1]
    # A curve of the same joint in place of the wave, with nothing measured in the middle of it.
    away = np.abs(q - np.median(q)) > 0.3
    cell = next(c for c in EFFECTS['joint_error_curve'].cells(data.context) if c.joints == (2,))
    curve = Curve.of(q[away & data.context.to_fit], 0.05)
    names = tuple(f'height_{i}' for i in range(len(curve.places)))
    cell = replace(
        cell,
        curve=curve,
        parameters=names,
        columns=lambda context: Design(1, curve.columns(context.measurements.q[:, 1])),
    )
    seed = 3
    print(f'seed {seed}')
    covariance = 1e-8 * np.linalg.inv(
        curve.columns(q[away]).T @ curve.columns(q[away]) + 1e-3 * curve.penalty
    )
    draws = np.random.default_rng(seed).multivariate_normal(0.0 * curve.places, covariance, 400)
    solution = replace(
        found.selection.solution, cells=(cell,), parameters=draws[0], covariance=covariance
    )
    drawn = replace(
        found,
        groups=((cell,),),
        selection=replace(found.selection, solution=solution),
        fit=replace(found.fit, theta_names=names, theta_draws=draws[None]),
    )
    (axes,) = discovery_figures.causes(drawn).axes
    _, line = axes.lines
    at, heights = np.radians(line.get_xdata()), line.get_ydata()
    gap = np.abs(at - np.median(q)) < 0.2
    assert np.all(np.isnan(heights[gap]))
    assert np.isfinite(heights[~gap]).mean() > 0.5
    (band,) = axes.collections
    vertices = band.get_paths()[0].vertices
    inside = np.abs(np.radians(vertices[:, 0]) - np.median(q)) < 0.2
    assert np.ptp(vertices[inside, 1]) > 3.0 * np.ptp(heights[np.isfinite(heights)])


def test_without_figures_there_is_no_report(saved, tmp_path):
    found, _ = saved
    (tmp_path / 'report.html').write_text('of an earlier run')
    assert save_discovery(found, tmp_path, figures=False) == tmp_path / 'discovery.json'
    assert [path.name for path in tmp_path.iterdir()] == ['discovery.json']


def test_what_is_no_discovery_is_refused_in_one_line(saved, tmp_path):
    _, folder = saved
    content = json.loads((folder / 'discovery.json').read_text())
    for change, words in (
        ({'verdict': 'perhaps'}, 'perhaps'),
        ({'format': 'remaster-discovery/9'}, 'remaster-discovery/9'),
        ({'effects': None}, 'effects'),
    ):
        path = tmp_path / 'discovery.json'
        path.write_bytes(msgspec.json.encode({**content, **change}))
        with pytest.raises(InputError, match=words) as error:
            read_discovery(path)
        assert '\n' not in str(error.value)


def test_noise_along_the_line_of_sight_is_drawn_by_sensor(saved):
    """0.3 mm along it within poses, 0.6 mm across it shared: root mean squares over the axes."""
    found, _ = saved
    data = found.residuals
    noise_model = NoiseModel.of(data.rows, np.eye(4)[None], (0,))
    noise = Noise(np.array([0.3e-3, 0.0]), np.array([0.0, 0.6e-3]))
    selection = replace(
        found.selection,
        empty=replace(found.selection.empty, noise=noise),
        solution=replace(found.selection.solution, noise=noise),
    )
    residuals = replace(data, noise_model=noise_model)
    figure = discovery_figures.gain(replace(found, residuals=residuals, selection=selection))
    heights = [bar.get_height() for bar in figure.axes[1].patches]
    np.testing.assert_allclose(heights, 2 * [0.6 * np.sqrt(2.0 / 3.0), 0.3 / np.sqrt(3.0)])
