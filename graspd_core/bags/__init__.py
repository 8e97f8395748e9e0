"""Recordings: rosbag2 bags read and written without ROS, and what their messages hold as arrays."""
