# SPDX-License-Identifier: Apache-2.0
"""Topic of another package's node: mocap drivers, tag detectors, trackers."""
