"""Data sets of grasps on Ray, and grasps of others."""
