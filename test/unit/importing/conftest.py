# SPDX-License-Identifier: Apache-2.0
"""A table becomes a session, by the command."""

import pytest
from rigs.command_line import remaster

from remaster_ros.session.records.reader import read_session


@pytest.fixture
def imported(tmp_path):
    """Return a function that imports files for an arm, to what was printed and the session."""

    def run(urdf, *args, status=0):
        path = tmp_path / 'robot.urdf'
        path.write_text(urdf)
        out = tmp_path / f'session{len(list(tmp_path.glob("session*")))}'
        printed = remaster('import', *args, '--urdf', path, '--out', out, status=status)
        assert out.is_dir() == (status == 0)
        return printed, read_session(out) if status == 0 else None

    return run
