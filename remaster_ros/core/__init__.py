"""Kinematics, planning and statistics: numpy in, numpy out; no ROS, sockets, files or clocks."""
