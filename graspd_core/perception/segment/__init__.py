"""One object cut out of what cameras saw."""
