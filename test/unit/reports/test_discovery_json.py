# SPDX-License-Identifier: Apache-2.0
"""discovery.json as the contract has it, and a report that stands alone, for every verdict."""

import csv
import html
import json
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure
from msgspec import structs
from worlds.discovery_scenes import at_joint, session_with

from remaster_ros.calibration.noise import Noise, NoiseModel
from remaster_ros.discovery.confirmation import confirm
from remaster_ros.discovery.decision import Named, decisions
from remaster_ros.discovery.discover import Verdict, discover_session
from remaster_ros.discovery.effects.base import Design
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.discovery.gain import Gain
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.reports import discovery_figures, discovery_json
from remaster_ros.reports import loadable as loadables
from remaster_ros.reports.discovery_json import discovery_content, read_discovery
from remaster_ros.reports.discovery_judgement import judgement
from remaster_ros.reports.discovery_page import discovery_html
from remaster_ros.reports.loadable import loadable, model_text
from remaster_ros.reports.result_folder import save_discovery
from remaster_ros.reports.result_lines import discovery_lines
from remaster_ros.reports.schemas import Discovered
from remaster_ros.reports.sentences import coverage_words, load_words, size_words
from remaster_ros.types import Measurements


def bent(session):
    return at_joint(2, 1.5e-3 * np.sin(2.0 * session.measurements.q[:, 1]))


@pytest.fixture(scope='module')
def confirmed():
    """Return a discovery, and what another session of the arm says of it."""
    session = session_with(41, bent, poses=25, validation=15)
    found = discover_session(session, rng=np.random.default_rng(0))
    # Arm and poses are drawn from the seed, in turn: the same arm needs as many poses.
    again = session_with(41, bent, poses=25, validation=15, pose_sigma_m=0.3e-3)
    return found, confirm(found, again, np.random.default_rng(0))


@pytest.fixture(scope='module')
def saved(confirmed, tmp_path_factory):
    found, confirmation = confirmed
    folder = tmp_path_factory.mktemp('discovery')
    pair = (Named('joint_compliance', (2,)), Named('encoder_eccentricity', (2,)))
    decided = decisions(found, [pair])
    report = save_discovery(found, folder, confirmation, decided=decided)
    assert report == folder / 'report.html'
    return found, folder


def test_a_cause_that_another_session_has_with_other_offsets_is_not_called_unconfirmed(
    confirmed, saved
):
    found, confirmation = confirmed
    content = read_discovery(saved[1] / 'discovery.json')
    other = structs.replace(confirmation, confirmed=False, same_offsets=False, other_joints=(3,))
    said = judgement(found, other, content)
    assert said.headline.endswith('The other session has it too, with other zero-offsets.')
    assert said.mood == 'caution'


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
        keys = {'name', 'joints', 'log_evidence_gain', 'separate_by', 'same', 'general'}
        assert other.keys() == keys
        assert other['separate_by']
    assert re.search(r'joint 2 errs by up to [45]\.\d+′ ± 0\.\d+′', effect['cause'])
    assert effect['sizes'][0] in effect['cause']
    assert effect['remedy'].endswith('.')
    assert content['gain']['held_out_rms_after_m'] < content['gain']['held_out_rms_before_m']
    assert content['joint_offsets_after'][1].keys() >= {'joint', 'mean_deg', 'std_deg'}
    # Alone zero-offsets are those of the files for a controller that loads nothing else.
    layer = yaml.safe_load((folder / 'apply/offset_layer.yaml').read_text())
    (parameters,) = (node['ros__parameters'] for node in layer.values())
    loaded = dict(zip(parameters['joint_names'], parameters['joint_offsets'], strict=True))
    known = {
        r['joint']: r['mean_deg'] for r in content['joint_offsets_alone'] if r['identifiable']
    }
    assert loaded.keys() == known.keys()
    for joint, mean_deg in known.items():
        assert np.degrees(loaded[joint]) == pytest.approx(mean_deg, abs=1e-5)
    assert content['confirmation']['confirmed'] is True
    (confirmed,) = content['confirmation']['effects']
    assert confirmed['answer'] == 'confirmed'
    assert confirmed['log_evidence'].keys() == {'shared', 'own', 'absent'}
    (decided,) = content['decided']
    assert decided['answer'] == 'look_alike'
    assert decided['cause'] == {'name': 'joint_compliance', 'joints': [2]}
    assert decided['log_evidence'] < -3.0
    assert read_discovery(folder / 'discovery.json') == msgspec.convert(content, Discovered)


def test_the_report_needs_nothing_else_and_names_the_cause(saved):
    found, folder = saved
    page = (folder / 'report.html').read_text()
    assert not re.findall(r'(?:src|href)="(?!#)[^"]', page)
    assert found.effects[0].cause in page
    assert 'decided: encoder eccentricity of joint 2, not joint compliance of joint 2; ' in page
    assert f'What to do: {found.effects[0].remedy}' in page
    assert 'p &lt; 0.0001 over all causes' in page
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
    is_measured = np.abs(q - np.median(q)) > 0.3
    candidate = next(
        c for c in EFFECTS['joint_error_curve'].candidates(data.context) if c.joints == (2,)
    )
    curve = Curve.of(q[is_measured & data.context.to_fit], 0.05)
    names = tuple(f'height_{i}' for i in range(len(curve.places)))
    candidate = replace(
        candidate,
        curve=curve,
        parameters=names,
        columns=lambda context: Design(1, curve.columns(context.measurements.q[:, 1])),
    )
    seed = 3
    print(f'seed {seed}')
    covariance = 1e-8 * np.linalg.inv(
        curve.columns(q[is_measured]).T @ curve.columns(q[is_measured]) + 1e-3 * curve.penalty
    )
    draws = np.random.default_rng(seed).multivariate_normal(0.0 * curve.places, covariance, 400)
    solution = replace(found.solution, candidates=(candidate,), parameters=draws[0])
    drawn = replace(
        found,
        groups=((candidate,),),
        solution=solution,
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
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {'discovery.json', 'predictions.csv', 'apply'}


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
    noise = Noise(np.array([0.3e-3, 0.0]), np.array([0.0, 0.6e-3]), np.zeros(2))
    drawn = replace(
        found,
        residuals=replace(data, noise_model=noise_model),
        empty=replace(found.empty, noise=noise),
        solution=replace(found.solution, noise=noise),
    )
    figure = discovery_figures.gain(drawn)
    widths = [bar.get_width() for bar in figure.axes[1].patches]
    np.testing.assert_allclose(widths, 2 * [0.6 * np.sqrt(2.0 / 3.0), 0.3 / np.sqrt(3.0)])


def test_predictions_csv_has_every_row_with_its_covariance(saved):
    found, folder = saved
    content = json.loads((folder / 'discovery.json').read_text())
    with (folder / 'predictions.csv').open() as file:
        rows = list(csv.DictReader(file))
    m = found.fit.session.measurements
    assert [int(row['observation']) for row in rows] == m.observation.tolist()
    for axis, name in enumerate('xyz'):
        error = [float(row[f'{name}_m']) - float(row[f'predicted_{name}_m']) for row in rows]
        np.testing.assert_allclose(error, found.fit.residuals_after[:, axis], atol=2e-7)
    held_out = [row for row in rows if row['held_out'] == '1']
    assert {row['split'] for row in held_out} == {'validation'}
    regions = content['predicted_regions95']
    assert regions['held_out']['rows'] == len(held_out) == m.is_validation.sum()
    assert regions['held_out']['inside'] == sum(int(row['inside95']) for row in held_out)
    assert regions['held_out']['share'] > 0.8
    assert regions['widening'] >= 1.0
    first = rows[0]
    matrix = [[float(first[f'cov_{min(a, b)}{max(a, b)}_m2']) for a in 'xyz'] for b in 'xyz']
    assert np.linalg.eigvalsh(matrix).min() > 0.0


def test_discovery_json_has_registration_markers_and_joint_covariance(saved):
    found, folder = saved
    content = json.loads((folder / 'discovery.json').read_text())
    assert set(content['registration']) == set(found.fit.T_R_N)
    assert set(content['markers']) == set(found.fit.marker_positions)
    covariance = content['covariance']
    known = [row['joint'] for row in content['joint_offsets_after'] if row['identifiable']]
    # Errors of other kinds that are in the model without a name are not in it.
    causes = {
        name for group in found.groups for candidate in group for name in candidate.parameters
    }
    of_causes = [name for name in found.fit.theta_names if name in causes]
    assert covariance['names'] == [*known, *of_causes]
    assert len(covariance['units']) == len(covariance['names'])
    matrix = np.array(covariance['matrix'])
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-5)
    stds = [p['std'] for effect in content['effects'] for p in effect['parameters']]
    np.testing.assert_allclose(np.sqrt(np.diag(matrix))[len(known) :], stds, rtol=1e-3)


def test_discover_writes_what_to_apply_and_says_what_it_leaves(saved, tmp_path):
    found, folder = saved
    (tmp_path / 'apply').mkdir()
    (tmp_path / 'apply' / 'robot_model.urdf').write_text('of an earlier run')
    save_discovery(found, tmp_path, figures=False)
    for place in (folder, tmp_path):
        names = {path.name for path in (place / 'apply').iterdir()}
        model = {'robot_model.urdf'} if found.loads_geometry else set()
        offsets = {'remaster.txt', 'offset_layer.yaml', 'robot_calibrated.urdf'}
        assert names == offsets | {'compensation.json'} | model
        for path in (place / 'apply').iterdir():
            assert 'of an earlier run' not in path.read_text()
    text = (folder / 'apply' / 'remaster.txt').read_text()
    assert 'Not corrected here: encoder eccentricity of joint 2; compensation.json has' in text


def test_lengths_and_tilts_are_in_the_robot_model(saved):
    """The corrected URDF moves the tool as the cells of the search do, to first order."""
    found, _ = saved
    context, chain = found.residuals.context, found.fit.chain
    candidates = [
        candidate
        for name in ('link_length', 'joint_axis_tilt')
        for candidate in EFFECTS[name].candidates(context)
        if candidate.size == 1
    ]
    seed = 4
    print(f'seed {seed}')
    theta = 1e-5 * np.random.default_rng(seed).standard_normal(len(candidates))
    shifts, turns = np.zeros((2, len(chain), 3))
    for candidate, value in zip(candidates, theta, strict=True):
        change = candidate.model_change
        shifts[change.joint] += value * change.shifts[0]
        turns[change.joint] += value * change.turns[0]
    drawn = replace(found.geometry, shifts=shifts, turns=turns, joint_offsets=np.zeros(len(chain)))
    text = model_text(found.alone, drawn)
    model = SerialChain.from_urdf(text, chain.base_link, chain.tip_link)
    markers = context.markers[context.marker]
    moved = model.positions(context.q, markers) - chain.positions(context.q, markers)
    np.testing.assert_allclose(moved, found.residuals.displaced(candidates, theta), atol=2e-9)
    offsets = 1e-3 * np.random.default_rng(seed + 1).standard_normal(len(chain))
    text = model_text(found.alone, replace(drawn, joint_offsets=offsets))
    both = SerialChain.from_urdf(text, chain.base_link, chain.tip_link)
    known = np.where(found.alone.identifiable, offsets, 0.0)
    np.testing.assert_allclose(
        both.positions(context.q, markers), model.positions(context.q, markers, known), atol=1e-12
    )


def test_where_no_joint_is_determined_and_no_cause_found_there_is_no_covariance():
    fit = SimpleNamespace(
        identifiable=np.zeros(7, bool),
        joint_names=('a',) * 7,
        joint_offset_draws=np.zeros((4, 100, 7)),
        theta_draws=np.zeros((4, 100, 0)),
        theta_names=(),
    )
    found = discovery_json._covariance(SimpleNamespace(fit=fit, groups=()))
    assert found == {'names': [], 'units': [], 'matrix': []}


class _Remembered(SimpleNamespace):
    """Stands for a discovery, of which what was computed is remembered: it has a hash."""

    __hash__ = object.__hash__


def test_what_is_no_better_in_the_figures_shown_is_not_to_be_loaded(monkeypatch):
    """Everything that was found is in the robot model: no compensation is asked for."""
    rows = SimpleNamespace(
        is_validation=np.array([False, True, True]), observation=np.array([1, 2, 3])
    )
    errors = np.full((3, 3), 1e-3)
    found = _Remembered(
        residuals=SimpleNamespace(context=SimpleNamespace(measurements=rows)),
        outliers=(),
        fit=None,
        solution=SimpleNamespace(candidates=(SimpleNamespace(of_measurement=True, size=1),)),
        loads_geometry=True,
    )
    model = SimpleNamespace(largest_slope=lambda: 0.1)
    monkeypatch.setattr(loadables, 'arm_of_effects', lambda *_: SimpleNamespace(model=model))
    errors_by_result = {'offsets': 2.0 * errors, 'geometry': errors, 'everything': 0.9999 * errors}
    monkeypatch.setattr(loadables, 'errors_to_load', lambda _: errors_by_result)
    results = loadable(found)
    assert [row.better for row in results] == [True, True, False]
    assert load_words(results[-1])[1].startswith('only where no robot model can be loaded')
    # What the reader of the file refuses is not offered, however well it predicts.
    assert results[-1].file.endswith('compensation.json')
    model.largest_slope = lambda: 1.5
    loadables._arm_with_effects.cache_clear()
    assert loadable(found)[-1].file == ''


# Every verdict, with and without causes


def too_long(session):
    return 4e-3 * session.measurements.position


def discovered(seed, validation=10, **options):
    session = session_with(seed, poses=18, validation=validation, **options)
    return discover_session(session, rng=np.random.default_rng(0))


def unmeasured(measurements: Measurements) -> Measurements:
    """Return the same as a table without approach, time and temperature has them."""
    return replace(
        measurements,
        from_q=np.full_like(measurements.from_q, np.nan),
        temperature_c=np.full(len(measurements), np.nan),
        stamp_s=np.zeros(len(measurements)),
    )


@pytest.fixture(scope='module')
def scenes(confirmed):
    """Return a healthy arm, one with a bent encoder, and a sensor of the wrong scale."""
    return {
        'healthy': discovered(41),
        'bent': confirmed[0],
        'scale': discovered(41, sensor=too_long),
        'unproven': discovered(41, angles=bent, validation=0),
    }


def shown(discovery, folder, figures=True):
    """Save it; return the page, its verdict's mood, and the names of its figures."""
    names = set()
    save_discovery(discovery, folder, figures=figures)
    content = read_discovery(folder / 'discovery.json')
    if figures:
        page = (folder / 'report.html').read_text(encoding='utf-8')
        names = {path.stem for path in (folder / 'figures').glob('*.svg')}
    else:
        # What is drawn does not depend on what is said of it.
        page = discovery_html(content, discovery.fit.session, {})
    assert not re.findall(r'(?:src|href)="(?!#)[^"]', page)
    for name in names:
        ElementTree.parse(folder / 'figures' / f'{name}.svg')
        assert f'id="{name}-' in page, name
    assert content.verdict == discovery.verdict
    # One verdict, in the file, on the page and on the terminal.
    printed = discovery_lines(content)
    assert printed[:2] == [f'verdict: {discovery.verdict}', content.judgement.headline]
    words = page.replace('&#34;', '&quot;')
    assert html.escape(content.judgement.headline) in words
    # One phrase of one fact.
    facts = [size_words(effect) for effect in content.effects]
    facts += filter(
        None, [coverage_words(content.predicted_regions95.held_out, content.gain.held_out_gross)]
    )
    for fact in facts:
        assert fact in '\n'.join(printed)
        assert html.escape(fact) in words
    mood = re.search(r'class="verdict (\w+)"', page)
    return page, mood and mood.group(1), names


def test_the_scenes_give_what_they_are_made_for(scenes):
    assert scenes['healthy'].verdict == 'none'
    assert not scenes['healthy'].effects
    assert [effect.name for effect in scenes['bent'].effects] == ['encoder_eccentricity']
    assert 'sensor_scale' in [effect.name for effect in scenes['scale'].effects]


def test_nothing_found_is_a_page_without_a_figure_of_causes(scenes, tmp_path):
    page, mood, names = shown(scenes['healthy'], tmp_path)
    assert names == {'gain', 'drivers'}
    assert mood == 'good'
    assert 'Nothing is there beyond the zero-offsets' in page
    assert 'None is named. Every combination' in page


def test_few_readings_do_not_show_that_nothing_is_there(scenes, tmp_path):
    """The page has from what size on a cause shows; it is amber where that is half the noise."""
    healthy = scenes['healthy']
    rows = len(healthy.residuals)
    seen = 4.5 * 1e3 * healthy.gain.noise_floor_m / np.sqrt(3 * rows)
    page, _, _ = shown(healthy, tmp_path / 'all', figures=False)
    assert f'by less than {seen:.2f} mm RMS would not show' in page
    few = replace(healthy, residuals=healthy.residuals.only(healthy.residuals.rows.source[:26]))
    page, mood, _ = shown(few, tmp_path / 'few', figures=False)
    assert mood == 'caution'
    assert '26 readings would not show a cause' in page


def test_what_held_out_poses_show_is_not_said_to_be_nothing(scenes, tmp_path):
    healthy = scenes['healthy']
    after = 2.0 * healthy.gain.noise_floor_m
    rms = ('held_out_rms_before_m', 'held_out_rms_after_m')
    kept = ('held_out_kept_before_m', 'held_out_kept_after_m')
    gain = structs.replace(healthy.gain, **dict.fromkeys(rms + kept, after))
    page, mood, _ = shown(replace(healthy, gain=gain), tmp_path, figures=False)
    assert mood == 'caution'
    assert 'Nothing was found beyond' in page
    assert 'Nothing is there' not in page
    assert '2.0 times that of the noise alone' in page


def test_gross_errors_do_not_count_among_the_rows_that_lie_where_they_were_predicted(scenes):
    """They made 88 % of 95 %, and a finding of what was noise and gross errors alone."""
    healthy = scenes['healthy']
    m = healthy.residuals.context.measurements
    before = discovery_json.discovery_content(healthy).predicted_regions95.held_out
    gross = tuple((int(row), 'gross') for row in m.observation[m.is_validation][:3])
    content = discovery_json.discovery_content(
        replace(healthy, outliers=gross, gain=structs.replace(healthy.gain, held_out_gross=3))
    )
    held_out = content.predicted_regions95.held_out
    assert held_out.rows == before.rows - 3
    assert '; 3 gross errors not counted' in '\n'.join(discovery_lines(content))


@pytest.mark.parametrize('scene', ['scale', 'unproven'])
def test_causes_are_drawn(scenes, scene, tmp_path):
    page, mood, names = shown(scenes[scene], tmp_path)
    assert names == {'gain', 'drivers', 'causes'}
    assert mood in ('good', 'caution')
    for effect in scenes[scene].effects:
        assert effect.cause in page
    assert ('No poses were held out' in page) == (scene == 'unproven')


@pytest.mark.parametrize(
    ('scene', 'verdict'),
    [
        *(('bent', verdict) for verdict in get_args(Verdict)),
        # Where nothing is found there is no verdict of effects.
        *(
            pytest.param('healthy', verdict, marks=pytest.mark.qualify)
            for verdict in get_args(Verdict)
            if verdict != 'effects'
        ),
    ],
)
def test_every_verdict_has_its_page(scenes, verdict, scene, tmp_path):
    found = replace(scenes[scene], verdict=verdict)
    page, mood, _ = shown(found, tmp_path, figures=False)
    assert ('causes' in discovery_figures.discovery_figures(found)) == (scene == 'bent')
    assert mood == ('good' if verdict in ('none', 'effects') else 'caution')
    assert 'id="gain"' in page


def test_a_table_without_the_optional_columns_has_its_page(tmp_path):
    session = session_with(41, bent, poses=18, validation=10)
    session = replace(session, measurements=unmeasured(session.measurements))
    discovery = discover_session(session, rng=np.random.default_rng(0))
    page, _, names = shown(discovery, tmp_path)
    assert names >= {'gain', 'drivers'}
    assert 'What this session cannot test' in page


def test_without_held_out_poses_nothing_found_is_not_proven(scenes, tmp_path):
    healthy = scenes['healthy']
    unproven = Gain(None, None, healthy.gain.noise_floor_m)
    page, mood, _ = shown(replace(healthy, gain=unproven), tmp_path, figures=False)
    assert mood == 'caution'
    assert 'Nothing was found' in page
    assert 'no poses were held out to check it' in page


def test_a_posterior_that_is_only_approximate_is_never_green(scenes, tmp_path):
    fit = scenes['healthy'].fit
    sampler = structs.replace(fit.sampler, converged=False, method='laplace')
    doubtful = replace(scenes['healthy'], fit=replace(fit, sampler=sampler))
    page, mood, _ = shown(doubtful, tmp_path, figures=False)
    assert mood == 'caution'
    assert 'as the sampling has not converged: search again with another --seed' in page


def test_one_cause_without_a_curve_is_a_thin_bar_beside_the_noise(scenes):
    (axes,) = [ax for ax in discovery_figures.causes(scenes['scale']).axes if ax.patches]
    low, high = sorted(axes.get_ylim())
    assert len(axes.patches) >= 2
    assert all(bar.get_height() < 0.15 * (high - low) for bar in axes.patches)
    assert axes.get_yticklabels()[-1].get_text() == 'noise alone'


def test_no_bin_and_no_line_lies_where_nothing_was_measured():
    rng = np.random.default_rng(5)
    x = np.concatenate((rng.uniform(-100, -60, 70), rng.uniform(50, 90, 30)))
    ax = Figure().subplots()
    discovery_figures._binned(ax, x, rng.normal(size=100), 'black')
    assert len(ax.containers) == 2
    for container in ax.containers:
        places = container[0].get_xdata()
        assert np.all(places < -60) or np.all(places > 50)


def test_a_wave_has_no_band_where_nothing_was_measured(scenes, monkeypatch):
    discovery = scenes['bent']
    data = discovery.residuals
    q = np.degrees(data.context.measurements.q[:, 1])
    middle = np.median(q)
    rows = np.flatnonzero(np.abs(q - middle) > 25.0)
    shown = replace(discovery, residuals=data.only(np.intersect1d(rows, data.rows.source)))
    # Drawn at the rows that were searched.
    monkeypatch.setattr(discovery_figures, 'MOST_DRAWN', 0)
    ax = Figure().subplots()
    (candidate,) = discovery.groups[0]
    discovery_figures._cause(ax, shown, candidate)
    (band,) = ax.collections
    sides = [path.vertices[:, 0] for path in band.get_paths()]
    assert len(sides) >= 2
    assert all(x.max() < middle - 20.0 or x.min() > middle + 20.0 for x in sides)


def test_a_cause_of_less_than_certainty_is_said_with_its_probability_and_not_green(
    scenes, tmp_path
):
    bent = scenes['bent']
    (effect,), group = bent.effects, bent.groups[0]
    doubtful = structs.replace(effect, probability=0.7).sampled(bent.fit, group, bent.residuals)
    assert 'Not certain: its probability is 70 %.' in doubtful.cause
    assert 'Not certain' not in effect.cause
    # Nobody is sent to the gearbox before it is sure.
    assert doubtful.remedy == f'Measure more poses first. If it stays: {effect.remedy}'
    assert doubtful.size_m == pytest.approx(effect.size_m)
    page, mood, _ = shown(replace(bent, effects=(doubtful,)), tmp_path, figures=False)
    assert mood == 'caution'
    assert 'Not certain: encoder eccentricity of joint 2 (probability 70 %).' in page


def test_offsets_have_their_std_if_the_arm_is_exactly_its_drawing(scenes):
    found = scenes['bent']
    rows = [row for row in discovery_content(found).joint_offsets_after if row.identifiable]
    assert rows
    # A joint about which lengths and tilts turn nothing is as sure; the draws have some noise.
    assert all(0.0 < row.std_if_exactly_drawn_deg < 1.1 * row.std_deg for row in rows)
    assert any(row.std_if_exactly_drawn_deg < 0.5 * row.std_deg for row in rows)
