"""Methods that find grasps: the problem, the shared loop, one folder a method."""
