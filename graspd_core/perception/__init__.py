"""Build scenes from camera data and files."""
