"""From a scene and a hand to ranked candidates."""
