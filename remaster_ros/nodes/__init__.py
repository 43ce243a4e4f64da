"""Thin ROS 2 nodes: parameters, subscribe, call core, publish."""
