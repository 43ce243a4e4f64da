# SPDX-License-Identifier: Apache-2.0
"""docs/architecture.md is true: its modules exist, and no subject is left out."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
SUBJECTS = {path.parent.name for path in (ROOT / 'remaster_ros').glob('*/__init__.py')}


def named() -> set[str]:
    """Return the modules that the page names, the drawing included."""
    subjects = '|'.join(sorted(SUBJECTS))
    return set(re.findall(rf'(?<![\w./])(?:{subjects})(?:\.[a-z_0-9]+)+', PAGE))


def test_every_module_on_the_page_exists() -> None:
    modules = named()
    assert len(modules) > 60
    missing = [
        name
        for name in sorted(modules - {'discovery.json'})
        if importlib.util.find_spec(f'remaster_ros.{name}') is None
    ]
    assert not missing


def test_every_subject_is_on_the_page() -> None:
    assert {name.split('.')[0] for name in named()} == SUBJECTS - {'cli'}


def test_the_drawing_is_readable_in_a_terminal() -> None:
    drawing = PAGE.split('```')[1]
    assert max(map(len, drawing.splitlines())) < 110
