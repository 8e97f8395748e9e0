"""Charts of the benchmark."""
