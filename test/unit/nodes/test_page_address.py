# SPDX-License-Identifier: Apache-2.0
"""The file that leads to the live page is for this user alone."""

from __future__ import annotations

import pytest

from remaster_ros.nodes.opening_file import opening_file, opening_path, page_name


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr('remaster_ros.nodes.opening_file.runtime_folder', lambda: tmp_path)
    return tmp_path


def test_the_file_that_leads_to_the_page(folder):
    # What somebody else has put there is not written to.
    (folder / 'elsewhere').write_text('mine')
    (folder / 'page.html').symlink_to(folder / 'elsewhere')
    path = opening_file('page', 'http://127.0.0.1:1/#token=abc')
    assert path == opening_path('page')
    assert 'url=http://127.0.0.1:1/#token=abc"' in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    assert not path.is_symlink()
    assert (folder / 'elsewhere').read_text() == 'mine'


def test_cells_have_names_of_their_own():
    names = {page_name(d, n) for d in (1, 2) for n in ('/watch', '/left/watch')}
    assert len(names) == 4
    assert not any('/' in name for name in names)
