"""Meshes: read, mended, measured; signed distance, convex parts, sharp features, authored shapes."""
