"""Read hand files: URDF, MJCF, and hand descriptions in YAML."""
