"""Viewer of grasps in a browser."""
