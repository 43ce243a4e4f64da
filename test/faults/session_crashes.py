# SPDX-License-Identifier: Apache-2.0
"""The life of a session as its recorder writes it, and what must hold after a crash anywhere."""

from __future__ import annotations

import copy
import random
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from faults.crash_states import Operation, Recorder, crash_state, materialise

from remaster_ros.errors import InputError
from remaster_ros.session.records import session_yaml
from remaster_ros.session.records.journal import Journal
from remaster_ros.session.records.reader import PLAN, read_session
from remaster_ros.session.records.session_writer import SessionWriter
from remaster_ros.session.recovery import recover_session
from remaster_ros.session.strict_yaml import load_yaml
from remaster_ros.types import Correction, Measurements, Observation, Session

JOINT = """<joint name="joint_{n}" type="revolute">
  <parent link="{parent}"/><child link="{child}"/>
  <origin xyz="0 0 0.3" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>
  <limit lower="-3" upper="3" effort="10" velocity="2"/></joint>"""
URDF = ''.join(
    (
        '<robot name="two_joints"><link name="base"/><link name="arm"/><link name="tool"/>',
        JOINT.format(n=1, parent='base', child='arm', roll=0),
        JOINT.format(n=2, parent='arm', child='tool', roll=1.5),
        '</robot>',
    )
)
SENSORS = {'mocap': 'kügelchen', 'tracker': 'smr'}


@contextmanager
def yaml_read_once():
    """Read equal texts of session.yaml once: it is most of the time that a check takes."""
    known = {}

    def load(text):
        if text not in known:
            known[text] = load_yaml(text)
        return copy.deepcopy(known[text])

    session_yaml.load_yaml = load
    try:
        yield
    finally:
        session_yaml.load_yaml = load_yaml


class Life(NamedTuple):
    """What was done to the files of a session, and what its writer promised when.

    `marks` are (operations done, observations acknowledged, exit status acknowledged).
    """

    operations: list[Operation]
    marks: list[tuple[int, tuple[int, str]]]
    groups: list[list[Observation]]

    @property
    def observations(self) -> list[Observation]:
        """All rows in their order."""
        return [observation for group in self.groups for observation in group]


CORRECTION = Correction('robot_bridge', 'ab12')


def session_header() -> Session:
    return Session(
        urdf=URDF,
        base_link='base',
        tip_link='tool',
        markers={name: np.array([0.1, 0.0, 0.02]) for name in SENSORS.values()},
        sensors=SENSORS,
        measurements=Measurements.empty(2),
        created='2026-01-01T00:00:00+00:00',
    )


def make_observations(seed: int, configurations: int) -> list[list[Observation]]:
    """Return the rows of each configuration: of both sensors, or now and then of one."""
    rng = np.random.default_rng(seed)
    groups, number, stamp = [], 0, 100.0
    for configuration in range(configurations):
        group = []
        for sensor, marker in SENSORS.items():
            if sensor == 'tracker' and rng.random() < 0.2:
                continue
            stamp += rng.uniform(0.1, 5.0)
            group.append(
                Observation(
                    observation=number,
                    pose=configuration // 2,
                    configuration=configuration,
                    split='validation' if configuration // 2 % 2 else 'optimization',
                    stamp_s=stamp,
                    sensor=sensor,
                    marker=marker,
                    q=rng.uniform(-2, 2, 2),
                    position=rng.normal(size=3),
                    from_q=rng.uniform(-2, 2, 2) if rng.random() < 0.8 else None,
                    samples=1,
                    wanted=rng.uniform(-2, 2, 2) if seed % 2 == 0 else None,
                    correction=bool(configuration % 3) if seed % 2 == 0 else None,
                )
            )
            number += 1
        groups.append(group)
    return groups


def live(root: Path, seed: int, configurations: int = 8) -> Life:
    """Record a session: interrupted by kills, once stopped and gone on with, then completed."""
    chooser = random.Random(seed)
    groups = make_observations(seed, configurations)
    recorder = Recorder(root)
    done, status = 0, ''

    def mark():
        recorder.mark((done, status))

    with recorder.recording():
        writer = SessionWriter(root / 'new' / 'session', session_header(), resume=True)
        plan = Journal(root / 'new' / 'session' / PLAN)
        status = 'aborted'
        mark()
        if seed % 2 == 0:
            writer.correct(CORRECTION)
        for number, group in enumerate(groups):
            if chooser.random() < 0.4:
                plan.append({'kind': 'pose', 'pose': number, 'name': 'größer'})
            if chooser.random() < 0.3:
                writer.record({'kind': 'rejected', 'configuration': number})
            writer.record({'kind': 'configuration', 'number': number}, group)
            done += len(group)
            mark()
            fate = chooser.random()
            if fate < 0.15:
                writer.close('stopped')
                status = 'stopped'
                mark()
            if fate < 0.3:
                writer.release()
                plan.close()
                writer = SessionWriter(root / 'new' / 'session', session_header(), resume=True)
                plan = Journal(root / 'new' / 'session' / PLAN)
                status = 'aborted'
                mark()
        writer.close('complete')
        status = 'complete'
        mark()
        plan.close()
    return Life(recorder.operations, recorder.marks, groups)


def check(life: Life, cut: int, chooser: random.Random, folder: Path) -> str:
    """Crash after `cut` operations, recover, and hold the session to what was promised.

    Returns a word for what was found: ``nothing``, ``whole`` or ``dropped``.
    """
    before = [promise for at, promise in life.marks if at <= cut]
    after = [promise for at, promise in life.marks if at > cut]
    acknowledged, status = before[-1] if before else (0, '')
    possible = after[0][0] if after else acknowledged
    statuses = {status, after[0][1], 'aborted'} if after else {status}

    def compare_now():
        compare(session, life, range(acknowledged, possible + 1), statuses)

    materialise(crash_state(life.operations[:cut], chooser), folder)
    session = folder / 'new' / 'session'
    if not (session / 'session.yaml').exists():
        assert not acknowledged, 'the session is gone'
        return 'nothing'

    # It can be read as it is, before any recovery.
    if acknowledged:
        compare_now()
    again = chooser.random()
    if (session / 'journal.jsonl').exists() and again < 0.7:
        if again < 0.35:
            crash_in_recovery(folder, chooser)
        recovery = recover_session(session)
        if acknowledged:
            compare_now()
        files = snapshot(session)
        second = recover_session(session)
        assert not second.finished
        assert not second.lost
        assert snapshot(session) == files, 'a second recovery changed something'
        found = 'dropped' if recovery.lost else 'whole'
    else:
        found = 'whole'
    go_on(session, life, acknowledged, possible)
    return found


def crash_in_recovery(folder: Path, chooser: random.Random):
    """Recover, but let the power fail in the middle of that."""
    recorder = Recorder(folder)
    begun = len(recorder.operations)
    with recorder.recording():
        recover_session(folder / 'new' / 'session')
    cut = chooser.randint(begun, len(recorder.operations))
    state = crash_state(recorder.operations[:cut], chooser)
    shutil.rmtree(folder)
    materialise(state, folder)


def go_on(session: Path, life: Life, acknowledged: int, possible: int):
    """Resume and finish the session; every observation is in it, once."""
    try:
        writer = SessionWriter(session, session_header(), resume=True)
    except InputError:
        assert read_session(session).exit_status == 'complete'
        assert acknowledged == possible == len(life.observations)
        return
    assert acknowledged <= writer.observations <= possible
    if life.observations[0].wanted is not None:
        assert writer.correction in ((CORRECTION,) if acknowledged else (None, CORRECTION))
        writer.correct(CORRECTION)
    # All rows of a configuration are there, or none is.
    numbers = [record['number'] for record in writer.records if record['kind'] == 'configuration']
    assert numbers == list(range(len(numbers)))
    assert writer.observations == sum(map(len, life.groups[: len(numbers)]))
    for number, group in enumerate(life.groups[len(numbers) :], start=len(numbers)):
        writer.record({'kind': 'configuration', 'number': number}, group)
    writer.close('complete')
    total = len(life.observations)
    compare(session, life, range(total, total + 1), {'complete'})


def compare(session: Path, life: Life, counts: range, statuses: set[str]):
    """The session has the first so many observations to the last bit, and nothing else."""
    read = read_session(session)
    m = read.measurements
    assert len(m) in counts
    assert read.exit_status in statuses
    for i, wanted in enumerate(life.observations[: len(m)]):
        assert m.observation[i] == wanted.observation
        assert m.configuration[i] == wanted.configuration
        assert m.stamp_s[i] == wanted.stamp_s
        assert (m.q[i] == wanted.q).all()
        assert (m.position[i] == wanted.position).all()
        if wanted.wanted is not None:
            assert read.correction == CORRECTION
            assert (m.wanted[i] == wanted.wanted).all()
            assert m.correction[i] == wanted.correction


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob('*') if p.is_file()}
