# SPDX-License-Identifier: Apache-2.0
"""What an arm is commanded, and when: limits, paths, the motion gate, the arm's supervisor.

Nothing else decides that, and nothing here has ROS, sockets, files or clocks. To judge the safety
of a cell it is enough to read this folder.

Positions, ways and speeds of joints are in each joint's own unit: where a text has rad, a joint
that slides has m. What is stated as an angle alone, `joint_units` turns into that unit.
"""
