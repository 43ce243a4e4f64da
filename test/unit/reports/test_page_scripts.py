"""The scripts of the pages compile, also where there is no browser to try them in."""

import base64
import gzip
import importlib.resources
import re

import pytest
from py_mini_racer import JSEvalException, JSParseException, MiniRacer

from remaster_ros import reports
from remaster_ros.cli import main as cli
from remaster_ros.reports.robot_scene import view_script


def compiled(script):
    """Compile a script with V8 and run nothing of it."""
    return MiniRacer().eval('(function () {\n' + script + '\n})')


def page(name):
    """Return what a script of the live page says."""
    path = importlib.resources.files(reports).joinpath('live_page', name)
    return path.read_text(encoding='utf-8')


def test_the_live_page_s_scripts_compile_beside_one_another():
    # They share one global scope: a name that two of them declare stops the second.
    names = re.findall(r'<script src="([^"]+)"', page('index.html'))
    assert names == ['plotly.js', 'robot_view.js', 'scene.js', 'page.js']
    compiled('\n'.join([view_script(), page('scene.js'), page('page.js')]))


def test_a_plan_s_scripts_compile(tmp_path):
    out = tmp_path / 'plan.html'
    assert cli.main(['plan', 'demo', '--poses', '12', '--validation', '8', '--out', str(out)]) == 0
    html = out.read_text(encoding='utf-8')
    packed = re.search(r'id="code-gzip">([^<]*)<', html)[1]
    played = gzip.decompress(base64.b64decode(packed)).decode()
    [own] = re.findall(r'<script>(.*?)</script>', html, re.DOTALL)
    compiled(own + played)
    # The judge judges: with one name declared twice it refuses.
    with pytest.raises((JSParseException, JSEvalException), match='already been declared'):
        compiled(own + played + 'const RobotView = 1;')


def test_a_report_s_scripts_compile():
    compiled(view_script('fit_page.js'))
