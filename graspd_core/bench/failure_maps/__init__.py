"""Failure maps: success over two things that make grasping hard, a picture each."""
