# SPDX-License-Identifier: Apache-2.0
"""The fakes meet in a folder of the temporary directory, where anybody may have been before."""

import os
import stat

import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation import setup
from remaster_ros.simulation.setup import (
    default_folder,
    make_private_folder,
    make_world,
    open_world,
    require_private,
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the fakes would meet, in a temporary directory of this test."""
    monkeypatch.setattr(setup.tempfile, 'tempdir', str(tmp_path))
    return default_folder()


def test_it_is_for_this_user_alone(folder):
    before = os.umask(0)
    try:
        make_private_folder(folder)
        assert stat.S_IMODE(folder.lstat().st_mode) == 0o700
        make_world(folder / 'below', read_cell('demo'), 1, 1.0)
        assert stat.S_IMODE((folder / 'below').lstat().st_mode) == 0o700
    finally:
        os.umask(before)
    make_private_folder(folder)
    make_world(folder, read_cell('demo'), 1, 1.0)
    assert open_world('', timeout_s=0.0).folder == folder


def test_a_link_is_not_followed(folder, tmp_path):
    victim = tmp_path / 'home'
    victim.mkdir(mode=0o700)
    folder.symlink_to(victim)
    with pytest.raises(InputError, match='is a link, which is not followed'):
        make_private_folder(folder)
    make_world(victim, read_cell('demo'), 1, 1.0)
    with pytest.raises(InputError, match='is a link, which is not followed'):
        open_world('', timeout_s=0.0)


def test_a_link_to_nowhere_is_not_followed(folder, tmp_path):
    folder.symlink_to(tmp_path / 'nowhere')
    with pytest.raises(InputError, match='is a link'):
        make_private_folder(folder)
    with pytest.raises(InputError, match='is a link'):
        open_world('', timeout_s=0.0)
    assert not (tmp_path / 'nowhere').exists()


def test_the_folder_of_another_user_is_refused(folder, monkeypatch):
    folder.mkdir(mode=0o700)
    make_world(folder, read_cell('demo'), 1, 1.0)
    monkeypatch.setattr(setup.os, 'getuid', lambda: folder.lstat().st_uid + 1)
    with pytest.raises(InputError, match='belongs to the user number'):
        require_private(folder)


@pytest.mark.parametrize('mode', [0o755, 0o770, 0o777, 0o702, 0o1777])
def test_a_folder_that_is_open_to_others_is_refused(folder, mode):
    folder.mkdir()
    folder.chmod(mode)
    make_world(folder, read_cell('demo'), 1, 1.0)
    for use in (lambda: make_private_folder(folder), lambda: open_world('', timeout_s=0.0)):
        with pytest.raises(InputError, match=f'mode {mode:o} instead of 700'):
            use()


def test_a_file_in_its_place_is_refused(folder):
    folder.write_text('')
    with pytest.raises(InputError, match='is no folder'):
        make_private_folder(folder)
