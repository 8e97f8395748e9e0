"""Conversion of results to messages."""
