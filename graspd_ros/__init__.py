"""The ROS 2 shell around graspd_core: messages in, messages out. Nothing about grasping is decided here."""
