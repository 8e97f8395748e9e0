"""Grasps of objects that were planned before: kept in a file, and used again."""
