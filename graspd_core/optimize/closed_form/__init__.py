"""The closed form."""
