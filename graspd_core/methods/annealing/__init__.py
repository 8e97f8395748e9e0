"""Simulated annealing after GraspIt!."""
