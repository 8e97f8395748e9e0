"""Static grasp quality. It shares no code with the methods."""
