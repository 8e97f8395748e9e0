"""Cameras, depth images, point clouds, and files of these."""
