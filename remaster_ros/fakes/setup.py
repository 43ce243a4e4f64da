"""Draw a hidden World around a cell, and find the one of this DDS domain."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from remaster_ros.core.errors import InputError
from remaster_ros.fakes.world import Truth, World
from remaster_ros.storage.cell import Cell, config_path


def default_folder() -> Path:
    """Where the fakes of this user and DDS domain meet when nobody says otherwise."""
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    return Path(tempfile.gettempdir()) / f'remaster_world_{os.getuid()}_{domain}'


def make_world(folder: Path, cell: Cell, seed: int, rate: float) -> World:
    """Draw a hidden World for a cell; its time begins now.

    Parameters
    ----------
    folder
        Where to put it; a World that is there is replaced.
    cell
        The arm, the markers and the names of the sensors; where the sensors really stand, and how
        far the arm is off, comes from config/fake_world.yaml and the seed.
    seed
        Of everything drawn.
    rate
        World time over wall time.
    """
    settings = yaml.safe_load(config_path('fake_world.yaml').read_text())
    chain = cell.chain()
    missing = sorted(set(cell.sensors) - set(settings['sensors']))
    if missing:
        raise InputError(f'fake_world.yaml places no sensor {", ".join(missing)}')
    start_q = np.deg2rad(settings['start_q_deg'])
    truth = Truth.draw(
        seed,
        len(chain),
        {name: np.array(cell.markers[s.marker]) for name, s in cell.sensors.items()},
        cell.marker_std_m,
        {name: settings['sensors'][name] for name in cell.sensors},
        np.deg2rad(settings['offset_std_deg']),
    )
    return World.create(
        folder,
        truth,
        urdf=cell.urdf_text,
        base_link=cell.robot.base_link,
        tip_link=cell.robot.tip_link,
        rate=rate,
        start_q=start_q[: len(chain)],
        link_radius_m=cell.link_radius_m,
    )


def open_world(folder: str, timeout_s: float = 20.0) -> World:
    """Open the World in `folder` ('' for the default one), waiting until somebody has made it.

    Raises
    ------
    InputError
        If there is none after `timeout_s` of wall time.
    """
    path = Path(folder) if folder else default_folder()
    deadline = time.monotonic() + timeout_s
    while not (path / 'world.yaml').exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return World.open(path)
