"""Model robot hands: read their files, compute kinematics, collision geometry and contact candidates."""
