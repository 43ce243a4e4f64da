# SPDX-License-Identifier: Apache-2.0
"""Random hidden World for a cell, and the World of this DDS domain."""

from __future__ import annotations

import os
import stat
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.cells.workcell import Workcell, config_path
from remaster_ros.simulation.chain_arm import model_of_tour
from remaster_ros.simulation.dynamics import Dynamics
from remaster_ros.simulation.effect_sampling import EffectSpec, with_effects
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor, Warming, place_sensor
from remaster_ros.simulation.world import START_S, WORLD_FILE, World, WorldContent
from remaster_ros.types import FloatArray

PRACTICE_CANDIDATES = 14
PLACEMENT_STD_M = 0.03
"""Standard deviation of a fake sensor's position from that in config/fake_world.yaml, m."""


def default_folder(namespace: str = '/') -> Path:
    """Folder of the World of this user, DDS domain and ROS namespace; it is not made.

    In the temporary directory; the domain is ROS_DOMAIN_ID, 0 if unset. ``namespace``: such as
    ``/left``; every cell of a domain has its own World.
    """
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    cell = namespace.rstrip('/').replace('/', '.')
    return Path(tempfile.gettempdir()) / f'remaster_world_{os.getuid()}_{domain}{cell}'


def make_private_folder(folder: Path) -> None:
    """Make a folder that only this user may read, or use an existing one.

    The name can be guessed and the temporary directory is open to all: another user may have put a
    folder or a link there, through which files elsewhere would be overwritten. Raises InputError
    if something else has this name; see `require_private`.
    """
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        require_private(folder)
    except OSError as error:
        raise InputError(
            f'{folder}: the folder of the fakes cannot be made ({error.strerror}); set TMPDIR to '
            f'a folder you may write to'
        ) from None


def require_private(folder: Path) -> None:
    """Raise InputError unless the path is a folder, no link, private to this user (mode 700)."""
    try:
        found = folder.lstat()
    except OSError as error:
        raise InputError(f'{folder}: cannot be looked at ({error.strerror})') from None
    mode = stat.S_IMODE(found.st_mode)
    if stat.S_ISLNK(found.st_mode):
        wrong = 'is a link, which is not followed'
    elif not stat.S_ISDIR(found.st_mode):
        wrong = 'is no folder'
    elif found.st_uid != os.getuid():
        wrong = f'belongs to the user number {found.st_uid}'
    elif mode & 0o077:
        wrong = f'is open to other users (mode {mode:o} instead of 700)'
    else:
        return
    raise InputError(
        f'{folder}: {wrong}; the fakes meet in a folder of their user alone: remove it, or set '
        f'TMPDIR or the parameter world'
    )


def make_world(
    folder: Path,
    cell: Workcell,
    seed: int,
    rate: float,
    hidden: Sequence[EffectSpec] = (),
    candidates: int = PRACTICE_CANDIDATES,
    dynamics: float = 0.0,
) -> World:
    """Make a random hidden World for a cell, and write its folder; its time begins now.

    Parameters
    ----------
    folder
        Folder of the World; an existing World there is replaced.
    cell
        Arm, markers and names of the sensors; true places of the sensors and true offsets come
        from config/fake_world.yaml and the seed.
    seed
        Seed of everything random.
    rate
        World time over wall time.
    hidden
        Hidden effects of the arm or the sensors.
    candidates
        Number of candidate poses of each split; the size of a hidden effect depends on them.
    dynamics
        Scale of the arm's hidden dynamics, 1 for sizes of real machines; 0: the encoders see all
        of its motion, and frames are sent at the time that they show.

    Raises
    ------
    InputError
        config/fake_world.yaml places no sensor of a name in the cell, an effect cannot be seen,
        or no pose can be reached on which its size is measured.
    """
    settings = yaml.safe_load(config_path('fake_world.yaml').read_text())
    chain = cell.chain()
    missing = sorted(set(cell.sensors) - set(settings['sensors']))
    if missing:
        raise InputError(f'fake_world.yaml places no sensor {", ".join(missing)}')
    rng = np.random.default_rng([seed, 1])
    markers: dict[str, FloatArray] = {}
    sensors = {}
    for name, sensor in cell.sensors.items():
        place = settings['sensors'][name]
        T_R_N = place_sensor(place['position_m'], place['look_at_m'], PLACEMENT_STD_M, rng)
        for marker in sensor.markers:
            if marker not in markers:
                nominal = np.array(cell.markers[marker])
                markers[marker] = nominal + rng.normal(0, cell.marker_std_m, 3)
        acceptance = np.deg2rad(place['acceptance_deg'])
        sensors[name] = SimulatedSensor(
            sensor.marker, T_R_N, acceptance_rad=acceptance, further=sensor.further_markers
        )
    offset_std = np.deg2rad(settings['offset_std_deg'])
    joint_offsets = rng.normal(0, offset_std, len(chain)) * chain.per_radian
    warming = Warming(rng.uniform(2.0, 6.0), rng.uniform(300.0, 1500.0), START_S)
    truth = SessionTruth(joint_offsets, markers, sensors, warming)
    if hidden:
        # Imported here: a fake device plans nothing.
        from remaster_ros.simulation.simulated_tour import plan_tour, visit

        # Effects get the requested sizes on a tour like the one that will be visited.
        rng = np.random.default_rng([seed, 2])
        places = {name: sensor.T_R_N for name, sensor in sensors.items()}
        counts = dict.fromkeys(('optimization', 'validation'), candidates)
        visits = visit(plan_tour(chain, cell, places, counts, rng), chain)
        q = np.concatenate([*visits['optimization'], *visits['validation']])
        truth = with_effects(truth, model_of_tour(chain, truth, q), hidden, rng)
    return World.create(
        folder,
        WorldContent(
            truth,
            seed,
            rate,
            cell.urdf_text,
            cell.robot.base_link,
            cell.robot.tip_link,
            _start(chain, np.deg2rad(settings['start_q_deg'])),
            cell.link_radius_m,
            Dynamics.drawn(chain, tuple(sensors), dynamics, np.random.default_rng([seed, 4]))
            if dynamics
            else None,
        ),
    )


def _start(chain: SerialChain, angles: FloatArray) -> FloatArray:
    """First positions of a fake arm, rad or m, (k,); ``angles``: those of its first joints.

    Further joints are at 0; all joints that slide are in the middle of their range.
    """
    q = np.zeros(len(chain))
    known = min(len(chain), len(angles))
    q[:known] = angles[:known]
    q[chain.slides] = 0.5 * (chain.lower[chain.slides] + chain.upper[chain.slides])
    return q


def open_world(folder: str, namespace: str = '/', timeout_s: float = 20.0) -> World:
    """Open the World in `folder` ('' for the default one), waiting until it has been made.

    ``namespace``: see `default_folder`; ``timeout_s``: longest wait, wall time, s. Raises
    InputError if there is none after `timeout_s`, or the default folder is not private.
    """
    path = Path(folder) if folder else default_folder(namespace)
    deadline = time.monotonic() + timeout_s
    while not (path / WORLD_FILE).exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    # Another user may have put a folder of this name there meanwhile.
    if not folder and os.path.lexists(path):
        require_private(path)
    return World.open(path)
