"""Cameras, depth images and point clouds, and readers of their files."""
