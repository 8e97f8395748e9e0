"""Cameras, depth images and point clouds, and reading of files with such data."""
