"""Conversion of messages to requests."""
