"""Session folders, rosbag2 (MCAP), result files, reports and figures; no ROS graph."""
