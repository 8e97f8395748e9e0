"""Triangle meshes: files, repair, mass properties, signed distance, convex parts, sharp features, built-in shapes."""
