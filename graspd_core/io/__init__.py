"""Readers and writers of grasps files and recordings."""
