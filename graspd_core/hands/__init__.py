"""Models of robot hands: readers, kinematics, collision geometry and contact candidates."""
