"""Segmentation of one object from camera data."""
