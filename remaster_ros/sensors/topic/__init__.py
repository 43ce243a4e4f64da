# SPDX-License-Identifier: Apache-2.0
"""A topic of a node that is not of this package: mocap drivers, tag detectors, trackers."""
