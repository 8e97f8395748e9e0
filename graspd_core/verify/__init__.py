"""Physics trials in MuJoCo. A judge: shares no code with the optimiser."""
