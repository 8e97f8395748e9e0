"""Baseline methods, with which graspd's methods are compared."""
