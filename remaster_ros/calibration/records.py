# SPDX-License-Identifier: Apache-2.0
"""Robot, registrations and markers of a result, as its files have them."""

from __future__ import annotations

from msgspec import UNSET, Struct, UnsetType

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_quaternion_xyzw, transform
from remaster_ros.types import FloatArray, Session

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w


class Robot(Struct):
    """Arm to which the offsets belong."""

    name: str
    urdf_sha256: str
    joint_names: list[str]
    base_link: str
    tip_link: str

    @classmethod
    def of(cls, session: Session, chain: SerialChain) -> Robot:
        """Robot of a session: names of arm, links and joints, and checksum of its URDF."""
        return cls(
            chain.name,
            session.urdf_sha256,
            list(chain.joint_names),
            session.base_link,
            session.tip_link,
        )


class Registration(Struct):
    """T_R_N: a sensor's frame N in the robot base R, with std along and about the axes of R.

    ``std_is_lower_limit`` is true if errors remain that the model does not have: they move
    registrations and markers by more than the std, by an unknown amount.
    """

    translation_m: Triple
    rotation_xyzw: Quaternion
    std_m: Triple
    std_rad: Triple
    std_is_lower_limit: bool | UnsetType = UNSET

    @property
    def T_R_N(self) -> FloatArray:
        """Registration as a matrix, (4, 4). Raises ValueError if the quaternion is no rotation."""
        return transform(matrix_from_quaternion_xyzw(self.rotation_xyzw), self.translation_m)


class Marker(Struct):
    """Position of a marker in the tool frame T; ``std_is_lower_limit`` as in `Registration`."""

    position_m: Triple
    std_m: Triple
    std_is_lower_limit: bool | UnsetType = UNSET
