"""A robot cell: a simulated arm, hand and camera with interfaces of real drivers, and a picker that empties a bin."""
