"""What one cell of the benchmark is, and how each kind of it is run."""
