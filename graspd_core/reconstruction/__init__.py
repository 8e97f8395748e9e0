"""A closed mesh from what was seen of an object."""
