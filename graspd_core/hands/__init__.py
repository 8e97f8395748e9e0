"""Hand models from URDF and their kinematics."""
