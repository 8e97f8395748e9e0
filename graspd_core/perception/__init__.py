"""Building scenes from camera data and files."""
