# SPDX-License-Identifier: Apache-2.0
"""Simulated power cuts in the life of a session; CRASH_STATES=12000 tries more.

What a crash may leave is in test/faults/crash_states.py, what must hold then in session_crashes.py
beside it.
"""

import logging
import os
import random
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from faults.session_crashes import check, live, yaml_read_once

SHARED_MEMORY = Path('/dev/shm')


@pytest.fixture
def quick_folder(tmp_path):
    """Return a folder in memory where there is one: syncing is not what is tested here."""
    if not SHARED_MEMORY.is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY) as folder:
        yield Path(folder)


MANY = int(os.environ.get('CRASH_STATES', '1000'))


@pytest.mark.timeout(600 + MANY // 4)
@pytest.mark.parametrize(
    ('states', 'times'), [(200, 1), pytest.param(MANY, 2, marks=pytest.mark.qualify)]
)
def test_no_crash_loses_what_was_acknowledged(states, times, quick_folder, caplog):
    caplog.set_level(logging.CRITICAL, 'remaster_ros')
    found: Counter[str] = Counter()
    seed = 0
    with yaml_read_once():
        while found.total() < states:
            (quick_folder / f'life_{seed}').mkdir()
            life = live(quick_folder / f'life_{seed}', seed)
            # Every boundary of an operation, each time with other fates of what was not synced.
            for cut in [*range(len(life.operations) + 1)] * times:
                folder = quick_folder / 'crash'
                folder.mkdir()
                chooser = random.Random(f'{seed} {cut} {found.total()}')
                print(f'seed {seed}, cut {cut}, state {found.total()}')
                found[check(life, cut, chooser, folder)] += 1
                shutil.rmtree(folder)
            seed += 1
    # The states are worth something: sessions not yet there, torn lines, and most just whole.
    assert found['nothing'] > states / 20
    assert found['dropped'] > states / 100
    assert found['whole'] > states / 2
