"""Static grasp quality. A judge: shares no code with the optimiser."""
