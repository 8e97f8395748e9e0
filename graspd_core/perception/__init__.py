"""Scenes from cameras and files."""
