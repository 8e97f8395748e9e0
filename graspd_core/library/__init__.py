"""A library of verified grasps of known objects, kept in a file."""
