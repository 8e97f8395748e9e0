"""ROS 2 interface of graspd_core. It converts messages and makes no decisions about grasping."""
