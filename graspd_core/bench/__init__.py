"""Benchmarks and charts."""
