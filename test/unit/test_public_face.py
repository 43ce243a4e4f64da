"""The functions of the package: their examples run, and users need nothing deeper."""

import ast
import doctest
import re
from pathlib import Path

import pytest

import remaster_ros

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
