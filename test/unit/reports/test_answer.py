# SPDX-License-Identifier: Apache-2.0
"""What the page of `remaster report` decides: the deed, the gain, the colour, what remains."""

import builtins
import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from worlds.discovery_files import discovery_content, effect

from remaster_ros.compensation.export import exports
from remaster_ros.errors import InputError
from remaster_ros.reports.answer import answer_of
from remaster_ros.reports.answer_figures import Subject
from remaster_ros.reports.discovery_judgement import more_than_noise
from remaster_ros.reports.fit_json import fit_content
from remaster_ros.reports.pages import law
from remaster_ros.reports.remaining_errors import NO_FILE
from remaster_ros.reports.report import answer_html, checked_svg, require_ready, worst_rows
from remaster_ros.reports.report_inputs import Inputs, errors_with_model_mm, parts, read_inputs
from remaster_ros.reports.result_folder import save_fit
from remaster_ros.reports.schemas import (
    Discovered,
    Fit,
    Judgement,
    MeasuredSession,
    PredictedRegions,
)

STEP = {'driver': 'time', 'form': 'step', 'name': 'unnamed', 'moment_s': 455.0}
SLIP = {**STEP, 'joints': [3], 'title': 'Joint 3 slipped'}
BUMP = {
    **STEP,
    'place': 'sensor_frame',
    'joints': [],
    'title': 'The sensor tracker moved',
    'of_measurement': True,
}
LENGTH = {
    'name': 'link_length',
    'place': 'link_translation',
    'driver': 'constant',
    'title': 'Link length of joint 2',
    'in_robot_model': True,
}
SOFT = {'title': 'Joint compliance of joint 2'}
# Its form is a step as well, over the side of approach and not over time.
BACKLASH = {
    'name': 'backlash',
    'driver': 'approach',
    'form': 'step',
    'title': 'Backlash of joint 2',
}


def discovery(fit, effects, verdict='effects', mood='good'):
    content = msgspec.to_builtins(fit)
    noise = {'pose_common_fraction': 0.5, 'outliers': [], 'heteroscedastic': {}}
    shown = {
        'sizes': ['by 1.00 mm ± 0.01 mm'],
        'size_m': 1e-3,
        'share': 0.5,
        'remedy': 'The remedy.',
    }
    content = discovery_content(
        *(effect(**{**shown, **found}) for found in effects),
        verdict=verdict,
        noise={**noise, 'sensors': content['noise']},
        joint_offsets_after=[
            row | {'mean_deg': row['mean_deg'] + 0.5} for row in content['joint_offsets']
        ],
        judgement={'mood': mood, 'headline': '.'},
    )
    return msgspec.convert(content, Discovered)


@pytest.fixture
def fit(fit_result) -> Fit:
    fit = msgspec.convert(msgspec.to_builtins(fit_content(fit_result)), Fit)
    fit.judgement = Judgement('good', 'The mean position error falls.')
    return fit


@pytest.fixture
def inputs(fit_result, fit):
    """Return a function: effects of a discovery (None without one) and changes -> inputs."""

    def made(
        effects=None, verdict='effects', mood='good', errors=(3.0, 0.5, 0.3), model=None
    ) -> Inputs:
        rows = np.ones(len(fit_result.session.measurements))
        found = None if effects is None else discovery(fit, effects, verdict, mood)
        before, after, causes = (rows * error for error in errors)
        by = (before, after, causes if effects else None, None if model is None else rows * model)
        return Inputs(fit_result.session, fit, found, *by)

    return made


@pytest.mark.parametrize(
    ('effects', 'action', 'uses_causes', 'mood'),
    [
        (None, 'set', False, 'good'),
        ([], 'set', False, 'good'),
        ([LENGTH], 'set', False, 'caution'),
        ([SOFT], 'set', False, 'caution'),
        ([LENGTH, SOFT], 'set', False, 'caution'),
        ([BUMP], 'set', True, 'caution'),
        ([SLIP], 'wait', False, 'caution'),
        ([BACKLASH], 'set', False, 'caution'),
    ],
)
def test_the_deed_takes_the_offsets_that_belong_to_its_files(
    inputs, fit, effects, action, uses_causes, mood
):
    answer = answer_of(inputs(effects))
    assert (answer.action, answer.uses_causes, answer.mood) == (action, uses_causes, mood)
    shift = 0.5 if uses_causes else 0.0
    assert answer.offsets[1].mean_deg == fit.joint_offsets[1].mean_deg + shift
    assert answer.brings == (2 if uses_causes else 1)
    assert len(answer.stages) == (3 if effects else 2)
    assert 'robot_model.urdf' not in answer.files
    assert bool(answer.files) == (action == 'set')


def test_causes_that_stay_are_listed_with_their_remedy_and_the_others_are_not(inputs):
    remains = answer_of(inputs([LENGTH, SOFT])).remains
    assert [row.what for row in remains] == [
        'Link length of joint 2',
        'Joint compliance of joint 2',
    ]
    assert [row.remedy for row in remains] == [NO_FILE, 'The remedy.']
    answer = answer_of(inputs([LENGTH], model=0.3))
    assert answer.mood == 'good'
    (item,) = answer.remains
    assert item.what == 'Noise'


@pytest.mark.parametrize(
    ('model', 'errors', 'there'),
    [
        (0.4, (3.0, 0.5, 0.3), True),
        (0.49, (3.0, 0.5, 0.3), False),
        (0.29, (0.3, 0.299, 0.2), False),
    ],
)
def test_no_page_names_a_file_that_is_not_beside_it(inputs, fit_result, model, errors, there):
    file = 'apply/robot_model.urdf'
    length = {**LENGTH, 'remedy': f'Put it into the robot model: {file} has it.'}
    made = inputs([length, SOFT], errors=errors, model=model)
    made.found.untestable, made.found.unexplained = {}, []
    none = {'rows': 0, 'inside': 0, 'share': None, 'interval95': None}
    regions = {'widening': 1.0, 'held_out': none, 'fitted': none}
    made.found.predicted_regions95 = msgspec.convert(regions, PredictedRegions)
    for key in ('registration', 'markers', 'sampler'):
        setattr(made.found, key, getattr(made.fit, key))
    answer = answer_of(made)
    assert ('robot_model.urdf' in answer.files) == there
    html = answer_html(Subject(made, answer, fit_result.chain), {})
    assert (file in html) == there


@pytest.mark.parametrize(('model', 'loads'), [(0.4, True), (0.49, False)])
def test_a_robot_model_that_holds_a_part_is_used_where_that_helps(inputs, fit, model, loads):
    answer = answer_of(inputs([LENGTH, SOFT], model=model))
    assert answer.loads_model == loads
    assert not answer.uses_causes
    assert [stage.mean for stage in answer.stages] == pytest.approx([3.0, 0.5, model, 0.3])
    assert answer.brings == (2 if loads else 1)
    assert answer.final_mm[0] == (model if loads else 0.5)
    assert answer.mood == 'caution'
    assert answer.headline.startswith('Load the robot model' if loads else 'Set the zero-offsets')
    # What is set on the pad stays the zero-offsets by themselves.
    assert answer.offsets == tuple(fit.joint_offsets)
    named = [row.what for row in answer.remains]
    assert ('Link length of joint 2' in named) != loads
    assert 'Joint compliance of joint 2' in named


def test_a_fit_without_a_search_offers_its_robot_model_too(inputs):
    answer = answer_of(inputs(model=0.3))
    assert answer.loads_model
    assert [stage.mean for stage in answer.stages] == pytest.approx([3.0, 0.5, 0.3])
    assert 'robot_model.urdf' in answer.files


def test_the_first_screen_names_the_largest_causes_alone(inputs):
    names = [row.what for row in answer_of(inputs(7 * [SOFT])).remains]
    assert names == [*4 * ['Joint compliance of joint 2'], '3 smaller causes']


def test_a_robot_model_is_judged_as_it_is(fit_result):
    """The calibrated model leaves what the offsets leave, the nominal one what there is today."""
    session = fit_result.session
    calibrated = errors_with_model_mm(session, exports(fit_result)['robot_calibrated.urdf'])
    nominal = errors_with_model_mm(session, session.urdf)
    held_out = session.measurements.is_validation
    for found, residuals in (
        (nominal, fit_result.residuals_before),
        (calibrated, fit_result.residuals_after),
    ):
        expected = 1e3 * np.linalg.norm(residuals, axis=1)[held_out].mean()
        assert found[held_out].mean() == pytest.approx(expected, rel=0.03)


def test_what_no_cause_explains_is_never_called_noise(inputs, fit):
    assert [row.what for row in answer_of(inputs([])).remains] == ['Noise']
    fit.judgement.findings = ['tracker: the error after is 0.500 mm; noise makes 0.100 mm.']
    item = answer_of(inputs()).remains[0]
    assert (item.what, item.size) == ('More than noise', fit.judgement.findings[0])
    assert 'remaster discover' in item.sentence
    assert '..' not in item.sentence
    (searched,) = answer_of(inputs([])).remains
    assert searched.what == 'More than noise'
    assert searched.size.startswith(fit.judgement.findings[0].rstrip('.'))
    # A cause that the robot model then holds has answered the finding of the fit without it.
    assert [row.what for row in answer_of(inputs([LENGTH], model=0.3)).remains] == ['Noise']


def test_the_noise_of_a_sensor_has_what_the_readings_of_a_pose_share(inputs, fit):
    sensors = {}
    for sensor, noise in fit.noise.items():
        sensors[sensor] = msgspec.structs.replace(noise, pose_sigma_m=2e-4)
    shown = answer_of(replace(inputs(), fit=msgspec.structs.replace(fit, noise=sensors))).noise
    assert shown
    for row in shown:
        # The mean length of a Gaussian error in three dimensions: sqrt(8 / pi) times its std.
        shared = np.sqrt(8.0 / np.pi) * 0.2
        assert row.shared_mm == pytest.approx(np.hypot(row.reading_mm, shared), rel=1e-6)


def test_the_first_screen_says_how_to_see_whether_it_is_in_use(inputs, fit_result):
    html = answer_html(Subject(inputs(), answer_of(inputs()), fit_result.chain), {})
    assert 'run <code>remaster verify</code>' in html
    assert 'href="apply/compensation.json"' in html


def test_the_column_beside_what_to_do_is_filled_below_the_plot(inputs, fit_result):
    """What to do is the longer column: what remains stands in the other, under the plot."""
    drawings = {'stages': 'the plot of the stages'}
    html = answer_html(Subject(inputs(), answer_of(inputs()), fit_result.chain), drawings)
    do, other = re.findall(r'<section>(.*?)</section>', html, re.DOTALL)[:2]
    assert re.findall(r'<h2 id="(\w+)"', do) == ['do']
    places = [other.index(text) for text in ('id="brings"', drawings['stages'], 'id="remains"')]
    assert places == sorted(places)


def test_a_doubt_is_no_finding(inputs, fit):
    """Where nothing shows how large the noise is, nobody is told that it is exceeded."""
    fit.judgement.doubts = ['tracker: nothing shows how much of the 0.500 mm is noise.']
    item = answer_of(inputs()).remains[0]
    assert (item.what, item.size) == (
        'May be sensor noise alone',
        fit.judgement.doubts[0],
    )
    (searched,) = answer_of(inputs([])).remains
    assert searched.what == 'Noise'
    assert 'nothing shows' in searched.size


def test_many_gross_errors_say_when_and_of_which_sensor(inputs):
    made = inputs([])
    m = made.session.measurements
    rows = np.flatnonzero(m.sensor == m.sensor[-1])[-4:]
    made.found.noise.outliers = m.observation[rows].tolist()
    (gross,) = answer_of(made).remains
    first, last = m.configuration[rows[[0, -1]]]
    minutes = (m.stamp_s[rows[0]] - m.stamp_s[0]) / 60.0
    name = made.session.sensor_names[m.sensor[-1]]
    assert gross.size.startswith(f'4 of {len(m)} readings, of {name}: ')
    assert f'configurations {first} to {last}, {minutes:.1f} to ' in gross.size


def test_single_gross_errors_decide_nothing(inputs):
    """Three of the held-out readings, 80 mm off with and without offsets, are counted apart."""
    clean, made = inputs([]), inputs([])
    held_out = np.flatnonzero(made.session.measurements.is_validation)
    rows = held_out[: len(held_out) // 15]
    assert len(rows) > 1
    made.before_mm[rows] = made.after_mm[rows] = 80.0
    made.found.noise.outliers = made.session.measurements.observation[rows].tolist()
    answer = answer_of(made)
    assert answer.action == 'set'
    assert [stage.mean for stage in answer.stages] == [s.mean for s in answer_of(clean).stages]
    assert answer.not_counted == len(rows)
    assert f'({len(rows)} gross errors not counted)' in answer.headline
    # A third of them is no matter of single gross errors.
    third = held_out[: len(held_out) // 3]
    made.found.noise.outliers = made.session.measurements.observation[third].tolist()
    assert answer_of(made).not_counted == 0


def test_an_error_of_the_measurement_is_no_gain_of_the_arm(inputs):
    headline = answer_of(inputs([BUMP])).headline
    assert 'The sensor tracker moved' in headline
    assert 'times smaller' not in headline
    assert '10 times smaller' in answer_of(inputs([LENGTH], model=0.3)).headline


@pytest.mark.parametrize(
    'obstacle', ['fit', 'discovery', 'disagreement', 'undetermined', 'unproven']
)
def test_no_green_where_anything_disagrees(inputs, fit, obstacle):
    effects, options = [LENGTH], {}
    if obstacle == 'fit':
        effects, fit.judgement.mood = [], 'caution'
    elif obstacle == 'discovery':
        options['mood'] = 'caution'
    elif obstacle == 'disagreement':
        fit.judgement.disagreements = ['While it was measured, tracker moved.']
    elif obstacle == 'undetermined':
        options['verdict'] = 'undetermined'
    made = inputs(effects, **options)
    if obstacle == 'unproven':
        m = made.session.measurements
        fitted = replace(m, is_validation=np.zeros(len(m), bool))
        made = replace(made, session=replace(made.session, measurements=fitted))
    answer = answer_of(made)
    assert answer.mood == 'caution'
    if obstacle == 'disagreement':
        assert any('tracker moved' in row.size for row in answer.remains)


def test_a_fit_that_is_red_sets_nothing(inputs, fit):
    fit.judgement = Judgement('bad', 'The chains have not converged.')
    answer = answer_of(inputs())
    assert (answer.action, answer.mood, answer.files) == ('wait', 'bad', [])
    assert answer.headline == 'Set nothing yet. The chains have not converged.'


def test_offsets_that_bring_nothing_are_not_set(inputs):
    answer = answer_of(inputs(errors=(0.52, 0.5, 0.5)))
    assert answer.action == 'nothing'
    assert answer.headline.startswith('Nothing has to be set')


def test_only_what_happened_at_one_moment_has_the_law_of_a_step(fit):
    slip, play = discovery(fit, [SLIP, BACKLASH]).effects
    assert 't₀' in law(slip)
    assert 't₀' not in law(play)


def test_the_worst_rows_come_first_with_time_and_place(inputs):
    made = inputs()
    made.after_mm[[5, 9]] = 4.0, 7.0
    first, second = worst_rows(made, answer_of(made))[:2]
    m = made.session.measurements
    assert [first.observation, second.observation] == m.observation[[9, 5]].tolist()
    assert first.after_mm == 7.0
    assert first.when.endswith(' min')
    assert np.all(np.abs(first.place_mm) < 3000.0)


def test_results_of_other_data_are_refused(fit_result, tmp_path):
    save_fit(fit_result, tmp_path, figures=False)
    session = fit_result.session
    path = tmp_path / 'fit.json'
    content = msgspec.json.decode(path.read_bytes())
    content['session']['observations_sha256'] = 'ab'
    path.write_bytes(msgspec.json.encode(content))
    with pytest.raises(InputError, match=r'of other data than this session .*; fit this session'):
        read_inputs(session, path, None)
    del content['judgement']
    path.write_bytes(msgspec.json.encode(content))
    with pytest.raises(InputError, match='of an earlier version; fit this session again'):
        read_inputs(session, path, None)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda text: text.replace('before_x_m', 'x'), "has no column 'before_x_m'"),
        (lambda text: '\n'.join(text.splitlines()[:-1]) + '\n', r'\d+ rows of \d+'),
        (lambda text: text.replace('\n0,', '\n7777,', 1), 'line 2: not the rows of this session'),
        (lambda text: text + text.splitlines()[-1], 'not the rows of this session'),
    ],
)
def test_damaged_residuals_are_named(fit_result, tmp_path, change, words):
    save_fit(fit_result, tmp_path, figures=False)
    path = tmp_path / 'residuals.csv'
    path.write_text(change(path.read_text()))
    content = msgspec.json.decode((tmp_path / 'fit.json').read_bytes())
    content['session']['observations_sha256'] = ''
    (tmp_path / 'fit.json').write_bytes(msgspec.json.encode(content))
    with pytest.raises(InputError, match=words) as error:
        read_inputs(fit_result.session, tmp_path / 'fit.json', None)
    assert 'residuals.csv' in str(error.value)


def test_which_file_is_which_is_found_by_its_name(tmp_path):
    for name in ('fit', 'discovery'):
        (tmp_path / name).mkdir()
        (tmp_path / name / f'{name}.json').write_text('{}')
    fit, found = tmp_path / 'fit/fit.json', tmp_path / 'discovery/discovery.json'
    assert parts([tmp_path / 'discovery', tmp_path / 'fit']) == (fit, found)
    assert parts([found]) == (None, found)
    assert parts([]) == (None, None)
    for wrong, words in (
        ([fit, tmp_path / 'fit'], 'two files fit.json'),
        ([tmp_path], 'neither fit.json nor discovery.json'),
        ([tmp_path / 'other.json'], 'give fit.json or discovery.json'),
        ([tmp_path / 'fitt'], 'there is no such file or folder; give'),
    ):
        with pytest.raises(InputError, match=words):
            parts(wrong)


@pytest.mark.parametrize(
    'content',
    [
        '<script>alert(1)</script>',
        '<g onload="alert(1)"/>',
        '<use href="http://example.org/x"/>',
        '<style>* {fill: url(http://example.org)}</style>',
        '<foreignObject/>',
    ],
)
def test_a_figure_that_is_more_than_a_drawing_is_refused(content, tmp_path):
    svg = '<svg xmlns="http://www.w3.org/2000/svg">{}</svg>'
    path = tmp_path / 'traces.svg'
    assert checked_svg(svg.format('<g><path d="M 0 0"/></g>'), path)
    with pytest.raises(InputError, match='more than a drawing'):
        checked_svg(svg.format(content), path)


def test_the_page_of_another_command_is_not_replaced(tmp_path):
    (tmp_path / 'report.html').write_text('<meta name="generator" content="remaster_ros">')
    with pytest.raises(InputError, match='name another folder with --out'):
        require_ready(tmp_path, pdf=False)


@pytest.mark.parametrize(
    ('error', 'words'),
    [
        (ImportError('no'), r"pip install 'remaster_ros\[pdf\]'"),
        (OSError("cannot load library 'pango'\nmore"), r"library 'pango'\): apt install libpango"),
    ],
)
def test_without_what_makes_pdf_one_line_says_how_to_get_it(tmp_path, monkeypatch, error, words):
    usual = builtins.__import__

    def importing(name, *args, **kwargs):
        if name == 'weasyprint':
            raise error
        return usual(name, *args, **kwargs)

    monkeypatch.setattr(builtins, '__import__', importing)
    with pytest.raises(InputError, match=words) as found:
        require_ready(tmp_path, pdf=True)
    assert '\n' not in str(found.value)


@pytest.mark.parametrize(
    ('rows', 'inside', 'after_m', 'says'),
    [
        (400, (0.93, 0.97), 0.41e-3, ''),
        (400, (0.93, 0.97), 0.70e-3, '1.8 times that of the noise'),
        # Ten rows may be that far off by chance.
        (10, (0.70, 1.00), 0.60e-3, ''),
        (400, (0.80, 0.88), 0.41e-3, 'Fewer held-out rows'),
    ],
)
def test_what_held_out_rows_show_to_be_more_than_noise(fit, rows, inside, after_m, says):
    content = discovery(fit, [LENGTH])
    content.gain = msgspec.structs.replace(
        content.gain, held_out_rms_after_m=after_m, noise_floor_m=0.4e-3
    )
    held_out = {'rows': rows, 'inside': rows, 'share': 1.0, 'interval95': inside}
    regions = {'widening': 1.0, 'held_out': held_out, 'fitted': held_out}
    content.predicted_regions95 = msgspec.convert(regions, PredictedRegions)
    content.session = msgspec.convert(msgspec.to_builtins(fit.session), MeasuredSession)
    found = more_than_noise(content)
    assert (says in found) if says else not found
    assert 'by chance' not in found
    # The rows of a pose share its error: one pose that is far off proves nothing.
    content.session.validation.poses = 1
    assert ('by chance, as so few poses were held out, or' in more_than_noise(content)) == bool(
        says
    )


@pytest.mark.parametrize('effects', [[BACKLASH], [SOFT]], ids=['backlash', 'soft'])
def test_no_robot_model_is_loaded_that_imitates_what_is_no_length_and_no_tilt(inputs, effects):
    """Of backlash lengths and tilts take up a tenth, on held-out poses too."""
    answer = answer_of(inputs(effects, model=0.3))
    assert not answer.loads_model
    assert answer.headline.startswith('Set the zero-offsets')
    assert 'robot_model.urdf' not in answer.files


def test_what_the_measurement_errs_by_is_said_where_it_stays_in_both_errors(inputs):
    answer = answer_of(inputs([LENGTH, {**BUMP, 'sizes': []}], model=0.4))
    assert answer.loads_model
    title = answer.remains[0].what
    assert answer.headline.endswith(f'Both contain what the measurement errs by ({title}).')
    # A cause without sizes of its own has that at the marker.
    assert answer.remains[0].size == '1.000 mm RMS at the marker'
    assert 'Both contain' not in answer_of(inputs([LENGTH], model=0.4)).headline


def test_so_few_poses_are_not_sent_to_a_search(inputs, fit):
    fit.judgement.findings = ['tracker: the error after is 3.2 mm; noise makes 0.3 mm.']
    assert 'remaster discover' in answer_of(inputs()).remains[0].remedy
    fit.judgement.doubts = ['So few poses do not show whether other errors are left.']
    assert answer_of(inputs()).remains[0].remedy == 'Measure more poses first, and fit again.'


def test_one_held_out_pose_is_said_to_prove_little(inputs, fit):
    fit.session.validation.poses = 1
    sizes = {row.what: row.size for row in answer_of(inputs()).remains}
    assert 'Only 1 pose was held out' in sizes['Hardly proven']
