# SPDX-License-Identifier: Apache-2.0
"""The page of a plan: complete in itself, true to the plan, and played in a browser."""

import base64
import gzip
import importlib.resources
import json
import re

import numpy as np
import pytest
from judges.html_page import Page
from py_mini_racer import JSEvalException, JSParseException, MiniRacer
from rigs.browser import NO_WEBGL, seen
from worlds.simple_cells import four_markers

from remaster_ros import reports
from remaster_ros.cli import main as cli
from remaster_ros.cli import plan as plan_verb
from remaster_ros.planning import moving_design
from remaster_ros.reports.plan_page import write_plan_page
from remaster_ros.reports.scene_view import view_script
from remaster_ros.session.cells.workcell import read_cell

FEW = ('--poses', '12', '--validation', '8')


@pytest.fixture(scope='module')
def planned(tmp_path_factory):
    """The page of a small plan of the demo cell, and the plan as JSON."""
    folder = tmp_path_factory.mktemp('plan')
    path = folder / 'plan.html'
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        patch.setattr('builtins.print', lambda *args, **_: printed.append(' '.join(args)))
        assert cli.main(['plan', 'demo', *FEW, '--json', '--out', str(path)]) == 0
    return path, json.loads(''.join(printed))


def test_the_page_is_complete_in_itself_and_has_the_figures_of_the_plan(planned):
    path, plan = planned
    html = path.read_text(encoding='utf-8')
    page = Page(html)
    assert all(address.startswith('#') for address in page.addresses)
    assert not re.search(r'url\((?!#)|@import', html)
    text = page.text
    assert f'{plan["configurations"]} configurations at {plan["poses"]} poses' in text
    assert f'{plan["robot_time_s"] / 60:.1f} min of robot time' in text
    assert f'faster than {plan["max_tool_speed_m_s"]:.2f} m/s' in text
    for name, std in plan['expected_std_deg'].items():
        assert f'{name} {"not identifiable" if std is None else f"{std:.4f}"}' in text
    for reason, count in plan['dropped'].items():
        lost = plan['dropped_configurations'][reason]
        assert f'{reason} {count} {lost}' in text
    # The 3-D library is a quarter of a megabyte of it.
    assert len(html) < 400_000


def check_arm(q, drawn):
    """Check that the page has the arm at joint angles (n, k) where the kinematics have it."""
    cell = read_cell('demo')
    chain = cell.chain()
    marker = cell.planning_scene(chain).sights[0].marker_T
    for angles, there in zip(q, drawn, strict=True):
        np.testing.assert_allclose(there['tip'], chain.positions(angles, marker), atol=1e-6)
        # Column by column; the base first, the tool last.
        frames = np.array(there['frames']).reshape(-1, 4, 4).swapaxes(1, 2)
        np.testing.assert_allclose(frames[1:-1], chain.frames(angles), atol=1e-6)
        np.testing.assert_allclose(frames[-1], chain.forward(angles), atol=1e-6)


def test_every_configuration_is_played_in_its_own_time(planned):
    path, plan = planned
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (3, 7))
    found = seen(
        path,
        """
        const at = (id) => document.getElementById(id).textContent;
        const key = (name) => document.getElementById(name).click();
        const texts = (cells) => [...cells].map((cell) => cell.textContent);
        const angles = () => texts(document.querySelectorAll('#joints .n'));
        const first = {state: at('state'), angles: angles(), clock: at('clock')};
        key('after');
        const second = {state: at('state'), angles: angles()};
        document.getElementById('all').open = true;
        await wait(100);
        const rows = [...document.querySelectorAll('#visits tr')].map((row) => texts(row.cells));
        const slider = document.getElementById('time');
        slider.value = slider.max;
        slider.dispatchEvent(new Event('input'));
        const last = {state: at('state'), clock: at('clock')};
        location.hash = '#c3';
        await wait(100);
        const linked = at('state');
        document.getElementById('speed').value = '30';
        const begun = Number(slider.value);
        key('play');
        for (let i = 0; i < 100 && Number(slider.value) <= begun; i++)
            await new Promise(requestAnimationFrame);
        key('play');
        for (const button of document.querySelectorAll('#views button')) button.click();
        const canvas = document.querySelector('#scene canvas');
        const plan = JSON.parse(await unpacked('data-gzip'));
        const view = new RobotView(document.createElement('div'), plan.scene);
        const arm = ANGLES.map((q) => ({
            tip: view.tip(q).toArray(), frames: view.frames(q).map((T) => T.toArray())}));
        dispatchEvent(new Event('beforeprint'));
        const paper = document.getElementById('printed');
        const pixels = paper.getContext('2d').getImageData(0, 0, paper.width, paper.height).data;
        const colors = new Set(new Uint32Array(pixels.buffer)).size;
        return {arm, first, second, rows, last, linked, begun, played: Number(slider.value),
                colors, paper: paper.checkVisibility(),
                canvas: [canvas.clientWidth, canvas.clientHeight],
                hidden: ['no-webgl', 'loading'].map((id) => document.getElementById(id).hidden)};
        """.replace('ANGLES', json.dumps(q.tolist())),
    )
    check_arm(q, found['arm'])
    count = plan['configurations']
    begin = f'1 of {count}: for the registration, pose 1, measured'
    assert found['first']['state'].startswith(begin)
    assert found['second']['state'].startswith(f'2 of {count}: ')
    assert found['first']['angles'] != found['second']['angles']
    rows = found['rows']
    assert [row[0] for row in rows] == [str(i + 1) for i in range(count)]
    # What the bars show is what the list has.
    shown = ', '.join(found['second']['angles']).replace('°', '')
    assert shown == rows[1][-1]
    # Its times add up to the plan's: ways and standstill.
    total = sum(float(row[4]) for row in rows) + 3.5 * count
    assert total == pytest.approx(plan['robot_time_s'], abs=0.06 * count)
    minutes, seconds = map(int, found['last']['clock'].partition(' / ')[2].split(':'))
    assert 60 * minutes + seconds == pytest.approx(plan['robot_time_s'], abs=1.0)
    assert found['last']['state'].startswith(f'{count} of {count}: ')
    assert found['linked'].startswith(f'3 of {count}: ')
    # It went on from the third configuration.
    third = sum(float(row[4]) + 3.5 for row in rows[:3]) - 3.5
    assert found['begun'] == pytest.approx(third, abs=0.2)
    assert found['played'] > found['begun']
    assert found['canvas'][0] > 300
    assert found['canvas'][1] > 200
    assert found['hidden'] == [True, True]
    # On paper there is a picture, too: a copy, as what WebGL has drawn is not printed.
    assert found['colors'] > 100
    assert not found['paper']


def test_a_curve_is_played_as_it_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(moving_design, 'EXCHANGES', 5)
    cell, path, plans = four_markers(tmp_path / 'cell.yaml'), tmp_path / 'plan.html', []
    drawn = plan_verb.plan_page
    monkeypatch.setattr(
        plan_verb, 'plan_page', lambda plan, *args: plans.append(plan) or drawn(plan, *args)
    )
    assert cli.main(['plan', str(cell), '--moving', '24', '--quiet', '--out', str(path)]) == 0
    (plan,) = plans
    before = [visit.trajectory.duration_s + plan.measuring_s for visit in plan.visits[:4]]
    since = np.array([1.23, 2.34])
    page = Page(path.read_text(encoding='utf-8'))
    assert 's of motion along 8 curves are measured all along, with every marker' in page.text
    found = seen(
        path,
        """
        const slider = document.getElementById('time');
        const shown = [];
        for (const time of TIMES) {
            slider.value = time;
            slider.dispatchEvent(new Event('input'));
            const angles = [...document.querySelectorAll('#joints .n')];
            shown.push({state: document.getElementById('state').textContent,
                        angles: angles.map((cell) => cell.textContent)});
        }
        return {shown, total: Number(slider.max)};
        """.replace('TIMES', json.dumps((sum(before) + since).tolist())),
    )
    assert found['total'] == pytest.approx(plan.robot_time_s, abs=0.1)
    for time_s, shown in zip(since, found['shown'], strict=True):
        assert shown['state'].startswith(f'5 of {len(plan.visits)}: held out, pose 1, measured on')
        angles = [float(text[:-1].replace('\u2212', '-')) for text in shown['angles']]
        there = np.degrees(plan.visits[4].trajectory.at(time_s)[0])
        np.testing.assert_allclose(angles, there, atol=0.2)


def test_without_webgl_the_page_says_so_and_has_all_else(planned):
    path, plan = planned
    found = seen(
        path,
        """
        document.getElementById('after').click();
        const missing = document.getElementById('no-webgl');
        return {text: missing.textContent, shown: missing.checkVisibility(),
                canvas: document.querySelectorAll('#scene canvas').length,
                state: document.getElementById('state').textContent};
        """,
        *NO_WEBGL,
    )
    assert found['text'].startswith('This browser has no WebGL')
    assert 'JavaScript' not in found['text']
    assert found['shown']
    assert found['canvas'] == 0
    assert found['state'].startswith(f'2 of {plan["configurations"]}: ')


def test_only_a_page_of_its_own_is_written_over(planned, tmp_path, capsys):
    path, _ = planned
    html = path.read_text(encoding='utf-8')
    write_plan_page(path, html.replace('fetches nothing', 'fetches nothing at all'))
    assert 'fetches nothing at all' in path.read_text(encoding='utf-8')
    write_plan_page(path, html)
    other = tmp_path / 'notes.html'
    other.write_text('<html>mine</html>')
    assert cli.main(['plan', 'demo', *FEW, '--quiet', '--out', str(other)]) == 2
    error = capsys.readouterr().err
    assert error.startswith('error: ')
    assert 'give another name' in error
    assert other.read_text() == '<html>mine</html>'


# Scripts of the pages, also where there is no browser to try them in


def compiled(script):
    """Compile a script with V8 and run nothing of it."""
    return MiniRacer().eval('(function () {\n' + script + '\n})')


def live_page(name):
    """Return what a script of the live page says."""
    path = importlib.resources.files(reports).joinpath('live_page', name)
    return path.read_text(encoding='utf-8')


def test_the_live_page_s_scripts_compile_beside_one_another():
    # They share one global scope: a name that two of them declare stops the second.
    names = re.findall(r'<script src="([^"]+)"', live_page('index.html'))
    assert names == ['plotly.js', 'robot_view.js', 'scene.js', 'page.js']
    compiled('\n'.join([view_script(), live_page('scene.js'), live_page('page.js')]))


def test_a_plan_s_scripts_compile(planned):
    html = planned[0].read_text(encoding='utf-8')
    packed = re.search(r'id="code-gzip">([^<]*)<', html)[1]
    played = gzip.decompress(base64.b64decode(packed)).decode()
    [script] = re.findall(r'<script>(.*?)</script>', html, re.DOTALL)
    compiled(script + played)
    # The judge judges: with one name declared twice it refuses.
    with pytest.raises((JSParseException, JSEvalException), match='already been declared'):
        compiled(script + played + 'const RobotView = 1;')


def test_a_report_s_scripts_compile():
    compiled(view_script('fit_page.js'))
