"""Readers of hand files: URDF, MJCF, hand descriptions."""
