"""Plan grasps: rounds of optimiser and trials, steering constraints, and the reasons why an object cannot be held."""
