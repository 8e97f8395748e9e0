"""Load robot arms, and plan their paths to grasps without collisions (docs/arms.md)."""
