"""One object cut out of a scene: planes, clusters, the support plane, the target."""
