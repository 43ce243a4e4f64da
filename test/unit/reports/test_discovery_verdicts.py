"""Every verdict of a discovery, with and without causes, has figures, a report and its JSON."""

import html
import re
from dataclasses import replace
from typing import get_args
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from discovery_scenes import at_joint, session_with
from matplotlib.figure import Figure

from remaster_ros.discovery.discover import Verdict, discover_session
from remaster_ros.discovery.gain import Gain
from remaster_ros.reports import figures
from remaster_ros.reports.discovery_json import read_discovery
from remaster_ros.reports.result_folder import save_discovery
from remaster_ros.reports.schemas import Discovered
from remaster_ros.reports.sentences import coverage_words, discovery_lines, size_words
from remaster_ros.types import Measurements


def bent(session):
    return at_joint(2, 1.5e-3 * np.sin(2.0 * session.measurements.q[:, 1]))


def too_long(session):
    return 4e-3 * session.measurements.position


def discovered(seed, **options):
    session = session_with(seed, poses=25, validation=options.pop('validation', 15), **options)
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
def found():
    """Return a healthy arm, one with a bent encoder, and a sensor of the wrong scale."""
    return {
        'healthy': discovered(41),
        'bent': discovered(41, angles=bent),
        'scale': discovered(41, sensor=too_long),
        'unproven': discovered(41, angles=bent, validation=0),
    }


def saved(discovery, folder):
    """Save with figures; return the page, its verdict's mood, and the names of its figures."""
    assert save_discovery(discovery, folder) == folder / 'report.html'
    page = (folder / 'report.html').read_text(encoding='utf-8')
    assert not re.findall(r'(?:src|href)="(?!#)[^"]', page)
    names = {path.stem for path in (folder / 'figures').glob('*.svg')}
    for name in names:
        ElementTree.parse(folder / 'figures' / f'{name}.svg')
        assert f'id="{name}-' in page, name
    content = msgspec.convert(read_discovery(folder / 'discovery.json'), Discovered)
    assert content.verdict == discovery.verdict
    # One verdict, in the file, on the page and on the terminal.
    printed = discovery_lines(content)
    assert printed[:2] == [f'verdict: {discovery.verdict}', content.judgement.headline]
    shown = page.replace('&#34;', '&quot;')
    assert html.escape(content.judgement.headline) in shown
    # One phrase of one fact.
    facts = [size_words(effect) for effect in content.effects]
    facts += filter(None, [coverage_words(content.predicted_regions95.held_out)])
    for words in facts:
        assert words in '\n'.join(printed)
        assert html.escape(words) in shown
    mood = re.search(r'class="verdict (\w+)"', page)
    return page, mood and mood.group(1), names


def test_the_scenes_give_what_they_are_made_for(found):
    assert found['healthy'].verdict == 'none'
    assert not found['healthy'].effects
    assert [effect.name for effect in found['bent'].effects] == ['encoder_eccentricity']
    assert 'sensor_scale' in [effect.name for effect in found['scale'].effects]


def test_nothing_found_is_a_page_without_a_figure_of_causes(found, tmp_path):
    page, mood, names = saved(found['healthy'], tmp_path)
    assert names == {'gain', 'drivers'}
    assert mood == 'good'
    assert 'Nothing is there beyond the zero-offsets' in page
    assert 'None is named. Every combination' in page


def test_few_readings_do_not_show_that_nothing_is_there(found, tmp_path):
    """The page has from what size on a cause shows; it is amber where that is half the noise."""
    healthy = found['healthy']
    rows = len(healthy.residuals)
    seen = 4.5 * 1e3 * healthy.gain.noise_floor_m / np.sqrt(3 * rows)
    page, _, _ = saved(healthy, tmp_path / 'all')
    assert f'by less than {seen:.2f} mm RMS would not show' in page
    few = replace(healthy, residuals=healthy.residuals.only(healthy.residuals.rows.source[:26]))
    page, mood, _ = saved(few, tmp_path / 'few')
    assert mood == 'caution'
    assert '26 readings would not show a cause' in page


def test_what_held_out_poses_show_is_not_said_to_be_nothing(found, tmp_path):
    healthy = found['healthy']
    after = 2.0 * healthy.gain.noise_floor_m
    rms = ('held_out_rms_before_m', 'held_out_rms_after_m')
    kept = ('held_out_kept_before_m', 'held_out_kept_after_m')
    gain = replace(healthy.gain, **dict.fromkeys(rms + kept, after))
    page, mood, _ = saved(replace(healthy, gain=gain), tmp_path)
    assert mood == 'caution'
    assert 'Nothing was found beyond' in page
    assert 'Nothing is there' not in page
    assert '2.0 times that of the noise alone' in page


@pytest.mark.parametrize('scene', ['bent', 'scale', 'unproven'])
def test_causes_are_drawn(found, scene, tmp_path):
    page, mood, names = saved(found[scene], tmp_path)
    assert names == {'gain', 'drivers', 'causes'}
    assert mood in ('good', 'caution')
    for effect in found[scene].effects:
        assert effect.cause in page
    assert ('No poses were held out' in page) == (scene == 'unproven')


@pytest.mark.parametrize('verdict', get_args(Verdict))
@pytest.mark.parametrize('scene', [pytest.param('healthy', marks=pytest.mark.qualify), 'bent'])
def test_every_verdict_has_its_page(found, verdict, scene, tmp_path):
    page, mood, names = saved(replace(found[scene], verdict=verdict), tmp_path)
    assert ('causes' in names) == (scene == 'bent')
    # Effects that the held-out poses do not bear out are no good news.
    good = verdict == 'none' or (verdict == 'effects' and scene == 'bent')
    assert mood == ('good' if good else 'caution')
    assert 'id="gain"' in page


def test_a_table_without_the_optional_columns_has_its_page(tmp_path):
    session = session_with(41, bent, poses=25, validation=15)
    session = replace(session, measurements=unmeasured(session.measurements))
    discovery = discover_session(session, rng=np.random.default_rng(0))
    page, _, names = saved(discovery, tmp_path)
    assert names >= {'gain', 'drivers'}
    assert 'What this session cannot test' in page


def test_without_held_out_poses_nothing_found_is_not_proven(found, tmp_path):
    healthy = found['healthy']
    unproven = Gain(None, None, healthy.gain.noise_floor_m, {})
    page, mood, _ = saved(replace(healthy, gain=unproven), tmp_path)
    assert mood == 'caution'
    assert 'Nothing was found' in page
    assert 'no poses were held out to check it' in page


def test_a_posterior_that_is_only_approximate_is_never_green(found, tmp_path):
    message = 'NOT converged: a Gaussian about the mode (no chain came to its end)'
    fit = found['healthy'].fit
    sampler = replace(fit.sampler, converged=False, method='laplace', message=message)
    doubtful = replace(found['healthy'], fit=replace(fit, sampler=sampler))
    page, mood, _ = saved(doubtful, tmp_path)
    assert mood == 'caution'
    assert message in page


def test_one_cause_without_a_curve_is_a_thin_bar_beside_the_noise(found):
    (axes,) = [ax for ax in figures.causes(found['scale']).axes if ax.patches]
    low, high = sorted(axes.get_ylim())
    assert len(axes.patches) >= 2
    assert all(bar.get_height() < 0.15 * (high - low) for bar in axes.patches)
    assert axes.get_yticklabels()[-1].get_text() == 'noise alone'


def test_no_bin_and_no_line_lies_where_nothing_was_measured():
    rng = np.random.default_rng(5)
    x = np.concatenate((rng.uniform(-100, -60, 70), rng.uniform(50, 90, 30)))
    ax = Figure().subplots()
    figures._binned(ax, x, rng.normal(size=100), 'black')
    assert len(ax.containers) == 2
    for container in ax.containers:
        places = container[0].get_xdata()
        assert np.all(places < -60) or np.all(places > 50)


def test_a_wave_has_no_band_where_nothing_was_measured(found, monkeypatch):
    discovery = found['bent']
    data = discovery.residuals
    q = np.degrees(data.context.measurements.q[:, 1])
    middle = np.median(q)
    rows = np.flatnonzero(np.abs(q - middle) > 25.0)
    shown = replace(discovery, residuals=data.only(np.intersect1d(rows, data.rows.source)))
    # Drawn at the rows that were searched.
    monkeypatch.setattr(figures, 'MOST_DRAWN', 0)
    ax = Figure().subplots()
    (cell,) = discovery.groups[0]
    figures._cause(ax, shown, cell)
    (band,) = ax.collections
    sides = [path.vertices[:, 0] for path in band.get_paths()]
    assert len(sides) >= 2
    assert all(x.max() < middle - 20.0 or x.min() > middle + 20.0 for x in sides)


def test_a_cause_that_may_be_chance_by_its_own_deviation_is_said_and_not_green(found, tmp_path):
    """It is named because the evidence is for it; what the choice of causes costs comes after."""
    bent = found['bent']
    (effect,), group = bent.effects, bent.groups[0]
    most = max(abs(parameter.value) for parameter in effect.parameters)
    wide = replace(bent.fit, theta_std=np.full_like(bent.fit.theta_std, most / 1.5))
    doubtful = effect.sampled(wide, group, bent.residuals)
    assert doubtful.sigmas == pytest.approx(1.5)
    assert 'is 1.5 standard deviations from nothing' in doubtful.cause
    assert 'from nothing' not in effect.cause
    # Nobody is sent to the gearbox before it is sure.
    assert doubtful.remedy == f'Measure more poses first. If it stays: {effect.remedy}'
    assert doubtful.size_m == pytest.approx(effect.size_m)
    page, mood, _ = saved(replace(bent, effects=(doubtful,)), tmp_path)
    assert mood == 'caution'
    assert 'Not certain by its own standard deviation: encoder eccentricity of joint 2.' in page
