"""Solve the closed-form relaxation of the grasp problem (docs/method.md)."""
