"""Methods to compare others with."""
