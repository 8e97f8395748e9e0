"""Grasps in the files of others."""
