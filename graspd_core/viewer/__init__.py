"""Look at grasps in a browser: what was planned, what is being planned, and why it failed (docs/viewer.md)."""
