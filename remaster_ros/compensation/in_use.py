# SPDX-License-Identifier: Apache-2.0
"""A correction applied to all commands of an arm, and the true arm for checking paths.

The correction is compared with the arm first: one of another robot, or one that changes a joint by
more than mastering errors, is refused before anything moves. Paths are to be checked for the true
arm: zero-offsets, lengths and tilts are built into it, and the bending by its angles and gravity's
torques is bounded in sampled configurations.
"""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.compensator import MOST_RAD, ROUNDING_RAD, Compensator
from remaster_ros.compensation.file import Compensation, read_compensation
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse, matrix_to_rotation_vector
from remaster_ros.types import BoolArray, Correction, FloatArray

MOST_DEG = float(np.degrees(MOST_RAD))
"""Largest change of a joint, degrees."""
KNOWN_OFFSET_RAD = float(np.deg2rad(0.1))
"""Least assumed error of a joint whose offset is in use, rad, for the clearance of paths."""
OFFSET_STDS = 3.0
"""Standard deviations of the least certain offset that the clearance covers at least."""
SAMPLED = 2000
"""Configurations sampled for the largest changes: these are smooth in the angles, and with seven
joints some hundreds of samples come near each extreme."""
SEED = 22


@dataclass(frozen=True, eq=False)
class Commands:
    """Corrected commands for n wanted configurations, and why some must not be commanded."""

    # Command, and its difference from the wanted angles, rad, (n, k); the command of a refused row
    # is NaN
    command: FloatArray
    change: FloatArray
    refused: dict[int, str]  # Row -> why it must not be commanded
    notes: tuple[str, ...]  # Remarks on rows for a person, a line each
    # As in `compensator.Correction`, (n,)
    incomplete: BoolArray
    outside_range: BoolArray


class CorrectionInUse:
    """A correction applied to each commanded configuration.

    Parameters
    ----------
    path
        Its compensation.json, which is read now and never again.
    chain, urdf
        The arm that is commanded, and its URDF's text; None for those of the file.
    urdf_file
        Name of that URDF, for messages.
    most_deg
        Largest change of a joint, degrees.

    Attributes
    ----------
    sha256
        Hash of the file as it was read.
    compensator
        The correction.

    Raises
    ------
    InputError
        One line: no such file, of another arm, of an arm with a prismatic joint, or larger than
        `most_deg`.
    """

    def __init__(
        self,
        path: str,
        chain: SerialChain | None = None,
        urdf: str = '',
        urdf_file: str = '',
        most_deg: float = MOST_DEG,
    ) -> None:
        found = read_compensation(path)
        for joint in np.flatnonzero(found.model.chain.slides)[:1]:
            raise InputError(
                f"{path}: joint '{found.model.chain.joint_names[joint]}' slides, and no node "
                'corrects what such an arm is commanded; give its planner the corrected URDF'
            )
        self.path, self.sha256 = path, found.sha256
        self._compensation = found
        self.compensator = Compensator(found.model, float(np.radians(most_deg)))
        if chain is None:
            chain = found.model.chain
        else:
            _refuse_another_arm(found, chain, urdf, urdf_file)
        self._names = chain.joint_names
        self._most_deg = most_deg
        self._sampled = _sampled(chain)
        change = np.abs(self.compensator.angle_errors(self._sampled)).max(axis=0)
        if np.any(change > np.radians(self._most_deg)):
            joint = int(np.argmax(change))
            raise InputError(
                f'{path}: would change {self._names[joint]} by up to '
                f'{np.degrees(change[joint]):.2f} degrees, and {self._most_deg:g} are the most: '
                'master the arm, measure again, and give the new file'
            )

    def off(self) -> CorrectionInUse:
        """A correction of the same arm that corrects nothing; this one is unchanged."""
        other = copy.copy(self)
        for name in ('true_arm', 'shifts', '_bends'):
            other.__dict__.pop(name, None)
        nominal = ArmModel.nominal(self.compensator.model.chain)
        other.compensator = Compensator(nominal, self.compensator.most_rad)
        return other

    @cached_property
    def true_arm(self) -> SerialChain:
        """Serial chain with zero-offsets, lengths and tilts built in, which takes reported angles.

        As `ArmModel.rigid`: without terms and compliance.
        """
        return self.compensator.model.rigid()

    @cached_property
    def _bends(self) -> FloatArray:
        """Rotation that `true_arm` lacks at each joint, rad, (2000, k), without sign.

        Angle between the joint's frame in the full model and in `true_arm`, both relative to
        the frame of the joint before, at each sampled configuration.
        """
        frames = self.compensator.model.state(self._sampled).frames
        rigid = self.true_arm.frames(self._sampled)
        steps = [_steps(arm_frames) for arm_frames in (frames, rigid)]
        turns = matrix_to_rotation_vector(
            np.swapaxes(steps[1][..., :3, :3], -1, -2) @ steps[0][..., :3, :3]
        )
        return np.asarray(np.linalg.norm(turns, axis=-1))

    def joint_angle_bound(self, before_rad: float) -> float:
        """Upper bound on the error of a joint's angle in `true_arm`, rad.

        It bounds the root of the sum of the squares of all joints' errors, so that a body may
        be off by this bound times the root of the sum of the squares of the joints' lever arms
        (Cauchy and Schwarz): clearances for collision checks grow by that. Rotations by terms
        and compliance, which `true_arm` lacks, are contained, also those across the joints'
        axes.

        Parameters
        ----------
        before_rad
            The bound without a correction, which remains if an offset could not be identified.
        """
        model = self.compensator.model
        std = model.widening * np.linalg.norm(model.root[:, : model.joints], axis=0)
        known = all(part.identifiable for part in self._compensation.content.joints)
        bound = max(KNOWN_OFFSET_RAD, OFFSET_STDS * float(std.max())) if known else before_rad
        return bound + float(np.linalg.norm(self._bends, axis=1).max())

    @cached_property
    def shifts(self) -> FloatArray:
        """Least and largest sum of zero-offset and terms of each joint, rad or m, (2, k).

        To be added to reported angles. Over the sampled configurations, at the mean
        temperature of the measurements.
        """
        model = self.compensator.model
        drivers = model.drivers(self._sampled, model.warming(len(self._sampled), None))
        added = model.added_angles(drivers)
        return np.array([added.min(axis=0), added.max(axis=0)])

    @property
    def remarks(self) -> list[str]:
        """Remarks for the person who puts the correction in use, a line each; [] if none.

        On a dependence on the temperature, and on another correction that must still be on.
        """
        lines = []
        model, state = self.compensator.model, self._compensation.content.state
        if model.grows:
            lines.append(
                f'{self.path}: depends on the temperature, and {model.mean_c:.1f} degrees Celsius '
                'are taken, as it was measured'
            )
        before = state.get('correction')
        if before and not (correction := Correction(**before)).is_beside:
            lines.append(
                f'{self.path}: was measured with a correction on ({correction}), which must '
                'still be on'
            )
        return lines

    def too_large(self, change: FloatArray) -> dict[int, str]:
        """Reason for each row (index) of changes, rad, (n, k), with a joint beyond ``most_deg``.

        {} if no row does.
        """
        refused = {}
        most = np.abs(change).max(axis=1, initial=0.0)
        # A change at the bound is at it to rounding.
        for row in map(int, np.flatnonzero(most > np.radians(self._most_deg) + ROUNDING_RAD)):
            joint = int(np.argmax(np.abs(change[row])))
            refused[row] = (
                f'the correction would change {self._names[joint]} by '
                f'{np.degrees(change[row, joint]):.2f} degrees; {self._most_deg:g} are the most'
            )
        return refused

    def for_waypoints(self, waypoints: FloatArray) -> tuple[FloatArray, dict[int, str]]:
        """Commands for waypoints, rad, (n, k), and the reason for each refused row (index).

        Only errors of the joint angles are corrected, so that the arm keeps to the planned
        path and near a singularity no joint moves further than its own error; the tool's pose
        is not exact. A row is refused if a joint would be changed by over ``most_deg``; its
        command is returned all the same.
        """
        change = self.compensator.angle_errors(waypoints)
        return waypoints + change, self.too_large(change)

    def commands(self, wanted: FloatArray) -> Commands:
        """Commands for wanted configurations, rad, (n, k), whose tool poses are corrected.

        Refused rows, whose command is NaN: those that are not finite, and those in which a
        joint would be changed by over ``most_deg``.
        """
        finite = np.all(np.isfinite(wanted), axis=-1)
        done = self.compensator.correct(np.where(finite[:, None], wanted, 0.0))
        change = done.command - wanted
        refused = {int(row): 'it is no finite number' for row in np.flatnonzero(~finite)}
        refused |= self.too_large(change)
        notes = []
        for row in map(int, np.flatnonzero(finite)):
            residual = done.residual_m[row], done.residual_rad[row]
            if done.incomplete[row]:
                notes.append(
                    f'solution {row} is near a singularity: of its pose '
                    f'{1e3 * residual[0]:.3f} mm and {np.degrees(residual[1]):.4f} degrees are '
                    'not corrected'
                )
            if done.outside_range[row]:
                notes.append(
                    f'solution {row} is beyond the angles at which a curve of the correction was '
                    'measured: its end value is taken'
                )
        command = done.command.copy()
        # NaN fails each later check as well.
        command[list(refused)] = np.nan
        incomplete, outside = done.incomplete & finite, done.outside_range & finite
        return Commands(command, change, refused, tuple(notes), incomplete, outside)


def _refuse_another_arm(
    found: Compensation, chain: SerialChain, urdf: str, urdf_file: str
) -> None:
    """Raise InputError if the correction is of another URDF, other end links or other joints."""
    robot = found.content.robot
    sha256 = hashlib.sha256(urdf.encode()).hexdigest()
    if robot.urdf_sha256 != sha256:
        raise InputError(
            f'{found.path}: is of another URDF (checksum {robot.urdf_sha256[:8]}) than '
            f'{urdf_file} ({sha256[:8]}); give the one that was measured with this description'
        )
    for what, its, cell_value in (
        ('base link', robot.base_link, chain.base_link),
        ('tip link', robot.tip_link, chain.tip_link),
        ('joints', ', '.join(robot.joint_names), ', '.join(chain.joint_names)),
    ):
        if its != cell_value:
            raise InputError(
                f"{found.path}: its {what} ({its}) differ from the cell's ({cell_value}); give "
                'the one that was measured with this cell'
            )


def _sampled(chain: SerialChain) -> FloatArray:
    """2,000 random configurations within the limits, rad, (2000, k), equal in each call.

    Limits that are infinite count as half a turn to either side.
    """
    lower = np.where(np.isfinite(chain.lower), chain.lower, -np.pi)
    upper = np.where(np.isfinite(chain.upper), chain.upper, np.pi)
    return np.random.default_rng(SEED).uniform(lower, upper, (SAMPLED, len(chain)))


def _steps(frames: FloatArray) -> FloatArray:
    """Pose of each joint's frame in that of the joint before, (n, k, 4, 4).

    ``frames``: poses in the robot base frame R, (n, k, 4, 4); the first one stays in R.
    """
    found: FloatArray = np.concatenate(
        (frames[:, :1], inverse(frames[:, :-1]) @ frames[:, 1:]), axis=1
    )
    return found
