"""Sockets and threads around the protocols; no ROS."""
