"""Stress tests: meshes, clouds and settings with deliberate faults."""
