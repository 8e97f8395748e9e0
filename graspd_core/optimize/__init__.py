"""Optimise hand poses for a scene and a hand, and rank the grasp candidates."""
