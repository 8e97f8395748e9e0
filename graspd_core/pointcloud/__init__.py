"""What depth cameras saw: cameras, depth images, clouds and their files, and the space that they saw to be empty."""
