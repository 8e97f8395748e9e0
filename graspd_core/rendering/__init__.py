"""Pictures and depth images of meshes, and authored tabletop scenes whose truth is known."""
