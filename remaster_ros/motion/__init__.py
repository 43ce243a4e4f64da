"""What an arm is commanded, and when: limits, paths, the motion gate, the arm's supervisor.

Nothing else decides that, and nothing here has ROS, sockets, files or clocks. To judge the safety
of a cell it is enough to read this folder.
"""
