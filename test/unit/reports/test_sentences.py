# SPDX-License-Identifier: Apache-2.0
"""What a fit is worth: never green where anything contradicts it, with the reason in words."""

import html
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.noise_check import NoiseCheck
from remaster_ros.calibration.residual_structure import ResidualStructure, StructureTest
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.fit_judgement import verdict
from remaster_ros.reports.fit_page import fit_html
from remaster_ros.reports.result_lines import fit_lines
from remaster_ros.reports.sentences import METRICS, as_drawn, load_words, loadable_of_fit


def with_accuracy(result, split, before, after):
    metric = {'before': {'mean_mm': before}, 'after': {'mean_mm': after}}
    accuracy = {'optimization': None, 'validation': None, split: {'post_registration': metric}}
    comparison = replace(result.comparison, accuracy=accuracy)
    return replace(result, compare=lambda: comparison)


@pytest.mark.parametrize(
    ('split', 'before', 'after', 'converged', 'mood', 'words'),
    [
        ('validation', 4.0, 0.5, True, 'good', '8.0 times smaller'),
        ('validation', 1.0, 0.97, True, 'caution', 'hardly matter'),
        ('validation', 1.0, 1.5, True, 'bad', 'make it worse'),
        ('optimization', 4.0, 0.5, True, 'caution', 'on the fitted poses'),
        ('validation', 4.0, 0.5, False, 'bad', 'have not converged'),
    ],
)
def test_the_verdict_is_honest(fit_result, split, before, after, converged, mood, words):
    r_hat_max = fit_result.sampler.r_hat_max if converged else 1.2
    sampler = structs.replace(fit_result.sampler, converged=converged, r_hat_max=r_hat_max)
    result = replace(with_accuracy(fit_result, split, before, after), sampler=sampler)
    # The session has gross errors among its held-out rows, which alone are no good news.
    assert any(check.spoilt for check in result.noise_checks)
    assert verdict(result).mood != 'good'
    checks = tuple(structs.replace(check, gross=()) for check in result.noise_checks)
    result = replace(result, noise_checks=checks)
    judged = verdict(result)
    assert judged.mood == mood
    assert words in judged.headline
    text = ' '.join(judged.points)
    assert ('fit again with more draws' in text) != converged
    assert ('No poses were held out' in text) == (split == 'optimization')


def test_an_approximation_that_fails_its_check_is_never_green(fit_result):
    message = 'NOT converged: a Gaussian about the mode (no chain came to its end)'
    sampler = structs.replace(
        fit_result.sampler, converged=False, method='laplace', pareto_k=1.4, message=message
    )
    judged = verdict(replace(with_accuracy(fit_result, 'validation', 4.0, 0.5), sampler=sampler))
    assert judged.mood == 'caution'
    assert 'known only approximately' in judged.headline
    assert any(message in point for point in judged.points)
    text = fit_html(replace(fit_result, sampler=sampler), {})
    assert 'no chain reaches the precision' in text


def test_structure_in_the_residuals_is_never_green(fit_result):
    """Also where noise explains their size; the wider intervals are mentioned."""
    structure = ResidualStructure(
        (StructureTest('position', True, 1e-9), StructureTest('time', True, 0.4))
    )
    result = replace(
        with_accuracy(fit_result, 'validation', 4.0, 0.5),
        noise_checks=(),
        structure=structure,
        widening=np.array([1.0, 3.14, 1.2, 1.0, 1.0, 1.0, 1.0]),
    )
    judged = verdict(result)
    assert judged.mood == 'caution'
    assert 'there are other errors beside it; run "remaster discover"' in judged.headline
    text = ' '.join(judged.points)
    assert 'follows the position in front of the sensor from pose to pose (p < 0.0001)' in text
    assert 'follows time' not in text
    assert 'up to 3.1 times as wide' in text
    printed = '\n'.join(
        fit_lines(fit_content(replace(fit_result, noise_checks=(), structure=structure)))
    )
    assert 'there are other errors beside it; run "remaster discover"' in printed


def test_too_few_poses_to_show_other_errors_are_never_green(fit_result):
    proven = replace(with_accuracy(fit_result, 'validation', 4.0, 0.5), noise_checks=())
    assert verdict(proven).mood == 'good'
    judged = verdict(replace(proven, structure=ResidualStructure((), too_few=True)))
    assert judged.mood == 'caution'
    (doubt,) = judged.doubts
    assert 'measure at least 12 and fit again' in doubt
    assert doubt in judged.points
    # Where nothing is gained either noise is no explanation.
    same = with_accuracy(proven, 'validation', 0.5, 0.5)
    assert 'noise explains' in verdict(same).headline
    assert (
        'noise explains'
        not in verdict(replace(same, structure=ResidualStructure((), too_few=True))).headline
    )


MOVED = NoiseCheck.of(2.337e-3, None, 0.11e-3, sensor='tracker', poses=12)
UNTOLD = NoiseCheck.of(0.3e-3, None, None, sensor='tracker', poses=12)


@pytest.mark.parametrize('after', [2.337, 4.3])
@pytest.mark.parametrize('check', [MOVED, UNTOLD], ids=['moved', 'untold'])
def test_an_error_that_noise_does_not_explain_is_never_green(fit_result, check, after):
    result = replace(with_accuracy(fit_result, 'validation', 4.395, after), noise_checks=(check,))
    judged = verdict(result)
    assert judged.mood == 'caution'
    text = f'{judged.headline} {judged.points[0]}'
    if check is MOVED:
        assert 'other errors dominate; run "remaster discover"' in judged.headline
        assert '0.110 mm per axis within a pose' in text
        assert 'makes 0.176 mm' in text
    else:
        assert 'this session cannot show' in judged.headline
        assert 'measure poses in all their joint solutions' in text
    assert judged.points[0].startswith('tracker: ')
    html = fit_html(replace(fit_result, noise_checks=(check,)), {})
    assert 'verdict caution' in html


def test_offsets_that_hardly_matter_where_noise_explains_the_rest(fit_result):
    assert all(check.explained for check in fit_result.noise_checks)
    checks = tuple(structs.replace(check, gross=()) for check in fit_result.noise_checks)
    result = with_accuracy(fit_result, 'validation', 0.4, 0.39)
    judged = verdict(replace(result, noise_checks=checks))
    assert judged.mood == 'caution'
    assert 'That is what noise explains' in judged.headline
    assert 'discover' not in judged.headline


def test_a_marker_that_is_not_where_it_was_stated_to_be_is_named(fit_result):
    """The fit takes it up, so that no residual shows it; 5 mm are ten times what was stated."""
    assert fit_result.displaced_markers == ()
    session = fit_result.session
    assert session.marker_std_m == 0.5e-3
    stated = {**session.markers, 'smr': session.markers['smr'] + np.array([0.0, 0.0, 5e-3])}
    result = fit_session(
        replace(session, markers=stated), rng=np.random.default_rng(0), draws=100, chains=2
    )
    (line,) = result.displaced_markers
    off = np.linalg.norm(result.marker_positions['smr'] - stated['smr'])
    assert off == pytest.approx(5e-3, abs=1e-3)
    assert f'the marker smr: the fit has it {1e3 * off:.1f} mm from its stated place' in line
    assert '(0.5 mm). Check the place, its unit, and that tool is the link that carries' in line
    judged = verdict(result)
    assert judged.mood != 'good'
    assert f'{line}.' in judged.points
    assert f'{line}.' in judged.disagreements
    assert line in '\n'.join(fit_lines(fit_content(result)))
    # Stated as well as it is known, the place contradicts nothing.
    known = replace(session, markers=stated, marker_std_m=5e-3)
    assert fit_session(known, rng=np.random.default_rng(0), draws=100).displaced_markers == ()


def test_terminal_and_page_have_one_phrase_of_one_fact(fit_result):
    content = fit_content(fit_result)
    printed, page = '\n'.join(fit_lines(content)), html.unescape(fit_html(fit_result, {}))
    title = METRICS['post_registration']
    assert f'optimization, {title}: ' in printed
    assert title[0].upper() + title[1:] in page
    worst = max(content.geometry.imitations, key=lambda imitation: imitation.deg)
    words = as_drawn(content.geometry, [worst])
    assert words in printed
    assert words.rpartition(' mm at ')[2] in page
    for row in loadable_of_fit(content.geometry):
        what, to_do = load_words(row)
        assert what in page
        assert to_do in page
        assert (f'to load: {what}' in printed) == bool(content.geometry.file)


def test_the_order_of_rows_is_not_called_time_where_there_are_no_times(fit_result):
    structure = ResidualStructure(
        (StructureTest('joint_time', False, 1e-9), StructureTest('time', True, 1e-9))
    )
    timed = replace(with_accuracy(fit_result, 'validation', 4.0, 0.5), structure=structure)
    assert 'change with time within the poses' in ' '.join(verdict(timed).findings)
    ordered = replace(timed, session=replace(fit_result.session, timed=False))
    text = ' '.join(verdict(ordered).findings)
    assert 'change with the order of the rows within the poses' in text
    assert 'follows the order of the rows from pose to pose' in text
    assert 'time' not in text


def test_where_poses_are_too_few_no_other_errors_are_said_to_dominate(fit_result):
    result = replace(with_accuracy(fit_result, 'validation', 4.0, 2.3), noise_checks=(MOVED,))
    judged = verdict(replace(result, structure=ResidualStructure((), too_few=True)))
    assert 'other errors dominate' not in judged.headline
    assert 'so few poses do not show what does' in judged.headline
    assert any('measure at least 12 and fit again' in doubt for doubt in judged.doubts)


def test_the_mean_without_the_largest_errors_is_said_to_be_that(fit_result):
    """It stands beside the mean of all; and of scatter within poses not all counts as noise."""
    check = NoiseCheck.of(0.934e-3, 6e-6, 0.89e-3, sensor='tracker', poses=200)
    result = replace(with_accuracy(fit_result, 'validation', 1.0, 0.979), noise_checks=(check,))
    text = verdict(result).findings[0]
    assert 'the error after is 0.934 mm without its largest values' in text
    assert '0.890 mm per axis within a pose, of which 0.030 mm count) makes 0.048 mm' in text


def test_one_held_out_pose_is_never_green(fit_result):
    proven = replace(with_accuracy(fit_result, 'validation', 4.0, 0.5), noise_checks=())
    assert verdict(proven).mood == 'good'
    m = proven.session.measurements
    rows = ~m.is_validation | (m.pose == m.pose[m.is_validation][0])
    judged = verdict(replace(proven, session=proven.session.select(rows)))
    assert judged.mood == 'caution'
    assert any('Only 1 pose was held out' in point for point in judged.points)
