# SPDX-License-Identifier: Apache-2.0
"""Thin ROS 2 nodes: parameters, subscribe, call core, publish."""

from remaster_ros.requirements import end_without_packages

# Before a node imports one of them.
end_without_packages()
