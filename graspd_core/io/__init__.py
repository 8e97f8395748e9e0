"""Read and write grasps files, and read recordings."""
