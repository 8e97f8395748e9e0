"""The frozen scene, from a mesh or from views: the object and what stands around it."""
