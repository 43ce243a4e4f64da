# SPDX-License-Identifier: Apache-2.0
"""Every verdict of every verb that judges, by the real command, with its figures and its report.

A verdict that is rare is where a page is seldom tried.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rigs.command_line import refusal, remaster, run

from remaster_ros.calibration.fit import fit_session
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Session

SIZE = ('--validation', 8, '--sensors', 'mocap', '--quiet')


def simulated(folder: Path, *options: object, poses: int = 16) -> Path:
    remaster('simulate', folder, '--poses', poses, *SIZE, *options)
    return folder


@pytest.fixture(scope='module')
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Fewer than twelve in reach are too few for a green page.
    return simulated(tmp_path_factory.mktemp('healthy') / 'session', '--seed', 3, poses=30)


def changed(session: Path, folder: Path, change: object) -> Path:
    write_session(folder / 'changed', change(read_session(session)))  # type: ignore[operator]
    return folder / 'changed'


def page_of(out: Path) -> tuple[str, str, set[str]]:
    """Return a report's text, its verdict's mood, and its figures, all of which must be whole."""
    page = (out / 'report.html').read_text(encoding='utf-8')
    for address in re.findall(r'(?:src|href)="(?!#)([^"]*)"', page):
        assert (out / 'apply' / Path(address).name).is_file(), address
    names = {path.stem for path in (out / 'figures').glob('*.svg')}
    for name in names:
        ElementTree.parse(out / 'figures' / f'{name}.svg')
        assert f'id="{name}-' in page, name
    mood = re.search(r'class="verdict (\w+)"', page)
    assert mood is not None
    return page, mood[1], names


def with_positions(session: Session, position: np.ndarray) -> Session:
    return replace(session, measurements=replace(session.measurements, position=position))


def measured_again(session: Session) -> Session:
    """Return the same with noise of its own on top: another measurement of the same poses."""
    noise = np.random.default_rng(5).normal(0.0, 0.03e-3, session.measurements.position.shape)
    return with_positions(session, session.measurements.position + noise)


def only_fitted(session: Session) -> Session:
    return session.select(~session.measurements.is_validation)


def worse_where_held_out(session: Session) -> Session:
    """Mirror what the offsets do on the held-out poses: there they have the wrong sign."""
    result = fit_session(session, rng=np.random.default_rng(0), draws=500)
    gain = result.residuals_before - result.residuals_after
    is_held_out = session.measurements.is_validation[:, None]
    return with_positions(
        session, session.measurements.position - np.where(is_held_out, 1.6 * gain, 0.0)
    )


FIT = {
    # name: (options of fit, change of the session, mood, words in the headline)
    'good': ((), lambda s: s, 'good', 'The mean position error falls from'),
    'no validation': ((), only_fitted, 'caution', 'on the fitted poses'),
    'worse': ((), worse_where_held_out, 'bad', 'The offsets make it worse'),
    'few draws': (
        ('--draws', 100, '--chains', 2),
        lambda s: s,
        'bad',
        'The chains have not converged',
    ),
    'paper': (('--sampler', 'paper', '--draws', 2000), lambda s: s, 'bad', 'have not converged'),
}


@pytest.mark.parametrize(
    'case',
    [
        # The others are also rows of test_sentences.
        pytest.param(case, marks=() if case in ('good', 'no validation') else pytest.mark.qualify)
        for case in FIT
    ],
)
def test_fit(case: str, healthy: Path, tmp_path: Path) -> None:
    options, change, mood, words = FIT[case]
    session, out = changed(healthy, tmp_path, change), tmp_path / 'fit'
    process = remaster('fit', session, '--out', out, *options)
    page, found, names = page_of(out)
    assert names == {
        'stages', 'posteriors', 'traces', 'errors', 'residuals', 'tool_places', 'accuracy_map',
    }  # fmt: skip
    assert found == mood if mood else found != 'good'
    assert re.search(words, page)
    assert 'written: ' in process.stdout
    fit = json.loads((out / 'fit.json').read_text(encoding='utf-8'))
    assert (fit['accuracy']['validation'] is None) == (case == 'no validation')
    # And every verb that takes a fit takes this one.
    judged = remaster('accuracy', session, '--offsets', out / 'fit.json', '--out', out / 'a.json')
    assert 'mean error [95 % interval], mm' in judged.stdout
    accuracy = json.loads((out / 'a.json').read_text(encoding='utf-8'))['accuracy']
    assert accuracy['optimization'] is not None


@pytest.mark.qualify
def test_offsets_that_are_corrected_hardly_matter(healthy: Path, tmp_path: Path) -> None:
    """The fit of an arm that was corrected: nothing is left to gain, and the report states it."""
    out = tmp_path / 'fit'
    remaster('fit', healthy, '--out', out, '--no-figures')
    urdf = (out / 'apply' / 'robot_calibrated.urdf').read_text(encoding='utf-8')
    session = changed(healthy, tmp_path, lambda s: replace(s, urdf=urdf))
    again = tmp_path / 'again'
    remaster('fit', session, '--out', again)
    page, mood, _ = page_of(again)
    assert mood == 'caution'
    assert 'The zero-offsets hardly matter here' in page
    assert 'That is what noise explains' in page


def test_a_fit_that_the_data_do_not_allow(healthy: Path, tmp_path: Path) -> None:
    session = changed(healthy, tmp_path, lambda s: s.select(s.measurements.pose < 2))
    for verb in ('fit', 'discover'):
        line = refusal(verb, session, '--out', tmp_path / verb, status=1)
        assert 'at least 3 are needed' in line
        assert not (tmp_path / verb / 'report.html').exists()


DISCOVER = {
    'none': ((), 'none', 'good', 'Nothing is there beyond the zero-offsets'),
    'effects': (
        ('--effect', 'joint_axis_tilt@3:0.4'),
        'effects',
        'good',
        'Beyond the zero-offsets there',
    ),
    'undetermined': (
        ('--effect', 'encoder_scale@2:0.4'),
        'undetermined',
        'caution',
        'two causes explain it equally well',
    ),
}


# Of every verdict the page: test_discovery_json. Effects are discovered below, too.
@pytest.mark.qualify
@pytest.mark.parametrize('case', DISCOVER)
def test_discover(case: str, tmp_path: Path) -> None:
    options, verdict, mood, words = DISCOVER[case]
    session = simulated(tmp_path / 'session', '--seed', 3, *options)
    out = tmp_path / 'causes'
    process = remaster('discover', session, '--out', out)
    assert f'verdict: {verdict}' in process.stdout
    found = json.loads((out / 'discovery.json').read_text(encoding='utf-8'))
    assert found['verdict'] == verdict
    page, seen, names = page_of(out)
    assert seen == mood
    assert words in page
    assert names == {'gain', 'drivers'} | ({'causes'} if found['effects'] else set())
    for effect in found['effects']:
        for other in effect['confusable_with']:
            assert other['separate_by'] in page
        # No surrogate of 300 does as well: the value is a bound.
        if round(effect['p_value'], 4) == 0.0033:
            assert 'p &lt; 0.0033 over all causes tried' in page


def test_causes_that_do_harm_on_held_out_poses_are_not_returned(tmp_path: Path) -> None:
    """The held-out poses have the error of the fitted ones with the opposite sign."""
    options = ('--seed', 3)
    clean = read_session(simulated(tmp_path / 'clean', *options))
    tilted = simulated(tmp_path / 'tilted', *options, '--effect', 'joint_axis_tilt@3:0.4')
    assert np.array_equal(clean.measurements.q, read_session(tilted).measurements.q)

    def mirrored(session: Session) -> Session:
        is_held_out = session.measurements.is_validation[:, None]
        opposite = 2.0 * clean.measurements.position - session.measurements.position
        return with_positions(
            session, np.where(is_held_out, opposite, session.measurements.position)
        )

    out = tmp_path / 'causes'
    process = remaster('discover', changed(tilted, tmp_path, mirrored), '--out', out)
    assert 'verdict: unexplained' in process.stdout
    assert 'nothing beyond' not in process.stdout
    found = json.loads((out / 'discovery.json').read_text(encoding='utf-8'))
    assert (found['verdict'], found['effects']) == ('unexplained', [])
    (error,) = found['unexplained']
    assert error['where'] == 'held_out_poses'
    assert error['p_value'] < 0.05
    assert 'joint axis tilt' in error['next'], error['next']
    gain = found['gain']
    assert gain['held_out_rms_after_m'] <= 1.05 * gain['held_out_rms_before_m']
    # The zero-offsets are those of the fit without causes.
    tables = found['joint_offsets_before'], found['joint_offsets_after']
    for before, after in zip(*tables, strict=True):
        if after['identifiable']:
            assert abs(after['mean_deg'] - before['mean_deg']) < 0.3 * after['std_deg']
    page, mood, _ = page_of(out)
    assert mood == 'caution'
    assert 'Errors remain that no known cause explains' in page
    assert error['next'] in page


@pytest.mark.qualify
@pytest.mark.parametrize('case', ['none', 'effects'])
def test_discover_with_a_session_that_confirms(case: str, tmp_path: Path) -> None:
    options = DISCOVER[case][0]
    session = simulated(tmp_path / 'session', '--seed', 3, *options)
    out = tmp_path / 'causes'
    again = changed(session, tmp_path, measured_again)
    process = remaster('discover', session, '--out', out, '--confirm', again)
    assert 'other session: ' in process.stdout
    page, mood, _ = page_of(out)
    assert mood == 'good'
    assert 'In the other session' in page
    assert 'does not confirm' not in page
    found = json.loads((out / 'discovery.json').read_text(encoding='utf-8'))
    assert found['confirmation']['rms_before_m'] > 0.0


def test_a_copy_of_the_session_cannot_confirm_it(healthy: Path, tmp_path: Path) -> None:
    copy = changed(healthy, tmp_path, lambda session: session)
    line = refusal('discover', healthy, '--out', tmp_path / 'causes', '--confirm', copy)
    assert 'a session cannot confirm itself' in line
    assert not (tmp_path / 'causes').exists()


def test_causes_that_another_session_does_not_have_are_not_green(tmp_path: Path) -> None:
    session = simulated(tmp_path / 'session', '--seed', 3, *DISCOVER['effects'][0])
    healthy = simulated(tmp_path / 'healthy', '--seed', 3)
    out = tmp_path / 'causes'
    process = remaster('discover', session, '--out', out, '--confirm', healthy)
    assert 'verdict: effects' in process.stdout
    found = json.loads((out / 'discovery.json').read_text(encoding='utf-8'))
    assert found['verdict'] == 'effects'
    assert found['confirmation']['confirmed'] is False
    page, mood, names = page_of(out)
    assert names == {'gain', 'drivers', 'causes'}
    for effect in found['effects']:
        for other in effect['confusable_with']:
            assert other['separate_by'] in page
    assert mood == 'caution'
    assert 'The other session does not confirm it: its error is ' in page


@pytest.mark.qualify
def test_discover_without_validation(healthy: Path, tmp_path: Path) -> None:
    session = changed(healthy, tmp_path, only_fitted)
    out = tmp_path / 'causes'
    remaster('discover', session, '--out', out)
    page, _, _ = page_of(out)
    assert 'No poses were held out, so the gain is not proven' in page
    # That nothing was found in a healthy arm has been checked by nothing.
    assert 'class="verdict caution"' in page
    assert 'no poses were held out to check it' in page


def test_recover_has_nothing_to_do(healthy: Path) -> None:
    """Its other answers are in test_recover.py."""
    assert run('recover', healthy).returncode in (0, 2)
