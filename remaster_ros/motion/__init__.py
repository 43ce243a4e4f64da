"""What an arm is commanded, and when: limits, paths, the motion gate, the arm's supervisor.

Nothing else decides that, and nothing here has ROS, sockets, files or clocks. Whoever answers for
the safety of a cell reads this folder.
"""
