"""Steering: where a hand comes from, what it touches and what it keeps away from."""
