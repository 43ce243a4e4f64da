# SPDX-License-Identifier: Apache-2.0
"""The functions of the package: their examples run, and users need nothing deeper."""

import ast
import doctest
import html
import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import pytest
from worlds.arms import jointed_arm

import remaster_ros
from remaster_ros.errors import MisfitError, MistakeFoundError
from remaster_ros.session.records.observations import column_names

ROOT = Path(__file__).parents[2]
FUNCTIONS = [name for name in remaster_ros.__all__ if name != '__version__']


@pytest.mark.parametrize('name', FUNCTIONS)
def test_the_example_of_each_function_runs(name):
    function = getattr(remaster_ros, name)
    found = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    (example,) = found
    assert example.examples, f'{name} has no example'
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert result.failed == 0


def test_there_are_eight():
    expected = ['discover', 'fit', 'import_table', 'plan', 'read_compensation', 'read_session']
    expected += ['session_from', 'simulate']
    assert sorted(FUNCTIONS) == expected


def test_importing_the_package_imports_nothing_else_of_it():
    """A node or a verb must not wait for what it does not use."""
    tree = ast.parse((ROOT / 'remaster_ros' / '__init__.py').read_text(encoding='utf-8'))
    at_once = [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
    ours = [module for module in at_once if module and module.startswith('remaster_ros')]
    assert ours == ['remaster_ros.version']


@pytest.mark.parametrize(
    'page',
    [
        ROOT / 'README.md',
        # Those on how to add something tell developers where code goes.
        *(p for p in sorted((ROOT / 'docs').glob('*.md')) if not p.name.startswith('add-a')),
    ],
    ids=lambda page: page.stem,
)
def test_pages_for_users_import_nothing_deeper(page):
    text = page.read_text(encoding='utf-8')
    deeper = re.findall(r'^\s*(?:from|import) remaster_ros\.\w+.*$', text, re.MULTILINE)
    assert not deeper


@pytest.fixture(scope='module')
def notebook():
    """The names of the shipped notebook after its cells have run, and what each cell ends with."""
    pytest.importorskip('matplotlib')
    path = ROOT / 'docs' / 'examples' / 'remaster.ipynb'
    cells = json.loads(path.read_text(encoding='utf-8'))['cells']
    names, shown = {}, []
    for cell in cells:
        if cell['cell_type'] == 'code':
            body = ast.parse(''.join(cell['source'])).body
            last = body.pop() if isinstance(body[-1], ast.Expr) else None
            exec(compile(ast.Module(body, []), str(path), 'exec'), names)
            if last is not None:
                shown.append(eval(compile(ast.Expression(last.value), str(path), 'eval'), names))
    return names, shown


def test_the_notebook_runs_and_finds_what_it_says(notebook):
    names, shown = notebook
    assert ('joint_compliance', (2,)) in [entry[:2] for entry in shown[-3]]
    assert (abs(shown[-2]) < 4.0).all()
    # The correction turns the joint by its offset and by what its compliance gives.
    assert names['found'].verdict == 'effects'
    assert (abs(shown[-1]) < 3.0).all()
    assert abs(shown[-1]).max() > 0.1


@pytest.mark.parametrize('name', ['session', 'result', 'found'])
def test_what_is_printed_is_short(notebook, name):
    assert len(repr(notebook[0][name])) < 6000


@pytest.mark.parametrize(('name', 'words'), [('result', 'Zero-offsets'), ('found', 'gets wrong')])
def test_a_notebook_shows_the_first_screen_of_the_report(notebook, name, words):
    result = notebook[0][name]
    (frame,) = re.findall(r'srcdoc="([^"]*)"', result._repr_html_())
    screen = html.unescape(frame)
    report = result.save(notebook[0]['folder'] + name).read_text(encoding='utf-8')
    assert words in screen
    assert '<style>' in screen
    assert 'save(folder)' in screen
    # The whole of the verdict, word for word.
    verdict = re.search(r'<section class="verdict.*?</section>', report, re.DOTALL)
    assert verdict
    assert verdict[0] in screen
    assert set(result.figures()) == {
        path.stem for path in (Path(notebook[0]['folder'] + name) / 'figures').glob('*.svg')
    } - {'stages'}


def test_columns_are_those_of_the_file(notebook, tmp_path):
    session = notebook[0]['session']
    columns = session.columns()
    assert {len(values) for values in columns.values()} == {len(session.measurements)}
    assert set(columns) < {name for names in column_names(7).values() for name in names}


def test_columns_of_a_joint_that_slides_are_in_m(session):
    arm = jointed_arm(
        ('revolute', '0 0 1', '0 0 0.4', '0 0 0'), ('prismatic', '0 0 1', *2 * ['0 0 0'])
    )
    rows = replace(session.measurements, wanted=session.measurements.q)
    session = replace(session, urdf=arm, base_link='base', tip_link='tool0', measurements=rows)
    assert session.slides == (False, True)
    expected = column_names(2, [False, True])
    for field in ('q', 'from_q', 'effort', 'wanted'):
        assert set(expected[field]) < set(session.columns())


@pytest.mark.parametrize('made', [MisfitError('what', 'remedy'), MistakeFoundError('it', '--x')])
def test_an_error_of_a_worker_arrives(made):
    again = pickle.loads(pickle.dumps(made))
    assert (type(again), str(again), vars(again)) == (type(made), str(made), vars(made))
