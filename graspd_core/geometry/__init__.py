"""Meshes, clouds, signed distance fields and scenes."""
