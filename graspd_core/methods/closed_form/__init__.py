"""The closed-form method."""
