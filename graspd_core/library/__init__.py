"""Keep verified grasps of known objects in a library file, and find them again."""
