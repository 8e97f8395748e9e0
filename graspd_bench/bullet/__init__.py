"""Trials in the second simulator."""
