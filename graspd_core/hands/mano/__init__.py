"""The MANO hand model."""
