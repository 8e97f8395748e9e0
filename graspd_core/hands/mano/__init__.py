"""Read the MANO model of the human hand, and convert it to a hand model."""
