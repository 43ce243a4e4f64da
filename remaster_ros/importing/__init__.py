# SPDX-License-Identifier: Apache-2.0
"""Anybody's table of joint angles and points, or a ROS bag, made a session."""
