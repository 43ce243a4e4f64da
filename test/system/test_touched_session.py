# SPDX-License-Identifier: Apache-2.0
"""The session is edited, renamed or removed while real nodes write it: noticed within seconds."""

import shutil
import subprocess
import time

import pytest
from rigs.collection_rig import Cell

from remaster_ros.session.records.reader import read_session

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

SOON_S = 10
"""A few seconds, on a busy machine."""


def begun(start, client, tmp_path):
    """Return a cell whose recorder has written a few rows of many more than the edits last."""
    cell = Cell(start, client, tmp_path, 'mocap', ['mocap'], candidates=5)
    cell.until(lambda: int(cell.recorder('observations') or 0) > 2, 'the first observations')
    return cell


def rows(cell):
    return (cell.session / 'observations.csv').read_bytes().count(b'\n') - 1


def test_what_an_editor_did_is_undone_and_a_renamed_folder_holds_the_arm(start, client, tmp_path):
    """20 of 94 rows were sealed as complete after `sed -i`, and a flipped digit was sealed."""
    cell = begun(start, client, tmp_path)
    path = cell.session / 'observations.csv'

    subprocess.run(['sed', '-i', '3,$d', str(path)], check=True)
    cell.until(lambda: 'replaced by another file' in cell.recorder('restored'), 'sed', SOON_S)
    cell.until(lambda: rows(cell) >= int(cell.recorder('observations')), 'the rows', SOON_S)
    assert rows(cell) > 2

    with path.open('r+b') as file:
        data = file.read()
        place = data.rfind(b',0.') + 3
        file.seek(place)
        file.write(b'8' if data[place : place + 1] != b'8' else b'7')
    cell.until(lambda: 'was changed' in cell.recorder('restored'), 'the digit', SOON_S)
    assert path.read_bytes().startswith(data)

    cell.session.rename(tmp_path / 'elsewhere')
    cell.until(lambda: 'put it back' in cell.recorder('waiting_for'), 'the folder', SOON_S)
    message = f'waiting for {cell.recorder("waiting_for")}'
    cell.until(lambda: cell.messages['robot_bridge'] == message, 'the bridge', SOON_S)
    acknowledged = len(cell.results)
    time.sleep(2.0)
    assert len(cell.results) == acknowledged
    assert not cell.session.exists()
    (tmp_path / 'elsewhere').rename(cell.session)
    cell.until(lambda: len(cell.results) > acknowledged, 'the next configuration')

    session = cell.complete()
    cell.check(session)
    assert len(session.measurements) == int(cell.recorder('observations'))


@pytest.mark.qualify
def test_a_removed_folder_is_reported_and_its_observations_are_restored(start, client, tmp_path):
    cell = begun(start, client, tmp_path)
    shutil.rmtree(cell.session)
    cell.until(lambda: 'folder was removed' in cell.messages['recorder'], 'the reason', SOON_S)
    assert len(read_session(cell.session).measurements) > 2
    cell.until(lambda: cell.recorder('exit_status'), 'the end')
    assert cell.recorder('exit_status') == 'aborted', 'the bag and the plan are lost'
    session = read_session(cell.session)
    assert session.exit_status == 'aborted'
    assert len(session.measurements) == int(cell.recorder('observations'))
