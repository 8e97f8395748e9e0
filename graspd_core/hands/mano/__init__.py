"""The MANO model of the human hand."""
