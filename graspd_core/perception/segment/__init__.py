"""Segment one object from camera data."""
