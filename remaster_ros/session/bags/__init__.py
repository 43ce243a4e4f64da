# SPDX-License-Identifier: Apache-2.0
"""rosbag2 bags (MCAP) without a ROS installation: read, written, recovered."""
