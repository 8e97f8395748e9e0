"""Make data sets of grasps on Ray. Import and export grasps in the formats of other projects."""
