# SPDX-License-Identifier: Apache-2.0
"""Was anything lost, twice or wrong where nodes were killed?"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.reader import read_session
from remaster_ros.session.yaml_records import from_plain
from remaster_ros.simulation.truth import SessionTruth

COUNTS = ('rows', 'planned_configurations', 'configurations', 'lost', 'twice', 'wrong')
LARGEST_ERROR_M = {'mocap': 0.3e-3, 'tracker': 0.15e-3}
"""Six standard deviations of what the fakes add; two configurations lie millimetres apart."""


def node_processes(parent: int) -> dict[str, int]:
    """Return the process of each node that the demo runs now."""
    found = {}
    for entry in Path('/proc').iterdir():
        if not entry.name.isdigit():
            continue
        try:
            ppid = int((entry / 'stat').read_text().rpartition(')')[2].split()[1])
            words = (entry / 'cmdline').read_bytes().split(b'\0')
        except OSError:
            continue
        if ppid == parent and b'remaster_ros.nodes' in words:
            found[words[words.index(b'remaster_ros.nodes') + 1].decode()] = int(entry.name)
    return found


def judge(out: Path, seen: set[str], truth: SessionTruth | None = None) -> dict[str, Any]:
    """Count what was lost, twice or wrong in the folder of a demo that has ended.

    `seen` are the rows that were ever on the disk; `truth` is what the demo opens at its very end.
    """
    folder = out / 'session'
    try:
        session = read_session(folder)
    except InputError as error:
        return {**dict.fromkeys(COUNTS, -1), 'exit_status': str(error)}
    m = session.measurements
    rows = (folder / 'observations.csv').read_text().splitlines()[1:]
    readings = Counter(zip(m.configuration.tolist(), m.sensor.tolist(), m.marker.tolist()))
    records = [r for r in read_journal(folder / 'journal.jsonl').records if 'rows' in r]
    decided = Counter((record['pose'], record['solution']) for record in records)
    result: dict[str, Any] = {
        'exit_status': session.exit_status,
        'rows': len(m),
        'planned_configurations': planned(read_journal(folder / 'plan.jsonl').records),
        'configurations': len(set(m.configuration.tolist())),
        'lost': len(seen - set(rows)),
        'twice': sum(n - 1 for n in readings.values()) + sum(n - 1 for n in decided.values()),
        'closest_rad': closest(m),
        'wrong': 0,
    }
    truth_path = out / 'truth.yaml'
    if truth is None and truth_path.exists():
        truth = from_plain(yaml.safe_load(truth_path.read_text()), SessionTruth)
    if truth is not None:
        result['wrong'] = wrong_pairs(session, truth)
    fit_path = out / 'fit' / 'fit.json'
    if fit_path.exists():
        fit = json.loads(fit_path.read_text())
        result['offsets'] = {
            row['joint']: (row['mean_deg'], row.get('std_if_exactly_drawn_deg', row['std_deg']))
            for row in fit['joint_offsets']
            if row['identifiable']
        }
    return result


def planned(records: list[dict[str, Any]]) -> int:
    """Return how many configurations the plan has, by its journal.

    Where it ended since enough was known: of poses to fit, those of the ones that were begun.
    """
    plans = [record for record in records if record['kind'] == 'tour'][-1]['plans']
    # Visits of the references are rows of their own, and none of the measurements.
    counts = {
        split: sum(len(pose['solutions']) for pose in plan['poses'])
        for split, plan in plans.items()
        if split != 'reference'
    }
    if any(record['kind'] == 'enough' for record in records):
        begun = {
            record['index']
            for record in records
            if record['kind'] == 'stop' and record['split'] == 'optimization'
        }
        poses = plans['optimization']['poses']
        counts['optimization'] = sum(len(poses[index]['solutions']) for index in begun)
    return sum(counts.values())


def closest(m: Any) -> float:
    """Return how near two configurations of one pose are, as one sensor saw them, rad."""
    nearest = np.inf
    for sensor in set(m.sensor.tolist()):
        for pose in set(m.pose.tolist()):
            mine = (m.sensor == sensor) & (m.pose == pose)
            # Markers of one frame are of one configuration.
            q = m.q[np.flatnonzero(mine)[np.unique(m.configuration[mine], return_index=True)[1]]]
            if len(q) > 1:
                distance = np.max(np.abs(q[:, None] - q), axis=-1) + 10.0 * np.eye(len(q))
                nearest = min(nearest, float(distance.min()))
    return nearest


def wrong_pairs(session: Any, truth: SessionTruth) -> int:
    """Count the rows whose marker is not where the truth has it at these joint positions."""
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    m, wrong = session.measurements, 0
    for index, marker in np.unique(np.stack((m.sensor, m.marker)), axis=1).T:
        mine, name = (m.sensor == index) & (m.marker == marker), session.sensor_names[index]
        expected = truth.without_noise(chain, name, m.q[mine], session.marker_names[marker])
        error = np.linalg.norm(m.position[mine] - expected, axis=1)
        wrong += int(np.sum(error > LARGEST_ERROR_M[name]))
    return wrong
