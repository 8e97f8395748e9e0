"""Robot arms: their reach with a hand, their paths, and their collisions (docs/arms.md)."""
