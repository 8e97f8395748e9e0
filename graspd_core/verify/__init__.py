"""Try grasps in MuJoCo, measure metrics, and derive the verdict of each grasp."""
