# SPDX-License-Identifier: Apache-2.0
"""A sensor is bumped in mid-run: the references tell it, by name and size, and the arm stands."""

import csv
import re

import numpy as np
import pytest
from rigs.collection_rig import Cell
from rigs.ros_rig import call

from remaster_ros.collection.events import SetupChanged
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.faults import inject

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(400)]

BUMP_M = 2e-3


def rounds(cell):
    return int(cell.recorder('reference_rounds') or 0)


def test_a_bumped_sensor_is_named_and_pauses_the_collection(start, client, tmp_path):
    sensors = ['mocap', 'tracker']
    cell = Cell(start, client, tmp_path, 'all', sensors, candidates=9, reference_every=6)
    cell.until(lambda: rounds(cell) == 3, 'three rounds of the references', 200)
    reading = lambda: cell.said['pose_planner']  # noqa: E731
    # The third is over when something else is measured.
    done = int(reading()['configurations_done'])
    cell.until(lambda: int(reading()['configurations_done']) > done, 'another configuration')
    assert cell.recorder('changed') == ''
    inject(cell.world.folder, {'tracker': {'bumped': BUMP_M}})
    found = lambda: [e for e in cell.events if isinstance(e, SetupChanged)]  # noqa: E731
    cell.until(found, 'the change', 200)
    event = found()[0]
    print(event.text)
    assert event.stops
    assert event.text.startswith('tracker was moved between configurations')
    size = re.search(r'off by up to ([\d.]+) mm', event.text)
    assert size is not None
    assert float(size[1]) == pytest.approx(1e3 * BUMP_M, rel=0.25)
    cell.until(lambda: reading()['state'] == 'paused', 'the pause', 10)
    assert cell.messages['pose_planner'] == event.text
    assert event.text in cell.recorder('changed')

    # Nobody has looked: it stays so, also with another recorder.
    recorded = cell.recorder('observations')
    cell.kill_and_start('recorder')
    cell.said.pop('recorder')
    cell.until(lambda: cell.recorder('changed'), 'the recorder that was started again')
    assert cell.recorder('changed') == event.text
    assert (reading()['state'], cell.recorder('observations')) == ('paused', recorded)

    # It must have learned that the planner is paused: what runs after that is a person's word.
    cell.until(lambda: cell.recorder('changed_run') not in ('', 'unknown'), 'the paused planner')
    before = rounds(cell)
    cell.until(lambda: cell.said['pose_planner']['state'] == 'paused', 'the planner')
    assert call(client, '/remaster/collect').success
    cell.until(lambda: cell.recorder('changed') == '', 'that a person has looked', 20)
    cell.until(lambda: rounds(cell) == before + 1, 'a new beginning')
    cell.until(lambda: cell.recorder('exit_status') == 'complete', 'the end', 200)
    session = read_session(cell.session)
    assert len(found()) == 1, 'what was seen to is not said again'

    with (cell.session / 'observations.csv').open() as file:
        rows = list(csv.DictReader(file))
    of_references = [row for row in rows if row['split'] == 'reference']
    assert len(session.references) == len(of_references) > 0
    assert len(session.measurements) == len(rows) - len(of_references)
    assert not set(session.measurements.configuration) & set(session.references.configuration)
    planned = int(reading()['configurations'])
    assert int(reading()['configurations_done']) == planned
    assert len(np.unique(session.measurements.configuration)) == planned
    kinds = [record['kind'] for record in read_journal(cell.session / 'journal.jsonl').records]
    assert kinds.count('accepted') == 1
