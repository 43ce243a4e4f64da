# SPDX-License-Identifier: Apache-2.0
"""The report is one page that needs nothing else, with the verdict, and of bounded size."""

import re
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from judges.html_page import Page
from msgspec import structs
from rigs.browser import seen

from remaster_ros.kinematics import transforms
from remaster_ros.kinematics.transforms import apply
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.reports.fit_page import _round_factor, draw_view, fit_html
from remaster_ros.reports.result_folder import save_fit


@pytest.fixture(scope='module')
def folder(fit_result, tmp_path_factory):
    folder = tmp_path_factory.mktemp('fit')
    assert save_fit(fit_result, folder) == folder / 'report.html'
    return folder


@pytest.fixture(scope='module')
def html(folder):
    return (folder / 'report.html').read_text(encoding='utf-8')


@pytest.fixture(scope='module')
def page(html):
    return Page(html)


def test_all_files_are_there(folder):
    names = sorted(str(p.relative_to(folder)) for p in folder.rglob('*') if p.is_file())
    assert names == [
        'apply/compensation.json',
        'apply/offset_layer.yaml',
        'apply/remaster.txt',
        'apply/robot_calibrated.urdf',
        'figures/accuracy_map.svg',
        'figures/errors.svg',
        'figures/posteriors.svg',
        'figures/residuals.svg',
        'figures/stages.svg',
        'figures/tool_places.svg',
        'figures/traces.svg',
        'fit.json',
        'report.html',
        'residuals.csv',
    ]


def test_the_page_is_whole_and_needs_nothing_else(page, html, folder):
    assert len(page.ids) == len(set(page.ids))
    assert page.addresses
    for address in page.addresses:
        if address.startswith('apply/'):
            assert (folder / address).is_file()
            continue
        assert address.startswith('#')
        assert address[1:] in page.ids
    for reference in re.findall(r'url\(#([^)]+)\)', html):
        assert reference in page.ids


def test_the_page_shows_what_was_found(fit_result, page):
    text = page.text
    # By the held-out readings that are no gross errors, which are counted.
    gross = [row for check in fit_result.noise_checks for row in check.gross]
    m = fit_result.session.measurements
    rows = m.is_validation & ~np.isin(m.observation, gross)
    before, after = (
        f'{1e3 * np.linalg.norm(residuals[rows], axis=1).mean():.3f} mm'
        for residuals in (fit_result.residuals_before, fit_result.residuals_after)
    )
    sentence = f'falls from {before} to {after} on poses it never fitted ({len(gross)} gross error'
    assert sentence in text
    for i, joint in enumerate(fit_result.joint_names):
        if fit_result.identifiable[i]:
            degrees = f'{np.degrees(fit_result.joint_offsets[i]):+.4f}'.replace('-', '−')
            assert f'{joint} {degrees}' in text
        else:
            assert fit_result.why[i] in text
    for direction in fit_result.gauge:
        assert direction.why in text
    for observation, why in fit_result.left_out:
        assert f'{observation} {why}' in text
    for name in fit_result.session.sensors:
        assert name in text  # also the one that looks like markup
    assert fit_result.sampler.message[1:] in text


def test_names_cannot_become_markup(fit_result, html):
    hostile = [name for name in fit_result.session.sensors if '<' in name]
    assert hostile
    assert hostile[0] not in html


def test_the_size_is_bounded(folder):
    assert (folder / 'report.html').stat().st_size < 8e6


@pytest.mark.parametrize(
    'name', ['posteriors', 'traces', 'errors', 'residuals', 'tool_places', 'accuracy_map']
)
def test_figures_are_svg_with_nothing_cut_off(folder, name):
    root = ElementTree.parse(folder / 'figures' / f'{name}.svg').getroot()
    width, height = map(float, root.get('viewBox').split()[2:])
    texts = [e for e in root.iter('{http://www.w3.org/2000/svg}text')]
    assert texts
    for text in texts:
        place = re.search(r'(?:translate|rotate)\(([^)]*)\)', text.get('transform', ''))
        if place and place.group(0).startswith('translate'):
            x, y = map(float, place.group(1).split()[:2] if ' ' in place.group(1) else [0, 0])
        else:
            x, y = float(text.get('x', 0)), float(text.get('y', 0))
        assert -1 <= y <= height + 1
        # A number lies about its place, and has the widths of DejaVu Sans, in em.
        words, style = (text.text or '').strip(), text.get('style', '')
        if re.fullmatch(r'[−+]?[\d.]+', words) and 'text-anchor: middle' in style:
            em = sum({'.': 0.318, '−': 0.838, '+': 0.838}.get(c, 0.636) for c in words)
            half = 0.5 * em * float(re.search(r'([\d.]+)px', style)[1])
            assert 0.0 <= x - half <= x + half <= width, words
        assert -1 <= x <= width + 1


def test_figures_name_units_and_joints(fit_result, folder):
    figures = {p.stem: p.read_text(encoding='utf-8') for p in (folder / 'figures').iterdir()}
    for joint in fit_result.joint_names:
        assert joint in figures['posteriors']
        assert joint in figures['traces']
    assert 'degrees' in figures['posteriors']
    assert 'chain 4' in figures['traces']
    for name in ('errors', 'residuals', 'tool_places', 'accuracy_map'):
        assert '(mm)' in figures[name]
    for word in ('mocap', 'before', 'after'):
        assert word in figures['errors']


def test_the_same_fit_gives_the_same_page(fit_result, folder, tmp_path):
    save_fit(fit_result, tmp_path)
    for path in folder.rglob('*'):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / path.relative_to(folder)).read_bytes()


def test_without_figures_there_is_no_report_and_none_of_an_earlier_fit(fit_result, tmp_path):
    (tmp_path / 'report.html').write_text('of an earlier fit')
    assert save_fit(fit_result, tmp_path, figures=False) == tmp_path / 'fit.json'
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'apply',
        'fit.json',
        'residuals.csv',
    ]


def test_drawing_libraries_are_imported_only_for_a_report():
    script = (
        'import sys, remaster_ros.reports.fit_json, remaster_ros.session.records.reader\n'
        "print([m for m in ('matplotlib', 'plotly', 'jinja2', 'mcap') if m in sys.modules])"
    )
    out = subprocess.run(
        [sys.executable, '-c', script], capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == '[]'


def test_a_session_without_validation_has_a_report(fit_result):
    optimization = ~fit_result.session.measurements.is_validation
    comparison = replace(
        fit_result.comparison,
        residuals_before=fit_result.residuals_before[optimization],
        accuracy={**fit_result.accuracy, 'validation': None},
    )
    result = replace(
        fit_result,
        session=fit_result.session.select(optimization),
        residuals_after=fit_result.residuals_after[optimization],
        compare=lambda: comparison,
        left_out=(),
        found=None,
    )
    html = fit_html(result, {})
    assert 'not proven' in html
    assert 'No observation was left out' in html


def test_noise_along_the_line_of_sight_has_rows_of_its_own(fit_result):
    name = next(iter(fit_result.noise))
    part = {'sigma_m': 0.0123e-3, 'std_m': 1e-6, 'pose_sigma_m': None, 'pose_std_m': None}
    sides = {f'{side}_{key}': part[key] for side in ('along', 'across') for key in part}
    noise = structs.replace(fit_result.noise[name], **sides)
    plain = fit_html(fit_result, {})
    assert 'line of sight' not in plain
    html = fit_html(replace(fit_result, noise={**fit_result.noise, name: noise}), {})
    assert 'along the line of sight' in html
    assert html.count('0.0123') == 2


def test_error_vectors_lead_from_the_measured_to_the_modelled_marker(fit_result):
    """After, magnified once, every vector ends where the calibrated arm has the marker."""
    view = draw_view(fit_result)
    m = fit_result.session.measurements
    assert view.rows_shown == view.rows == len(m) == len(view.picture['text'])
    starts, ends = np.array(view.picture['points']), np.array(view.picture['errors']['after'])
    markers = np.array([fit_result.marker_positions[n] for n in fit_result.session.markers])
    modelled = fit_result.chain.positions(m.q, markers[m.marker], fit_result.joint_offsets)
    T_R_N = np.array([fit_result.T_R_N[n] for n in fit_result.session.sensors])[m.sensor]
    np.testing.assert_allclose(starts, apply(T_R_N, m.position), atol=1e-5)
    np.testing.assert_allclose(starts + (ends - starts) / view.magnification, modelled, atol=3e-5)


def test_the_picture_of_a_fit_is_drawn_and_explained(folder):
    found = seen(
        folder / 'report.html',
        """
        const place = document.getElementById('scene');
        place.scrollIntoView();
        await wait(500);
        const view = JSON.parse(await unpacked('data-gzip'));
        const names = [...document.querySelectorAll('#legend label')].map((l) => l.textContent);
        const labels = [...place.querySelectorAll('.label')].map((l) => l.textContent);
        // A pointer that goes over all of the picture finds a point.
        const canvas = place.querySelector('canvas');
        const note = place.querySelector('.note');
        const told = new Set();
        const go = () => {
            for (let x = 0; x < canvas.clientWidth; x += 12)
                for (let y = 0; y < canvas.clientHeight; y += 12) {
                    const box = canvas.getBoundingClientRect();
                    canvas.dispatchEvent(new PointerEvent('pointermove', {
                        clientX: box.x + x, clientY: box.y + y}));
                    if (!note.hidden) told.add(note.textContent);
                }
        };
        go();
        const seen = [...told];
        told.clear();
        document.querySelectorAll('#legend input')[1].click();
        go();
        return {names, labels, seen, text: view.text, hidden: told.size,
                size: [canvas.clientWidth, canvas.clientHeight],
                missing: !document.getElementById('no-webgl').hidden};
        """,
    )
    assert found['names'][:2] == ['arm, 5 of its configurations', 'markers as measured']
    assert {'x', 'y', 'z'} < set(found['labels'])
    assert len(found['seen']) > 10
    assert set(found['seen']) <= set(found['text'])
    assert found['hidden'] == 0
    assert min(found['size']) > 200
    assert not found['missing']


@pytest.mark.parametrize(
    ('factor', 'rounded'), [(0.3, 1), (1.9, 1), (2.0, 2), (49.0, 20), (50.0, 50), (999.0, 500)]
)
def test_magnifications_are_round(factor, rounded):
    assert _round_factor(factor) == rounded


def with_references(fit_result, shift_m):
    """The session with four rounds of five references, the sensor moved before the last one."""
    session, chain = fit_result.session, fit_result.chain
    m = session.measurements
    rng = np.random.default_rng(12)
    print('seed 12')
    pick = np.flatnonzero(m.sensor == 0)[np.linspace(0, 40, 5).astype(int)]
    rows = m.select(np.tile(pick, 4))
    name = session.sensor_names[0]
    seen = chain.positions(rows.q, session.markers[session.sensors[name]])
    seen[-5:] += [0.0, shift_m, 0.0]
    T = fit_result.T_R_N[name]
    number = np.arange(len(rows)) + 10_000
    references = replace(
        rows,
        observation=number,
        configuration=number,
        position=transforms.apply(transforms.inverse(T), seen) + rng.normal(0, 2e-5, seen.shape),
        std=np.full((len(rows), 3), np.nan),
        stamp_s=number * 5.0,
    )
    return replace(fit_result, session=replace(session, references=references)), name


def test_what_changed_in_the_session_is_reported_first(fit_result):
    assert 'id="references"' not in fit_html(fit_result, {})
    result, _ = with_references(fit_result, 0.0)
    html = fit_html(result, {})
    assert '4 rounds of the same few configurations' in html
    assert 'Nothing did' in html
    result, name = with_references(fit_result, 3e-3)
    judged = verdict(result)
    assert any(f'{name} or the base was moved between' in point for point in judged.points)
    assert judged.mood != 'good'
    html = fit_html(result, {})
    assert html.count('was moved between configurations') == 2
    assert 'off by up to 3.0' in html


def test_a_far_sensor_leaves_the_arm_as_large_as_it_is(fit_result):
    name, T = next(iter(fit_result.T_R_N.items()))
    far = T.copy()
    far[:3, 3] += (40.0, 0.0, 0.0)
    # Measured points are carried to the base by the same frame: let them stay where they are.
    m = fit_result.session.measurements
    position = m.position.copy()
    mine = m.sensor == list(fit_result.session.sensors).index(name)
    position[mine] = apply(transforms.inverse(far) @ T, position[mine])
    session = replace(fit_result.session, measurements=replace(m, position=position))
    view = draw_view(replace(fit_result, session=session, T_R_N={**fit_result.T_R_N, name: far}))
    assert name in view.far_sensors
    drawn = view.picture['sensors']
    assert np.abs([sensor['line'] for sensor in drawn]).max() < 5.0
    assert any('m from the base' in sensor['text'] for sensor in drawn)


def test_a_page_without_3d_says_what_is_missing(html):
    assert 'needs WebGL, which this browser does not have' in html
    assert '<noscript><p>The 3-D view needs JavaScript' in html
