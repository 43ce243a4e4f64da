# SPDX-License-Identifier: Apache-2.0
"""Whose collection is still under way: this boot, a clock that nobody sets."""

import os
import time

import pytest

from remaster_ros.nodes import runtime_files
from remaster_ros.nodes.planner import living_run
from remaster_ros.nodes.planner.living_run import LivingRun, new_token, silence_s


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime_files, 'Path', lambda _: tmp_path)
    return tmp_path / f'remaster_ros_{os.getuid()}'


def test_the_silence_is_counted_from_the_last_sign(monkeypatch):
    run = LivingRun(new_token())
    assert 0.0 <= silence_s(run.token) < 0.5
    now = living_run.since_boot_s()
    monkeypatch.setattr(living_run, 'since_boot_s', lambda: now + 20.0)
    assert silence_s(run.token) == pytest.approx(20.0, abs=0.5)
    again = LivingRun(run.token)
    assert again.token == run.token
    assert silence_s(run.token) < 0.5
    # From a later time than now: nothing that this boot can have written.
    monkeypatch.setattr(living_run, 'since_boot_s', lambda: now)
    assert silence_s(run.token) is None


def test_another_boot_and_an_ended_run_are_not_gone_on_with(monkeypatch):
    run = LivingRun(new_token())
    monkeypatch.setattr(living_run, 'boot_id', lambda: 'another')
    assert silence_s(run.token) is None
    monkeypatch.undo()


def test_an_ended_or_unknown_run_has_no_silence():
    run = LivingRun(new_token())
    run.end()
    run.end()
    assert silence_s(run.token) is None
    assert silence_s('') is None
    assert silence_s('../../etc/passwd') is None


def test_the_date_of_the_file_says_nothing(folder):
    run = LivingRun(new_token())
    path = folder / f'run_{run.token}'
    for then in (0.0, time.time() + 1e6):
        os.utime(path, (then, then))
        assert silence_s(run.token) < 1.0


def test_a_sign_that_is_damaged_is_none(folder):
    run = LivingRun(new_token())
    for text in ('', 'x', f'{living_run.boot_id()} soon'):
        (folder / f'run_{run.token}').write_text(text)
        assert silence_s(run.token) is None
