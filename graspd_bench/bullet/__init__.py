"""Trials in PyBullet, the second simulator."""
