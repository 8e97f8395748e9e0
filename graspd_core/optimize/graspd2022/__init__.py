"""Solve Grasp'D (Turpin et al., ECCV 2022)."""
