# SPDX-License-Identifier: Apache-2.0
"""Real nodes, real DDS, real sockets."""

from rigs.ros_rig import client, ros_environment, start  # noqa: F401  fixtures
