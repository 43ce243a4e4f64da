# SPDX-License-Identifier: Apache-2.0
"""The file of a hidden World: it appears complete, and holds each marker once."""

import numpy as np
import pytest

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import apply
from remaster_ros.session import files
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.setup import make_world
from remaster_ros.simulation.world import World


def test_a_process_that_waits_for_it_reads_all_of_it(tmp_path, monkeypatch):
    """A fake that is started first opens the file as soon as it exists."""
    replace, before = files.os.replace, []

    def look(temporary, final):
        with pytest.raises(InputError, match='no fake world here'):
            World.open(tmp_path)
        before.append(final)
        replace(temporary, final)
        World.open(tmp_path).close()

    monkeypatch.setattr(files.os, 'replace', look)
    make_world(tmp_path, read_cell('demo'), 1, 1.0).close()
    assert len(before) == 1


def test_two_sensors_measure_the_same_marker(tmp_path):
    cell = read_cell('demo')
    cell.sensors['tracker'].marker = cell.sensors['mocap'].marker
    world = make_world(tmp_path, cell, 1, 1.0)
    in_base = [
        apply(sensor.T_R_N, world.marker_in_sensor(name, 100.0))
        for name, sensor in world.truth.sensors.items()
    ]
    np.testing.assert_allclose(in_base[0], in_base[1], atol=1e-12)
    world.close()
