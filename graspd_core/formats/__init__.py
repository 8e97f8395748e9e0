"""Files that graspd writes and reads: grasps, pages."""
