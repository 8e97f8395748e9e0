"""Show grasps in a browser, and plan grasps from there."""
