"""A robot cell: a simulated arm, hand and camera that speak as real drivers do, and a picker that empties a bin."""
