"""Trials in MuJoCo, metrics, and the verdict."""
