# SPDX-License-Identifier: Apache-2.0
"""Configurations of a check of an arm: chosen once, kept as a table, with what a check finds."""

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
from remaster_ros.session.cells.workcell import Workcell
from remaster_ros.session.files import read_limited
from remaster_ros.types import FloatArray

# Configurations of a check: four find a change of 0.26 mm, eight one of 0.17 mm, and sixteen take
# twice the time for 0.12 mm.
CHECK_POSES = 8
# Longest time of a check, s, that is likely to be made each day.
CHECK_S = 90.0
# Largest size of a table, bytes: 8 rows of joints have a thousandth of it.
TABLE_LIMIT = 1_000_000


@dataclass(frozen=True, eq=False)
class CheckVisits:
    """Configurations that a check of an arm visits, in order, and the changes that it can find."""

    chain: SerialChain
    q: FloatArray  # rad, m for prismatic joints, (n, k)
    noise_m: float  # Noise of the sensor per axis, as in the cell file, m
    # Smallest change of each joint that one check finds at that noise, m at the tool, (k,);
    # NaN if a moved sensor has the same effect
    detectable_m: FloatArray

    def table(self) -> str:
        """CSV text: header and a row per configuration, degrees (prismatic: mm), 6 decimals."""
        lines = [','.join(columns_of(self.chain))]
        shown = self.chain.shown_scale * self.q
        lines += [','.join(f'{value:.6f}' for value in row) for row in shown]
        return '\n'.join(lines) + '\n'

    def seconds(self, travel: TravelTime) -> float:
        """Duration of a check, s: moves between the configurations, and measuring at each.

        The move to the first one is not counted.
        """
        ways = sum(float(travel.straight(a, b[None])[0]) for a, b in zip(self.q, self.q[1:]))
        return ways + len(self.q) * travel.measuring_s

    def too_long(self, seconds: float) -> str:
        """Clause with the remedy if ``seconds``, of a check, are over 90 (`CHECK_S`); else ''."""
        if seconds <= CHECK_S:
            return ''
        return (
            f'that is more than the {CHECK_S:g} s of a check: raise the limits of speed, if the '
            'cell allows it'
        )

    def expected(self) -> list[str]:
        """Lines 'JOINT: SIZE mm' with the smallest change, at the tool, that one check finds.

        One for each joint. In place of the size: 'none: looks like a sensor that was moved',
        if a moved sensor would have the same effect.
        """
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
    """Choose the configurations of a check, each followed by the one that is reached soonest.

    Parameters
    ----------
    cell
        Workcell whose sensor ``aim_at`` measures its marker, with the noise stated there.
    chain
        Nominal arm.
    q
        Candidate configurations, rad or m, (c, k), c >= `CHECK_POSES`.
    travel
        Travel times that decide the order; None to keep the order of `q`.
    rng
        Draws initial configurations; see `checking.chosen_poses`.
    """
    sensor = cell.sensors[cell.aim_at]
    places = {name: np.array(place) for name, place in cell.markers.items()}
    model = replace(ArmModel.nominal(chain), T_R_N={cell.aim_at: np.eye(4)}, markers=places)
    rows, sizes = chosen_poses(model, q, cell.aim_at, sensor.marker, CHECK_POSES, rng)
    order = list(range(len(rows)))
    if travel is not None:
        between, order = travel.between(q[rows]), [0]
        while len(order) < len(rows):
            remaining = [i for i in range(len(rows)) if i not in order]
            order.append(min(remaining, key=lambda i: float(between[order[-1], i])))
    noise = float(np.hypot(sensor.noise_m, sensor.pose_noise_m))
    return CheckVisits(chain, q[rows][order], noise, noise * sizes)


def columns_of(chain: SerialChain) -> list[str]:
    """Header of a table of configurations: 'joint_1 [deg]', 'rail [mm]', …"""
    names = zip(chain.joint_names, chain.shown_units, strict=True)
    return [f'{name} [{unit}]' for name, unit in names]


def read_visits(path: Path, cell: Workcell, chain: SerialChain) -> CheckVisits:
    """Read the configurations that `remaster plan CELL --check FILE` has written.

    Raises
    ------
    InputError
        No such file, no text, or too large; a table of another arm, or not of `CHECK_POSES`
        configurations; a row without k numbers, not finite, or outside the limits.
    """
    try:
        text = read_limited(
            path, TABLE_LIMIT, f'`remaster plan CELL --check {path}` chooses the poses of a check'
        ).decode()
    except UnicodeError:
        raise InputError(
            f'{path}: is no text; give the table of `remaster plan --check`'
        ) from None
    lines = [(i, row) for i, row in enumerate(csv.reader(text.splitlines()), 1) if row]
    (_, header), *rows = lines or [(1, [])]
    named = columns_of(chain)
    if header != named:
        raise InputError(f'{path}, line 1: is not {",".join(named)}; choose the poses of this arm')
    if len(rows) != CHECK_POSES:
        raise InputError(f'{path}: has {len(rows)} configurations, and a check has {CHECK_POSES}')
    q = np.empty((len(rows), len(chain)))
    for index, (line, row) in enumerate(rows):
        try:
            values = [float(cell) for cell in row]
        except ValueError:
            values = []
        if len(values) != len(chain) or not np.all(np.isfinite(values)):
            raise InputError(f'{path}, line {line}: does not have {len(chain)} numbers')
        q[index] = np.array(values) / chain.shown_scale
        if not bool(chain.within_limits(q[index][None])[0]):
            raise InputError(f"{path}, line {line}: is outside the joints' limits")
    return chosen_visits(cell, chain, q, None, np.random.default_rng(0))
