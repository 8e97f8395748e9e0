"""Grasps in a browser."""
