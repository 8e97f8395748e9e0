"""The second simulator."""
