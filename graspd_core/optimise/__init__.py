"""Optimisers: a scene and a hand in, candidate grasps out."""
