"""Grasp'D as published."""
