"""Recordings: rosbag2 bags read without ROS, and what their messages hold as arrays."""
