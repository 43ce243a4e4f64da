"""Anybody's table of joint angles and points, or a ROS bag, made a session."""
