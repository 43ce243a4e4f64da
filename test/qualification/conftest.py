# SPDX-License-Identifier: Apache-2.0
"""Campaigns of minutes: `make qualify` runs them, `make test` does not."""

from rigs.ros_rig import client, ros_environment, start  # noqa: F401  fixtures
