# SPDX-License-Identifier: Apache-2.0
"""Workcell files, and the robot descriptions, meshes and packages that they name."""
