"""Contact forces and wrenches."""
