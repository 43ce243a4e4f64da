# SPDX-License-Identifier: Apache-2.0
"""World time on a clock that the test moves on: it runs at its rate, and waits for who is late."""

import os
import signal
import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from worlds.optitrack_world import SENSOR, MarkerWorld

from remaster_ros.simulation import world_clock
from remaster_ros.simulation import world_pace as pace_module
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.world_clock import HELD_WALL_S, WorldClock
from remaster_ros.simulation.world_pace import (
    AHEAD_S,
    AHEAD_WALL_S,
    LEAD_AHEAD_S,
    LEAD_PATIENCE_WALL_S,
    PATIENCE_WALL_S,
    Pace,
)

START_S, RATE, ME = 1000.0, 10.0, os.getpid()
AHEAD = AHEAD_S + AHEAD_WALL_S * RATE
TICK_WALL_S = 0.002


class Scene:
    """A World's clock, its owner, and wall time."""

    def __init__(self, monkeypatch, folder):
        self.wall = 50.0
        sleep = partial(self.run, taken=True)
        time = SimpleNamespace(monotonic=lambda: self.wall, sleep=sleep)
        for module in (world_clock, pace_module):
            monkeypatch.setattr(module, 'time', time)
        WorldClock.create(folder, START_S, self.wall)
        self.clock, self.other = WorldClock(folder, RATE), WorldClock(folder, RATE)
        self.pace = Pace(self.clock)

    def run(self, wall_s, taken=False, fake=False, tick_s=TICK_WALL_S):
        """Let wall time pass while the owner works; others take reports and keep up, or not."""
        until = self.wall + wall_s
        while self.wall < until - 1e-9:
            self.wall += tick_s
            now = self.clock.now()
            self.pace.published(now)
            if taken:
                self.pace.took(ME, now)
            if fake:
                self.other.kept_up(0, now)
            self.pace.go_on()

    def passed(self):
        return self.other.now() - START_S


@pytest.fixture
def scene(monkeypatch, tmp_path):
    return Scene(monkeypatch, tmp_path)


def test_it_runs_at_its_rate_where_all_keep_up(scene):
    scene.run(2.0, taken=True, fake=True)
    assert scene.passed() == pytest.approx(2.0 * RATE, abs=RATE * TICK_WALL_S)
    until = scene.other.now() + 0.5
    scene.other.sleep_until(until)
    assert until <= scene.other.now() < until + RATE * 2 * TICK_WALL_S


@pytest.mark.parametrize('late', ['taken', 'fake'])
def test_it_stands_until_the_slowest_has_kept_up(scene, late):
    """A node that takes no reports, and a fake sensor that does not get on."""
    everybody = {'taken': True, 'fake': True}
    scene.run(1.0, **everybody)
    before = scene.passed()
    scene.run(5.0, **(everybody | {late: False}))
    assert 0.0 < scene.passed() - before <= AHEAD + RATE * TICK_WALL_S
    stood = scene.passed()
    scene.run(1.0, **everybody)
    # No jump: what was not lived through is not made up for.
    assert scene.passed() - stood == pytest.approx(RATE, abs=AHEAD + 2 * RATE * TICK_WALL_S)


@pytest.mark.parametrize('rate_hz', [30.0, 0.5 / AHEAD])
def test_a_bar_that_is_held_up_anywhere_gets_to_its_next_frame(scene, monkeypatch, rate_hz):
    """Time that waited for a frame that is not due, or comes behind the limit, stands for ever."""
    world, sent, rng = MarkerWorld(), [], np.random.default_rng(5)

    def now():
        t = scene.other.now()
        # Another process has the processor, and the owner works.
        scene.run(rng.uniform(0.0, 0.3), taken=True)
        return t

    def sleep_until(t):
        before = scene.wall
        scene.other.sleep_until(t)
        assert scene.wall - before < 1.0

    world.now, world.sleep_until = now, sleep_until
    world.kept_up = lambda sensor, t: scene.other.kept_up(0, t)

    def distribute(server, frame):
        sent.append(frame)
        if len(sent) == 30:
            server._closing.set()

    monkeypatch.setattr(FakeOptiTrackServer, '_distribute', distribute)
    FakeOptiTrackServer(world, SENSOR, rng, rate_hz=rate_hz)._stream()
    # None is left out once the World waits, and each is as it was when it was due.
    later = sent[1:]
    assert np.all(np.diff([frame.number for frame in later]) == 1)
    steps = np.diff([frame.timestamp for frame in later])
    np.testing.assert_allclose(steps, 1.0 / rate_hz, rtol=1e-6)


def test_it_waits_for_a_node_that_takes_no_reports(scene):
    """The node of a sensor notes until when it has taken all frames."""
    scene.run(0.2, taken=True)
    begun = scene.clock.now()
    scene.pace.took(os.getppid(), begun)
    scene.run(5.0, taken=True)
    assert scene.clock.now() - begun <= AHEAD + RATE * TICK_WALL_S
    # A clock that is ahead is none to wait for, and does not let the World run away.
    scene.pace.took(os.getppid(), begun + 1e6)
    before = scene.clock.now()
    scene.run(5.0, taken=True)
    assert scene.clock.now() - before <= AHEAD + RATE * TICK_WALL_S


def test_it_waits_for_each_report_that_who_leads_the_arm_has_not_taken(scene):
    """The next piece of a move comes by it; else the arm would stop on its way."""
    scene.pace = Pace(scene.clock, 0.1)
    scene.pace.took(ME, scene.clock.now(), leads=True)
    begun = scene.clock.now()
    scene.run(5.0)
    assert scene.clock.now() - begun <= LEAD_AHEAD_S + 2 * RATE * TICK_WALL_S
    # One that keeps up is no slower for it.
    before = scene.clock.now()
    for _ in range(500):
        scene.wall += TICK_WALL_S
        now = scene.clock.now()
        scene.pace.published(now)
        scene.pace.took(ME, now, leads=True)
        scene.pace.go_on()
    assert scene.clock.now() - before > 0.95 * RATE
    # One that gives no sign for long is waited for as others are.
    scene.run(LEAD_PATIENCE_WALL_S + 1.0)
    stood = scene.clock.now()
    scene.run(1.0)
    assert scene.clock.now() - stood <= AHEAD


def test_who_leads_the_arm_and_is_killed_is_not_waited_for(scene):
    process = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])
    try:
        scene.pace.published(scene.clock.now())
        scene.pace.took(process.pid, scene.clock.now(), leads=True)
        scene.run(1.0)
        assert scene.passed() <= LEAD_AHEAD_S + 2 * RATE * TICK_WALL_S
    finally:
        process.kill()
        process.wait()
    before = scene.passed()
    scene.run(1.0)
    assert scene.passed() - before > 0.8 * RATE


def test_a_robot_that_falls_silent_holds_nobody_up(scene):
    """The last reports are never confirmed: what was taken is said ten times a second at most."""
    scene.pace = Pace(scene.clock, 0.1)
    scene.run(0.1, taken=True)
    scene.pace.published(scene.clock.now())
    before = scene.clock.now()
    for _ in range(500):
        scene.wall += TICK_WALL_S
        scene.pace.go_on()
    assert scene.clock.now() - before > 0.9 * RATE


def test_a_process_that_does_nothing_for_long_is_not_waited_for(scene):
    scene.run(0.1, taken=True)
    scene.run(PATIENCE_WALL_S + 5.0, tick_s=10 * TICK_WALL_S)
    assert scene.passed() > 3.0 * RATE


def test_a_killed_or_paused_process_is_a_fault_and_not_waited_for(scene):
    process = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])
    try:
        scene.pace.published(scene.clock.now())
        scene.pace.took(process.pid, scene.clock.now())
        scene.run(1.0)
        assert scene.passed() <= AHEAD + RATE * TICK_WALL_S
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        before = scene.passed()
        scene.run(1.0)
        assert scene.passed() - before > 0.8 * RATE
    finally:
        process.kill()
        process.wait()
    assert not world_clock.is_running(process.pid)


def test_it_goes_on_where_the_owner_is_gone_and_never_back(scene):
    scene.run(0.1, taken=True)
    scene.run(1.0)
    stood, last = scene.passed(), 0.0
    for _ in range(1000):
        scene.wall += HELD_WALL_S / 250
        assert scene.passed() >= last
        last = scene.passed()
    assert last - stood == pytest.approx(3 * HELD_WALL_S * RATE, abs=0.1 * RATE)
