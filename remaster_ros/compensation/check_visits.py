# SPDX-License-Identifier: Apache-2.0
"""The configurations of a check: chosen once, kept as a table, and what is expected of them."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.checking import chosen_poses
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.files import read_limited
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray

# Of a check: four see 0.26 mm where eight see 0.17, and sixteen take twice the time for 0.12.
CHECK_POSES = 8
# A check that takes longer is not made each day.
CHECK_S = 90.0
# Of a table, bytes: 8 rows of joints are a thousandth of that.
TABLE_LIMIT = 1_000_000


@dataclass(frozen=True, eq=False)
class CheckVisits:
    """Configurations in the order of the visits, and what a check of them finds."""

    chain: SerialChain  # Of k joints
    q: FloatArray  # rad, m of joints that slide, (n, k)
    noise_m: float  # That the cell file states for its sensor, of one axis, m
    # The smallest change of each joint that one check finds at that noise, m at the tool, (k,);
    # NaN where a moved sensor looks the same
    detectable_m: FloatArray

    def table(self) -> str:
        """Return the text of the table, degrees, mm of joints that slide."""
        lines = [','.join(columns_of(self.chain))]
        shown = self.chain.shown_scale * self.q
        lines += [','.join(f'{value:.6f}' for value in row) for row in shown]
        return '\n'.join(lines) + '\n'

    def seconds(self, travel: TravelTime) -> float:
        """Return the time from the first reading's settling to the last reading, s."""
        ways = sum(float(travel.straight(a, b[None])[0]) for a, b in zip(self.q, self.q[1:]))
        return ways + len(self.q) * travel.measuring_s

    def too_long(self, seconds: float) -> str:
        """Return what to do about a check that takes too long; ''."""
        if seconds <= CHECK_S:
            return ''
        return (
            f'that is more than the {CHECK_S:g} s of a check: raise the limits of speed, if the '
            'cell allows it'
        )

    def expected(self) -> list[str]:
        """Return the smallest change of each joint that one check finds, a line each."""
        return [
            f'{name}: '
            + ('none: looks like a sensor that was moved' if np.isnan(m) else f'{1e3 * m:.2f} mm')
            for name, m in zip(self.chain.joint_names, self.detectable_m, strict=True)
        ]


def chosen_visits(
    cell: Workcell,
    chain: SerialChain,
    q: FloatArray,
    travel: TravelTime | None,
    rng: np.random.Generator,
) -> CheckVisits:
    """Choose configurations of a check, nearest in time first.

    Parameters
    ----------
    q
        To choose from, rad or m, (c, k), c >= `CHECK_POSES`.
    travel
        What the order goes by; None to keep that of `q`, as it was chosen before.
    rng
        See `checking.chosen_poses`.
    """
    sensor = cell.sensors[cell.aim_at]
    places = {name: np.array(place) for name, place in cell.markers.items()}
    model = replace(ArmModel.nominal(chain), T_R_N={cell.aim_at: np.eye(4)}, markers=places)
    rows, sizes = chosen_poses(model, q, cell.aim_at, sensor.marker, CHECK_POSES, rng)
    order = list(range(len(rows)))
    if travel is not None:
        between, order = travel.between(q[rows]), [0]
        while len(order) < len(rows):
            left = [i for i in range(len(rows)) if i not in order]
            order.append(min(left, key=lambda i: float(between[order[-1], i])))
    noise = float(np.hypot(sensor.noise_m, sensor.pose_noise_m))
    return CheckVisits(chain, q[rows][order], noise, noise * sizes)


def columns_of(chain: SerialChain) -> list[str]:
    """Return the header of a table of configurations."""
    names = zip(chain.joint_names, chain.shown_units, strict=True)
    return [f'{name} [{unit}]' for name, unit in names]


def read_visits(path: Path, cell: Workcell, chain: SerialChain) -> CheckVisits:
    """Return the configurations that `remaster plan CELL --check FILE` has written.

    Raises
    ------
    InputError
        One line: no such file, of another arm, or not as many finite places within its limits.
    """
    try:
        text = read_limited(
            path, TABLE_LIMIT, f'`remaster plan CELL --check {path}` chooses the poses of a check'
        ).decode()
    except UnicodeError:
        raise InputError(
            f'{path}: is no text; give the table of `remaster plan --check`'
        ) from None
    header, *rows = [row for row in csv.reader(text.splitlines()) if row] or [[]]
    named = columns_of(chain)
    if header != named:
        raise InputError(f'{path}, line 1: is not {",".join(named)}; choose the poses of this arm')
    if len(rows) != CHECK_POSES:
        raise InputError(f'{path}: has {len(rows)} configurations, and a check has {CHECK_POSES}')
    q = np.empty((len(rows), len(chain)))
    for number, row in enumerate(rows, 2):
        try:
            q[number - 2] = np.array([float(cell) for cell in row]) / chain.shown_scale
        except ValueError:
            raise InputError(
                f'{path}, line {number}: does not have {len(chain)} numbers'
            ) from None
        if not bool(chain.within_limits(q[number - 2][None])[0]):
            raise InputError(f"{path}, line {number}: is outside the joints' limits")
    return chosen_visits(cell, chain, q, None, np.random.default_rng(0))
