"""Files of grasps, and recordings."""
