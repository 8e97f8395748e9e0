"""Cameras, depth images, clouds and their files."""
