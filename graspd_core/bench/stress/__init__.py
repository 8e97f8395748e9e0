"""Stability where methods fail: named cases made by generators, each with the endings that are right for it."""
