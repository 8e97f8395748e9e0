"""Reconstruct a closed mesh from the points of an object."""
