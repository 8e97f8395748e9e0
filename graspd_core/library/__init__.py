"""Verified grasps of known objects: kept in a file, and used again."""
