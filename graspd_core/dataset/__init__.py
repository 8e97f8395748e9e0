"""`graspd dataset` (docs/dataset.md): blocks of grasps made on Ray, kept as Parquet files."""
