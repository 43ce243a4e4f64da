# SPDX-License-Identifier: Apache-2.0
"""A lock per node name and domain, which goes with its process."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

from remaster_ros.errors import InputError
from remaster_ros.nodes import runtime_files
from remaster_ros.nodes.opening_file import page_name
from remaster_ros.nodes.runtime_files import NameLock
from remaster_ros.simulation.setup import default_folder

HOLD = """
import sys, time
from remaster_ros.nodes.runtime_files import NameLock
lock = NameLock(233, '/test_locking')
print('held', flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder():
    process = subprocess.Popen([sys.executable, '-c', HOLD], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == 'held\n'
    yield process
    process.kill()
    process.communicate()


def test_the_second_is_refused_and_told_who_is_there(holder):
    with pytest.raises(InputError, match=f'/test_locking is running.*process {holder.pid}'):
        NameLock(233, '/test_locking', patience_s=0.1)
    for domain, name in ((232, '/test_locking'), (233, '/left/test_locking')):
        NameLock(domain, name, patience_s=0.1).release()


def test_a_killed_one_is_followed_at_once(holder):
    holder.send_signal(signal.SIGKILL)
    began = time.monotonic()
    NameLock(233, '/test_locking').release()
    assert time.monotonic() - began < runtime_files.PATIENCE_S


def test_one_that_is_stopped_still_counts(holder):
    """A process in SIGSTOP may go on at any time, and would command the arm again."""
    holder.send_signal(signal.SIGSTOP)
    with pytest.raises(InputError, match='running already'):
        NameLock(233, '/test_locking', patience_s=0.1)
    holder.send_signal(signal.SIGCONT)


def test_a_forked_child_does_not_keep_it():
    lock = NameLock(233, '/test_forking', patience_s=0.1)
    child = os.fork()
    if not child:
        time.sleep(30.0)
        os._exit(0)
    lock.release()
    try:
        NameLock(233, '/test_forking', patience_s=2.0).release()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_folder_of_somebody_else_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime_files, 'Path', lambda _: tmp_path)
    folder = tmp_path / f'remaster_ros_{os.getuid()}'
    folder.mkdir(mode=0o700)
    assert runtime_files.runtime_folder() == folder
    folder.chmod(0o755)
    with pytest.raises(InputError, match='open to other users'):
        runtime_files.runtime_folder()
    folder.rmdir()
    folder.symlink_to('/')
    with pytest.raises(InputError, match='belongs to another user'):
        runtime_files.runtime_folder()


def test_no_file_has_a_character_that_a_shell_or_a_page_takes_for_another():
    """Every node name has a file of its own: a dot is in none of them."""
    names = ['/watch', '/left/watch', '/left_watch', '/le/ft/watch']
    pages = [page_name(7, name) for name in names]
    assert len(set(pages)) == len(names)
    assert all(re.fullmatch(r'[A-Za-z0-9_.]+', page) for page in pages)
    lock = NameLock(233, '/left/test_naming')
    assert re.fullmatch(r'[A-Za-z0-9_.]+', lock.path.name)
    lock.release()
    folder = default_folder('/left/cell')
    assert re.fullmatch(r'[A-Za-z0-9_.]+', folder.name)
    assert folder != default_folder('/left_cell')
