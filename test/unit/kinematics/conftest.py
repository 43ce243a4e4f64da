# SPDX-License-Identifier: Apache-2.0
"""Arms that several modules try."""

import pytest
from collision_scene import ROBOTS

from remaster_ros.kinematics.serial_chain import SerialChain


@pytest.fixture(scope='module')
def lwr():
    return SerialChain.from_urdf((ROBOTS / 'lwr4plus.urdf').read_text(encoding='utf-8'))
