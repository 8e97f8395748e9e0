"""Data sets of grasps, made on Ray. Import and export of grasps in formats of other projects."""
