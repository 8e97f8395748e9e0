"""Meshes: read, mended, measured. Signed distance, convex parts, sharp features, authored shapes."""
